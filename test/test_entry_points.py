"""``ember node NAME`` starts a node without what only the command line needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from ember_ros.cli import main
from ember_ros.entry_points import NODES, ember

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """Modules that are asked for, with the arguments that they find when they are run."""
    found: list[tuple[str, list[str]]] = []

    def import_module(module: str) -> SimpleNamespace:
        return SimpleNamespace(main=lambda: found.append((module, sys.argv[1:])))

    monkeypatch.setattr("importlib.import_module", import_module)
    return found


@pytest.mark.parametrize("name", NODES)
def test_a_node_is_run_with_its_own_arguments(
    name: str, called: list[tuple[str, list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands behind its name is all that the node and rcl see, ``--help`` included."""
    monkeypatch.setattr(sys, "argv", ["ember", "node", name, "--ros-args", "-p", "bag:=two words"])
    ember()
    monkeypatch.setattr(sys, "argv", ["ember", "node", name, "--help"])
    ember()
    assert called == [
        (NODES[name], ["--ros-args", "-p", "bag:=two words"]),
        (NODES[name], ["--help"]),
    ]


@pytest.mark.parametrize(
    "words", [[], ["node"], ["node", "--help"], ["node", "sim"], ["walk", "node"]]
)
def test_all_else_goes_to_the_command_line(
    words: list[str], called: list[tuple[str, list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No word is lost on the way to what can say what would be right."""
    monkeypatch.setattr(sys, "argv", ["ember", *words])
    ember()
    assert called == [("ember_ros.cli", words)]


def test_the_command_line_lists_the_nodes() -> None:
    """``ember --help`` and ``ember node --help`` say which nodes there are."""
    for words in (["--help"], ["node", "--help"]):
        told = CliRunner().invoke(main, words, terminal_width=200)
        assert told.exit_code == 0
        for name in NODES:
            assert name in told.output


def test_a_node_that_is_not_there_is_said() -> None:
    """A wrong name is a user's mistake, whatever stands behind it: the right ones are named."""
    told = CliRunner().invoke(main, ["node", "sim", "--ros-args", "-p", "world:=trainer"])
    assert told.exit_code == 2
    assert "'sim' is not one of 'sim_node', 'leg_node', 'cpg_node'" in told.output


def test_the_console_script_imports_nothing_heavy() -> None:
    """Ctrl-C is heard from the beginning: nothing is imported before the script is asked to run."""
    code = "import sys, ember_ros.entry_points; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    heavy = {"click", "rich", "numpy", "yaml", "matplotlib", "rclpy", "pybullet"}
    assert not heavy & set(done.stdout.split())
