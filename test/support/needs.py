"""Marks for tests that need optional libraries.

Tests that need rclpy have the mark ``ros``; ``conftest.py`` skips them without rclpy.
"""

from __future__ import annotations

from importlib.util import find_spec

import pytest

ROS = find_spec("rclpy") is not None


def needs(*libraries: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test where one of these libraries is missing."""
    missing = [library for library in libraries if find_spec(library) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{' and '.join(missing)} is missing")


needs_bullet = needs("pybullet")
needs_bags = needs("rosbags", "mcap")
