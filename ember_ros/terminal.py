"""Terminal output of ``ember``: consoles that tolerate a closed terminal, tables and progress."""

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
"""Wall time between two lines of progress if there is no terminal, s."""

WIDE = 1000
"""Number of columns if there is no terminal."""

Update = Callable[[float, str], None]
"""Function to call with the amount that is done and a text that describes it."""


class _TolerantFile:
    """A file that ignores errors of writing to a closed terminal or a closed pipe."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> None:
        with self._ignoring_closed():
            self._file.write(text)

    def flush(self) -> None:
        with self._ignoring_closed():
            self._file.flush()

    @contextmanager
    def _ignoring_closed(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:  # the reader, such as `| head`, has ended; the run continues
            with open(os.devnull, "wb") as devnull:
                os.dup2(devnull.fileno(), self._file.fileno())
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            detach_terminal()


class Terminal(Console):
    """A console that does not stop the run when its terminal is closed."""

    @property
    def size(self) -> ConsoleDimensions:
        """Return columns and lines; without a terminal, so many columns that no line is wrapped."""
        if self.is_terminal:
            return super().size
        return ConsoleDimensions(WIDE, super().size.height)

    @size.setter
    def size(self, new: tuple[int, int]) -> None:
        self._width, self._height = new

    @property
    def file(self) -> IO[str]:
        """Return the file that the console writes to."""
        return _TolerantFile(super().file)  # type: ignore[return-value]

    @file.setter
    def file(self, new: IO[str]) -> None:
        self._file = new


console = Terminal(highlight=False, markup=False)
"""Results are printed here, to standard output."""
progress_console = Terminal(stderr=True, highlight=False, markup=False)
"""Progress is printed here, to standard error, so that results can be piped."""


def command_line() -> str:
    """Return the command line, for a text file: undecodable bytes are escaped."""
    command = shlex.join(["ember", *sys.argv[1:]])
    return command.encode("utf-8", "backslashreplace").decode()


def grid(
    rows: Iterable[Sequence[Any]],
    columns: str = "ll",
    heads: Sequence[str] = (),
    *,
    whole: bool = False,
) -> Table:
    """Return a table to print.

    Args:
        rows: one value per column each.
        columns: one letter per column: ``l`` aligns left, for words; ``r`` right, for numbers.
        heads: one header per column; none if empty.
        whole: whether a row stays on one line on a narrow terminal, which then truncates values.
    """
    table = Table(show_header=bool(heads), box=None, padding=(0, 2, 0, 0))
    for head, side in zip(heads or [""] * len(columns), columns, strict=True):
        table.add_column(head, justify="right" if side == "r" else "left", no_wrap=whole)
    for row in rows:
        table.add_row(*map(str, row))
    return table


@contextmanager
def progress(label: str, total: float) -> Iterator[Update]:
    """Show progress: a bar on a terminal, otherwise a line every ``LINE_PERIOD_S``.

    Nothing is shown before the first update, so an error before it is a single line.

    Args:
        label: names the task.
        total: the amount to do.

    Yields:
        The function that updates the progress.
    """
    if not _interactive():
        yield _lines(label)
        return
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(),
        console=progress_console,
    )
    task = bar.add_task(label, total=total, text="")

    def update(done: float, text: str) -> None:
        bar.start()
        bar.update(task, completed=done, text=text)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def stages(label: str) -> Iterator[Callable[[str], None]]:
    """Show the present stage of a task whose total amount is unknown.

    Yields:
        The function that is called with each stage.
    """
    if _interactive():
        with progress_console.status("") as status:
            yield status.update
    else:
        yield lambda stage: progress_console.print(f"{label}: {stage}")


def _interactive() -> bool:
    """Return whether standard error is a terminal that can draw."""
    return sys.stderr.isatty() and not progress_console.is_dumb_terminal


def _lines(label: str) -> Update:
    last = time.monotonic()

    def update(done: float, text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= LINE_PERIOD_S:
            progress_console.print(f"{label}: {text}")
            last = time.monotonic()

    return update
