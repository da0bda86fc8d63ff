"""Who may import what: legs and the pure parts know neither ROS nor PyBullet, nor each other."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.command import ROOT, child

HOUSE = ("ember_ros", "leg_node", "cpg_node", "sim_node")

# Files that may import ROS anywhere.
ROS = {
    "ember_ros.bag.metadata_client",
    "ember_ros.bag.player_node",
    "ember_ros.bag.recorder_node",
    "ember_ros.bag.robot_recorder",
    "leg_node.calls",
    "ember_ros.ros_params",
    "leg_node.node",
    "leg_node.table_node",
    "cpg_node.node",
    "sim_node.node",
    "sim_node.recorders",
    "sim_node.reports",
}
# Files that put parts together: they may import ROS, and must not need it to be imported.
LAZY = {
    "ember_ros.graph",
    "ember_ros.spinning",
    "ember_ros.run",
    "ember_ros.cli.replay",
    "ember_ros.cdr",
    "ember_ros.timers",
    "ember_ros.topics",
}
# Measures ROS itself.
MEASURES = {"ember_ros.bench", "ember_ros.chaos"}
BULLET = {"sim_node.bullet", "sim_node.trainer", "sim_node.walker"}

# What counts as ROS: the client library, and every package of messages or tools around it.
ROS_NAMES = ("rclpy", "rosidl", "rpyutils", "ament", "launch", "rosbag2", "builtin_interfaces")
ROS_ENDINGS = ("_msgs", "_srvs", "_interfaces")


def is_ros(module: str) -> bool:
    """Return whether a module is of ROS."""
    top = module.split(".")[0]
    return top.startswith(ROS_NAMES) or top.endswith(ROS_ENDINGS)


def name_of(file: Path) -> str:
    """Return the dotted name of a source file."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources() -> dict[str, Path]:
    """Return every source file by its dotted name; launch files are run by ROS alone."""
    return {
        name_of(file): file
        for room in HOUSE
        for file in sorted((ROOT / room).rglob("*.py"))
        if ROOT / "ember_ros" / "launch" not in file.parents
    }


SOURCES = sources()
PURE = sorted(set(SOURCES) - ROS - LAZY - MEASURES - BULLET)


def imports(name: str, *, top_only: bool = False) -> Iterator[str]:
    """Yield what a file imports, within functions too unless ``top_only``; not for type checks."""
    tree = ast.parse(SOURCES[name].read_text(encoding="utf-8"))
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively"
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
        elif not (top_only and isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))):
            waiting += ast.iter_child_nodes(node)


def test_the_lists_are_of_files_that_are() -> None:
    """No exception here outlives its file, and there is something left that is pure."""
    assert set(SOURCES) >= ROS | LAZY | MEASURES | BULLET
    rooms = {name.split(".")[0] for name in PURE}
    assert rooms == set(HOUSE)
    assert len(PURE) > 20


@pytest.mark.parametrize("name", PURE)
def test_pure_files_import_no_ros_and_no_bullet(name: str) -> None:
    """Not at the top and not within a function."""
    wrong = [each for each in imports(name) if is_ros(each) or each.startswith("pybullet")]
    assert wrong == []


@pytest.mark.parametrize("name", sorted(LAZY))
def test_files_that_put_parts_together_do_not_need_ros(name: str) -> None:
    """They import ROS, and the files that need it, within functions only."""
    wrong = [each for each in imports(name, top_only=True) if is_ros(each) or each in ROS | BULLET]
    assert wrong == []


@pytest.mark.slow
def test_only_world_files_import_pybullet() -> None:
    """PyBullet in one file; that file in the two worlds and where friction itself is measured.

    These are imported where worlds are made, lazily.
    """
    users = {name for name in SOURCES if any(i.startswith("pybullet") for i in imports(name))}
    assert users == {"sim_node.bullet"}
    users = {name for name in SOURCES if "sim_node.bullet" in imports(name)}
    assert users == {"sim_node.trainer", "sim_node.walker", "ember_ros.experiments.isotropy"}
    for name in SOURCES:
        if name not in BULLET:
            assert not BULLET & set(imports(name, top_only=True)), name


