"""Finds the trained table and the recorded walk that come with the package, by name. Pure.

They are in ``bags/`` of the repository; an installation has that folder as ``ember_ros/data``.
"""

from __future__ import annotations

from pathlib import Path

_SHIPPED = Path(__file__).parent / "data"
DATA = _SHIPPED if _SHIPPED.is_dir() else Path(__file__).parents[1] / "bags"
"""The folder of both, in an installation or in a checkout."""
TABLE, BAG = "trained", "walk"
"""Their names; the README.md in that folder lists the commands that make them."""


def shipped_table(file: Path) -> Path:
    """Return the path of the table that comes with the package if ``file`` is its name.

    An existing file of that name wins, as with parameter files. Any other path is returned as it
    is.
    """
    return DATA / f"{TABLE}.npz" if str(file) == TABLE and not file.is_file() else file


def shipped_bag(path: Path) -> Path:
    """Return the path of the bag that comes with the package if ``path`` is its name.

    An existing file or folder of that name wins. Any other path is returned as it is.
    """
    return DATA / BAG if str(path) == BAG and not path.exists() else path
