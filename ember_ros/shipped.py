"""A trained table and a recorded walk that come with the package, found by name. Pure.

They lie in ``bags/`` of the repository; an installation ships that folder as ``ember_ros/data``.
"""

from __future__ import annotations

from pathlib import Path

_SHIPPED = Path(__file__).parent / "data"
DATA = _SHIPPED if _SHIPPED.is_dir() else Path(__file__).parents[1] / "bags"
"""The folder of both: of an installation, or of a checkout or an editable install."""
TABLE, BAG = "trained", "walk"
"""Their names; README.md beside them says which commands make them."""


def shipped_table(file: Path) -> Path:
    """Return the table of that name that comes with the package, or the path as it is.

    A file of that name comes first, as with parameter files.
    """
    return DATA / f"{TABLE}.npz" if str(file) == TABLE and not file.is_file() else file


def shipped_bag(path: Path) -> Path:
    """Return the bag of that name that comes with the package, or the path as it is.

    Whatever there is of that name comes first, a folder as well: it may be a bag that was cut off.
    """
    return DATA / BAG if str(path) == BAG and not path.exists() else path
