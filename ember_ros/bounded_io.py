"""Opens files that somebody gave, perhaps made to harm: only files, of a bounded size. Pure."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO


def open_file(file: Path, most: int | None = None) -> BinaryIO:
    """Open a file for reading, if it is one: a pipe or a device may never end, or never begin.

    Args:
        file: its path.
        most: bytes that it may have; any number for None.

    Raises:
        OSError: it cannot be opened.
        ValueError: it is no file, or larger.
    """
    # Not blocking: opening a pipe that nobody writes to would wait for ever.
    opened = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        found = os.fstat(opened)
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("it is no regular file")
        if most is not None and found.st_size > most:
            raise ValueError(f"it has {found.st_size} bytes; up to {most} would be right")
        return os.fdopen(opened, "rb")
    except BaseException:
        os.close(opened)
        raise


def read_text(file: Path, most: int) -> str:
    """Return the text in a file.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no file, larger than ``most`` bytes, or no UTF-8.
    """
    with open_file(file, most) as raw:
        data = raw.read(most + 1)  # some files of the system say that they have no bytes
    if len(data) > most:
        raise ValueError(f"it has more than {most} bytes")
    return data.decode()


def read_json(text: str, most: int) -> Any:
    """Return what a JSON text says.

    Raises:
        ValueError: it is none, or has more than ``most`` characters.
    """
    if len(text) > most:
        raise ValueError(f"{len(text)} characters of JSON; up to {most} would be right")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("JSON that is nested too deeply") from None
