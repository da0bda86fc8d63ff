"""The command line ``ember``: a file a group of commands, each imported when it is asked for."""

from ember_ros.cli.ember import main

__all__ = ["main"]
