"""``ember`` and scripts as a user starts them: in this process, or in one of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ember_ros.cli import main
from support.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""
EMBER = [sys.executable, "-m", "ember_ros"]


def ember(*words: Any) -> int:
    """Run the command in this process and return its exit code."""
    with pytest.raises(SystemExit) as end:
        main.main([str(word) for word in words], prog_name="ember")
    assert isinstance(end.value.code, int)
    return end.value.code


def environment(**more: str) -> dict[str, str]:
    """Return the environment of a child in any folder that imports this repository's packages."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **more}


def child(
    words: Sequence[Any],
    *,
    cwd: Path = ROOT,
    env: dict[str, str] | None = None,
    stdout: int = subprocess.PIPE,
    deadline_s: float = DEADLINE_S,
) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, to its end, and return its code and what it said.

    Args:
        words: the command.
        cwd: the folder it runs in.
        env: its environment; by default `environment`.
        stdout: where its standard output goes; by default it is returned.
        deadline_s: wall time in which it must have ended.

    Raises:
        subprocess.TimeoutExpired: it did not end in time; it is killed.
    """
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment() if env is None else env,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=deadline_s,
    )


@contextmanager
def started(words: Sequence[Any], **how: Any) -> Iterator[subprocess.Popen[Any]]:
    """Start a process, and kill it in the end if it has not ended.

    Args:
        words: the command.
        how: more of `subprocess.Popen`.
    """
    with subprocess.Popen([str(word) for word in words], **how) as process:
        try:
            yield process
        finally:
            process.kill()  # or leaving would wait for it without a deadline


@contextmanager
def nobody_reads() -> Iterator[int]:
    """Give the writing end of a pipe that nobody reads, as of ``head`` that has ended."""
    read, write = os.pipe()
    os.close(read)
    try:
        yield write
    finally:
        os.close(write)
