"""Helpers for several test files, one module per subject; ``conftest.py`` makes some fixtures."""

from pkgutil import iter_modules

import pytest

# Before their import, so that a failed assertion in them shows its values as in a test.
pytest.register_assert_rewrite(*(f"{__name__}.{each.name}" for each in iter_modules(__path__)))
