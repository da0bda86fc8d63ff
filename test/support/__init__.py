"""What several test files need, a file a subject. ``conftest.py`` makes fixtures of some of it."""

from pkgutil import iter_modules

import pytest

# Before they are imported: an assertion in there says as much as one in a test.
pytest.register_assert_rewrite(*(f"{__name__}.{each.name}" for each in iter_modules(__path__)))
