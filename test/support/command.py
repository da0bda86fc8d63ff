"""Run ``ember`` and scripts, in this process or in a child process."""

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
    """Return an environment in which a child process imports the packages of this repository."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **more}


def child(
    words: Sequence[Any],
    *,
    cwd: Path = ROOT,
    env: dict[str, str] | None = None,
    stdout: int = subprocess.PIPE,
    deadline_s: float = DEADLINE_S,
) -> subprocess.CompletedProcess[str]:
    """Run a command in a child process to its end; return its exit code and output.

    Args:
        words: the command and its arguments.
        cwd: the working folder.
        env: the environment; by default that of `environment`.
        stdout: file descriptor for standard output; by default the output is returned.
        deadline_s: maximum wall time, s.

    Raises:
        subprocess.TimeoutExpired: the command took longer; it was killed.
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
def started(words: Sequence[Any], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Start a process; kill it at the end of the context if it still runs.

    Args:
        words: the command and its arguments.
        options: further arguments of `subprocess.Popen`.
    """
    with subprocess.Popen([str(word) for word in words], **options) as process:
        try:
            yield process
        finally:
            process.kill()  # otherwise leaving Popen would wait without a deadline


@contextmanager
def closed_pipe() -> Iterator[int]:
    """Yield the write end of a pipe whose read end is closed, as after the end of ``head``."""
    read, write = os.pipe()
    os.close(read)
    try:
        yield write
    finally:
        os.close(write)
