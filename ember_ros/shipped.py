"""Finds by name the trained table and the bag that come with the package. Pure.

Both are in the folder ``bags/`` of the repository, which is installed as ``ember_ros/data``.
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

    An existing file of that name has precedence, as with parameter files. Any other path is
    returned unchanged.
    """
    return DATA / f"{TABLE}.npz" if str(file) == TABLE and not file.is_file() else file


def shipped_bag(path: Path) -> Path:
    """Return the path of the bag that comes with the package if ``path`` is its name.

    An existing file or folder of that name has precedence. Any other path is returned unchanged.
    """
    return DATA / BAG if str(path) == BAG and not path.exists() else path
