"""The door of ``ember``: so light that Ctrl-C is heard even while everything else is imported."""

from __future__ import annotations

import sys

from ember_ros.errors import PIP, MissingError


def main() -> None:
    """Run the command line."""
    try:
        from ember_ros.cli import main as command

        command()
    except ModuleNotFoundError as error:
        name = (error.name or "").split(".")[0]
        if name not in PIP:
            raise
        print(f"error: {MissingError(name)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
