"""The versions of what a run's bits depend on. Pure."""

from __future__ import annotations

import importlib.metadata
import platform

import ember_ros


def versions() -> dict[str, str]:
    """Return the versions of what a run's bits depend on."""
    found = {"ember_ros": ember_ros.__version__, "python": platform.python_version()}
    for name in ("numpy", "pybullet", "rclpy"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
