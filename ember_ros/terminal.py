"""The terminal that ``ember`` speaks to, what is done when it is gone, and how far a run is."""

from __future__ import annotations

import errno
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

from rich.console import Console, ConsoleDimensions
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ember_ros.spinning import detach_terminal

LINE_PERIOD_S = 10.0
"""Wall seconds between two lines that say how far a run is, where there is no terminal."""

WIDE = 1000
"""Columns where there is no terminal."""

Update = Callable[[float, str], None]
"""Told how much is done, and that in words."""


class _Forgetful:
    """A file that forgets what is written to a terminal or a reader that is gone."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> None:
        with self._forgotten():
            self._file.write(text)

    def flush(self) -> None:
        with self._forgotten():
            self._file.flush()

    @contextmanager
    def _forgotten(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:  # `| head` has heard enough, and the run is whole all the same
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self._file.fileno())
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            detach_terminal()


class Terminal(Console):
    """A console whose run goes on, and is saved, when its terminal is closed."""

    @property
    def size(self) -> ConsoleDimensions:
        """Return columns and lines; where there is no terminal, no line and no path is broken."""
        if self.is_terminal:
            return super().size
        return ConsoleDimensions(WIDE, super().size.height)

    @size.setter
    def size(self, new: tuple[int, int]) -> None:
        self._width, self._height = new

    @property
    def file(self) -> IO[str]:
        """Return what it writes to."""
        return _Forgetful(super().file)  # type: ignore[return-value]

    @file.setter
    def file(self, new: IO[str]) -> None:
        self._file = new


console = Terminal(highlight=False, markup=False)
"""What a command found out goes here: to standard output."""
aside = Terminal(stderr=True, highlight=False, markup=False)
"""How far it is goes here: to standard error, so that output can be piped on."""


def command_line() -> str:
    """Return what was typed, for a text file: bytes that are no letters are spelt out."""
    command = shlex.join(["ember", *sys.argv[1:]])
    return command.encode("utf-8", "backslashreplace").decode()


def grid(
    rows: Iterable[Sequence[Any]],
    columns: str = "ll",
    heads: Sequence[str] = (),
    *,
    whole: bool = False,
) -> Table:
    """Return what is printed as rows of columns.

    Args:
        rows: a value a column each.
        columns: a letter a column: ``l`` is of words, to the left; ``r`` of numbers, to the right.
        heads: what stands above the columns; nothing for none.
        whole: whether a row is one line on a narrow terminal too, which then cuts values short.
    """
    table = Table(show_header=bool(heads), box=None, padding=(0, 2, 0, 0))
    for head, side in zip(heads or [""] * len(columns), columns, strict=True):
        table.add_column(head, justify="right" if side == "r" else "left", no_wrap=whole)
    for row in rows:
        table.add_row(*map(str, row))
    return table


@contextmanager
def progress(label: str, total: float) -> Iterator[Update]:
    """Show how far a run is: a bar on a terminal; elsewhere a line every ``LINE_PERIOD_S``.

    Nothing is shown before the first update: a mistake that is found before is said in one line.

    Args:
        label: what is done.
        total: how much there is to do.
    """
    if not _interactive():
        yield _lines(label)
        return
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[told]}"),
        TimeRemainingColumn(),
        console=aside,
    )
    task = bar.add_task(label, total=total, told="")

    def update(done: float, told: str) -> None:
        bar.start()
        bar.update(task, completed=done, told=told)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def doing(label: str) -> Iterator[Callable[[str], None]]:
    """Show what is done now, stage by stage, where nobody knows how much there is to do."""
    if _interactive():
        with aside.status("") as status:
            yield status.update
    else:
        yield lambda what: aside.print(f"{label}: {what}")


def _interactive() -> bool:
    """Return whether somebody looks on from a terminal that can draw."""
    return sys.stderr.isatty() and not aside.is_dumb_terminal


def _lines(label: str) -> Update:
    said = time.monotonic()

    def update(done: float, told: str) -> None:
        nonlocal said
        if time.monotonic() - said >= LINE_PERIOD_S:
            aside.print(f"{label}: {told}")
            said = time.monotonic()

    return update
