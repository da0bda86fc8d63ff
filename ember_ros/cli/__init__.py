"""The command line ``ember``: one module per group of commands, imported when it is used."""

from ember_ros.cli.ember import main

__all__ = ["main"]
