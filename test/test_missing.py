"""Libraries that are not installed: who needs none runs without, who needs one names it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ember_ros.entry_points import NODES
from support.command import child, closed_pipe

WALL = """
import importlib.abc, runpy, sys

class Wall(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

hidden = set(sys.argv[1].split(","))
for name in [name for name in sys.modules if name.split(".")[0] in hidden]:
    del sys.modules[name]  # of some .pth file
sys.meta_path.insert(0, Wall())
del sys.argv[1]
"""
RUN = WALL + "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
WALK = (
    WALL
    + """
from ember_ros.graph import Graph
from ember_ros.run_config import RunConfig
from sim_node.fake import FakeWorld
graph = Graph(RunConfig("walker", 2), world=FakeWorld())
graph.run()
print(graph.sim.tick)
graph.close()
"""
)


def without(hidden: str, script: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a Python that lacks some libraries."""
    return child([sys.executable, "-c", script, hidden, *args])


@pytest.mark.parametrize(
    ("library", "pip", "apt"),
    [
        ("click", "click", "python3-click"),
        ("rich", "rich", "python3-rich"),
        ("numpy", "numpy", "python3-numpy"),
        ("yaml", "PyYAML", "python3-yaml"),
    ],
)
def test_ember_names_the_library_it_lacks(library: str, pip: str, apt: str) -> None:
    """One line with both ways to get it, and the code of a user's mistake; no traceback."""
    done = without(library, RUN, "ember_ros", "train")
    assert done.returncode == 2
    assert done.stderr == (
        f"error: {library} is not installed: `pip install {pip}` or `sudo apt install {apt}`\n"
    )


def test_the_help_of_ember_needs_click_alone() -> None:
    """So that it is there at once: no command is imported, and nothing that one needs."""
    done = without("rich,numpy,yaml,matplotlib,mcap", RUN, "ember_ros", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "Walk with four legs that carry a body and continue to learn." in done.stdout


@pytest.mark.parametrize("node", NODES)
def test_a_node_says_that_ros_is_not_here(node: str) -> None:
    """Who installed without the extra ``ros`` reads one line, no traceback."""
    done = without("rclpy", RUN, "ember_ros", "node", node)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ROS 2 is not available (No module named 'rclpy'): `pip install ")


@pytest.mark.ros
@pytest.mark.parametrize("node", NODES)
def test_a_node_is_started_without_what_only_ember_needs(node: str) -> None:
    """``ember node`` itself asks for nothing that the node does not."""
    done = without("click,rich,matplotlib,scipy", RUN, "ember_ros", "node", node, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: {node} ")


@pytest.mark.parametrize(
    ("library", "args"),
    [
        ("matplotlib", ("train", "--cycles", "1")),
        ("matplotlib", ("experiment", "fig5")),
        ("scipy", ("experiment", "fig5")),
        ("mcap", ("walk", "--on", "loop", "--policy", "scripted", "--cycles", "1", "--bag", "bag")),
    ],
)
def test_what_is_needed_in_the_end_is_missed_at_the_start(
    tmp_path: Path, library: str, args: tuple[str, ...]
) -> None:
    """Nobody trains for an hour to read that there is nothing to draw with."""
    args = tuple(str(tmp_path / "bag") if arg == "bag" else arg for arg in args)
    done = without(library, RUN, "ember_ros", *args, "--out", str(tmp_path / "out"))
    assert done.returncode == 2, done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert line.startswith(f"error: {library} is not installed, and is needed ")
    assert f"`pip install {library}`" in line
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("**/*.npz"))
    assert not (tmp_path / "bag").exists()


@pytest.mark.ros
@pytest.mark.parametrize("library", ["mcap", "rosbags"])
@pytest.mark.parametrize(
    ("module", "args"),
    [
        ("ember_ros.bag.recorder_node", ()),
        ("sim_node.node", ("-p", "world:=trainer")),
    ],
)
def test_a_node_that_cannot_record_ends_at_once(
    tmp_path: Path, library: str, module: str, args: tuple[str, ...]
) -> None:
    """It does not look healthy and record nothing: one line that names the library, and code 2."""
    bag = tmp_path / "bag"
    done = without(library, RUN, module, "--ros-args", "-p", f"bag:={bag}", *args)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {library} is not installed, and is needed for bags: `pip ")
    assert not bag.exists()


@pytest.mark.ros
@pytest.mark.slow
def test_nodes_walk_without_what_only_ember_needs() -> None:
    """No node imports what draws, what prints, or what writes bags."""
    hidden = "click,rich,matplotlib,mcap,rosbags,scipy"
    done = without(hidden, WALK)
    assert (done.returncode, done.stdout.strip()) == (0, "64"), done.stderr


def test_a_command_whose_standard_streams_are_closed_runs(tmp_path: Path) -> None:
    """``ember train 2>&- <&-``: no file of its own takes their places."""
    done = child(
        ["sh", "-c", 'exec "$0" -m ember_ros train --cycles 1 --out out 2>&- <&-', sys.executable],
        cwd=tmp_path,
    )
    assert done.returncode == 0
    assert "In out: table.npz" in done.stdout
    assert (tmp_path / "out" / "summary.json").exists()


@pytest.mark.ros
def test_the_help_of_a_node_may_be_cut_off() -> None:
    """``ember node leg_node --help | head -1``: no traceback."""
    command = [sys.executable, "-m", "ember_ros", "node", "leg_node", "--help"]
    with closed_pipe() as pipe:
        done = child(command, stdout=pipe)
    assert done.stderr == ""
