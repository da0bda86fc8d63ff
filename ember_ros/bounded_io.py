"""Reads files from outside, which may be malicious: regular files only, of bounded size. Pure."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO


def open_file(file: Path, max_bytes: int | None = None) -> BinaryIO:
    """Open a regular file for reading; reading a pipe or a device could block or never end.

    Args:
        file: its path.
        max_bytes: its maximum size; None for any size.

    Raises:
        OSError: it cannot be opened.
        ValueError: it is not a regular file, or is larger.
    """
    # Non-blocking: opening a pipe without a writer would block for ever.
    opened = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        status = os.fstat(opened)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is not a regular file")
        if max_bytes is not None and status.st_size > max_bytes:
            raise ValueError(f"it has {status.st_size} bytes; up to {max_bytes} would be right")
        return os.fdopen(opened, "rb")
    except BaseException:
        os.close(opened)
        raise


def read_text(file: Path, max_bytes: int) -> str:
    """Return the text in a file.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a regular file, is larger than ``max_bytes``, or is not UTF-8.
    """
    with open_file(file, max_bytes) as raw:
        data = raw.read(max_bytes + 1)  # some system files report a size of 0 bytes
    if len(data) > max_bytes:
        raise ValueError(f"it has more than {max_bytes} bytes")
    return data.decode()


def read_json(text: str, max_chars: int) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or has more than ``max_chars`` characters.
    """
    if len(text) > max_chars:
        raise ValueError(f"{len(text)} characters of JSON; up to {max_chars} would be right")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("JSON that is nested too deeply") from None
