"""The terminal that ``ember`` speaks to, and what is done when it is gone."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

from rich.console import Console

from ember_ros.spinning import let_go_of_terminal


class _Forgetful:
    """A file that forgets what is written to a terminal that is gone."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> None:
        with _forgotten():
            self._file.write(text)

    def flush(self) -> None:
        with _forgotten():
            self._file.flush()


@contextmanager
def _forgotten() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        let_go_of_terminal()


class Terminal(Console):
    """A console whose run goes on, and is saved, when its terminal is closed."""

    @property
    def file(self) -> IO[str]:
        """Return what it writes to."""
        return _Forgetful(super().file)  # type: ignore[return-value]

    @file.setter
    def file(self, new: IO[str]) -> None:
        self._file = new