def test_only_nodes_and_bags_import_what_is_wired() -> None:
    """Names, types and messages: for nodes, for bags, and for what measures them, alone."""
    wired = {
        "ember_ros.cdr",
        "ember_ros.topics",
        "ember_ros.wire",
        "leg_node.calls",
        "ember_ros.ros_params",
    }
    users = {name for name in SOURCES if wired & set(imports(name))}
    others = {name for name in users - ROS - MEASURES if not name.startswith("ember_ros.bag.")}
    assert others == {"ember_ros.cdr", "ember_ros.wire"}


def test_only_assemblies_import_nodes() -> None:
    """A node is made by what puts the graph together, and by no other part."""
    nodes = {"leg_node.node", "leg_node.table_node", "cpg_node.node", "sim_node.node"}
    users = {name for name in SOURCES if nodes & set(imports(name))}
    assert users <= LAZY | MEASURES


@pytest.mark.parametrize("room", ["leg_node", "cpg_node", "sim_node"])
def test_rooms_do_not_know_each_other(room: str) -> None:
    """A leg knows no world and no generator, a world no leg, and so on: only what all share."""
    others = {"leg_node", "cpg_node", "sim_node"} - {room}
    for name in SOURCES:
        if name.startswith(f"{room}."):
            known = {each for each in imports(name) if each.split(".")[0] in others}
            assert not known, name


@pytest.mark.parametrize("room", ["leg_node", "cpg_node", "sim_node"])
def test_nothing_that_decides_reads_a_clock(room: str) -> None:
    """No wall clock, and no numbers drawn from a module's own state, where a robot is decided."""
    for name in PURE + sorted(BULLET):
        if name.startswith(f"{room}."):
            assert not {"time", "datetime", "random", "secrets", "uuid"} & set(imports(name)), name


@pytest.mark.parametrize("room", HOUSE)
def test_the_rule_is_written_where_it_holds(room: str) -> None:
    """Each room's docstring says what may not be imported in it."""
    doc = ast.get_docstring(ast.parse(SOURCES[room].read_text(encoding="utf-8")))
    assert doc is not None
    word = {"cpg_node": "nothing else", "sim_node": "PyBullet"}.get(room, "ROS")
    assert word in doc


BLOCKED = """
import importlib, importlib.abc, sys

class Wall(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top in {"pybullet", "rpyutils"} or top.startswith(NAMES) or top.endswith(ENDINGS):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

before = {name for name in sys.modules if name.split(".")[0].startswith(NAMES)}
assert not before, before
sys.meta_path.insert(0, Wall())
try:
    import rclpy
except ModuleNotFoundError:
    pass
else:
    raise AssertionError("the wall does not hold")
for name in sys.argv[1:]:
    importlib.import_module(name)
print(len(sys.argv) - 1)
"""


@pytest.mark.slow
def test_pure_files_are_imported_without_ros_and_bullet() -> None:
    """In a Python that has neither, every pure file and every assembly can be imported."""
    names = sorted({*PURE, *LAZY})
    script = f"NAMES = {ROS_NAMES!r}\nENDINGS = {ROS_ENDINGS!r}\n{BLOCKED}"
    done = child([sys.executable, "-c", script, *names])
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(len(names))


def test_a_robot_runs_without_ros_and_bullet() -> None:
    """In a Python that has neither, the loop runs in the fake world."""
    run = """
from ember_ros.loop import Loop
from ember_ros.run_config import RunConfig
from sim_node.fake import FakeWorld
loop = Loop(RunConfig("walker", 1), FakeWorld())
for _ in range(64):
    loop.tick()
print(int(loop.finish().visits.sum()))
"""
    script = f"NAMES = {ROS_NAMES!r}\nENDINGS = {ROS_ENDINGS!r}\n{BLOCKED}\n{run}"
    done = child([sys.executable, "-c", script])
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0", str(4 * 63)]
