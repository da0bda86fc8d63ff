"""Versions, which the bits of a run depend on, and provenance, which they do not. Pure."""

from __future__ import annotations

import datetime
import functools
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

GIT_S = 10.0
"""Maximum wall time of a git command, s."""


def version() -> str:
    """Return the version of this package; ``unknown`` in a bare checkout on the path."""
    try:
        return importlib.metadata.version("ember_ros")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Return the versions of this package, Python and the libraries that a run's bits depend on."""
    found = {"ember_ros": version(), "python": platform.python_version()}
    for name in ("numpy", "pybullet", "rclpy"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def provenance() -> dict[str, str]:
    """Return date, machine and commit of the present run, for human readers.

    No name, hash or comparison of runs uses it, so that the same run gives the same bits, and the
    same MCAP file, at any time and on any machine.
    """
    now = datetime.datetime.now(datetime.timezone.utc)
    return {"date": now.isoformat(timespec="seconds"), **_machine()}


@functools.cache
def _machine() -> dict[str, str]:
    """Return system, CPU, SIMD extensions, BLAS library and commit."""
    import numpy as np

    build: dict[str, Any] = np.show_config(mode="dicts")  # type: ignore[assignment]
    blas = build.get("Build Dependencies", {}).get("blas", {})
    simd = build.get("SIMD Extensions", {})
    blas_parts = [blas.get("name"), blas.get("version"), blas.get("openblas configuration")]
    names = [*simd.get("baseline", []), *simd.get("found", [])]
    return {
        "system": f"{platform.system()} {platform.machine()}, {' '.join(platform.libc_ver())}",
        "cpu": _cpu(),
        "simd": " ".join(names) or "unknown",
        "blas": " ".join(" ".join(str(each) for each in blas_parts if each).split()) or "unknown",
        "commit": _commit(Path(__file__)),
    }


def _cpu() -> str:
    """Return the CPU's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _commit(file: Path) -> str:
    """Return the commit of the git checkout that a file belongs to, and whether it was changed.

    ``unknown`` without git, and for an installed package, whose folder may be inside a checkout of
    another project.
    """
    # A git hook that started this process may have set GIT_DIR to another repository.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*args: str) -> str:
        return subprocess.run(
            ["git", *args],
            cwd=file.parent,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
            timeout=GIT_S,
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)
        commit = git("rev-parse", "HEAD")
        return f"{commit}, changed" if git("status", "--porcelain", "-uno") else commit
    except (OSError, subprocess.SubprocessError):
        return "unknown"
