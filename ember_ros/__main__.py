"""The door of ``ember``: so light that Ctrl-C is heard even while everything else is imported."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line."""
    try:
        from ember_ros.cli import main as command

        command()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
