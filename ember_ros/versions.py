"""The versions of what a run's bits depend on and, apart from them, where and when it was. Pure."""

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
"""Wall time that git may take."""


def version() -> str:
    """Return the version of this package; ``unknown`` in a bare checkout on the path."""
    try:
        return importlib.metadata.version("ember_ros")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Return the versions of what a run's bits depend on."""
    found = {"ember_ros": version(), "python": platform.python_version()}
    for name in ("numpy", "pybullet", "rclpy"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def provenance() -> dict[str, str]:
    """Return where and when something is run: for people, since none of it may decide.

    Nothing that names or compares runs looks at it: the same run makes the same bits, and the same
    MCAP file, on any of these days and machines.
    """
    now = datetime.datetime.now(datetime.timezone.utc)
    return {"date": now.isoformat(timespec="seconds"), **_here()}


@functools.cache
def _here() -> dict[str, str]:
    import numpy as np

    told: dict[str, Any] = np.show_config(mode="dicts")  # type: ignore[assignment]
    blas = told.get("Build Dependencies", {}).get("blas", {})
    simd = told.get("SIMD Extensions", {})
    said = [blas.get("name"), blas.get("version"), blas.get("openblas configuration")]
    names = [*simd.get("baseline", []), *simd.get("found", [])]
    return {
        "system": f"{platform.system()} {platform.machine()}, {' '.join(platform.libc_ver())}",
        "cpu": _cpu(),
        "simd": " ".join(names) or "unknown",
        "blas": " ".join(" ".join(str(each) for each in said if each).split()) or "unknown",
        "commit": _commit(Path(__file__)),
    }


def _cpu() -> str:
    """Return the CPU's name for itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _commit(file: Path) -> str:
    """Return the commit that a file of ours was checked out from, and whether it was changed since.

    ``unknown`` without git, and for a package that is installed: the checkout around it, if there
    is one, is somebody else's.
    """
    # Not the repository that a hook of git, which may have started us, is about.
    around = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*what: str) -> str:
        return subprocess.run(
            ["git", *what],
            cwd=file.parent,
            env=around,
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
