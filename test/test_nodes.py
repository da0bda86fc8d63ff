"""Each node alone: its docstring, its parameters, its locality, the table's services."""

from __future__ import annotations

import math
import re
import shutil
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from cpg_node.node import CpgNode
from ember_ros import cdr, topics, wire
from ember_ros.bag.recorder_node import RecorderNode
from ember_ros.errors import EmberError, ParameterError, TableError
from ember_ros.loop import Loop
from ember_ros.options import OPTIONS
from ember_ros.params import SPECS, Params, cells_sha256
from ember_ros.run import SUMMARY
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegSense, TDUpdate
from ember_ros.spinning import node_main
from leg_node import calls
from leg_node.assembly import empty_table, make_leg
from leg_node.node import LegNode
from leg_node.shared import Changes, SharedTable, UpdateBatch
from leg_node.table_file import load_table, save_table
from leg_node.table_node import TableNode
from sim_node.node import FINISHED, SimNode
from support.legs import LEGS
from support.robot import PATIENCE_S, Robot, overrides
from support.ros import Ros
from support.runs import SignalLog

NODES = (SimNode, CpgNode, LegNode, TableNode)
NEEDED: dict[Any, dict[str, Any]] = {LegNode: {"leg": "rear_left"}}
"""Parameters without which a node does not start."""
TICK_NS = Params().gait.tick_ns


def make(ros: Ros, kind: Any, namespace: str = "", /, **parameters: Any) -> Any:
    """Return a node that spins; ``__`` in a parameter's name stands for the dot."""
    named = {name.replace("__", "."): value for name, value in parameters.items()}
    return ros.add(
        kind(
            context=ros.context,
            namespace=namespace,
            parameter_overrides=overrides({**NEEDED.get(kind, {}), **named}),
        )
    )


# -- what a docstring promises -----------------------------------------------------------------


def documented(kind: Any, section: str, legs: Sequence[str]) -> dict[str, str]:
    """Return the names in a section of a node's docstring with their types, ``""`` for none."""
    text = " ".join((kind.__doc__ or "").split())
    found = re.search(rf"\b{section}: (.*?)(?=\b[A-Z][a-z]+: |$)", text)
    names: dict[str, str] = {}
    untyped: list[str] = []
    for name, type_ in re.findall(r"``([^`]+)``|\(([\w/]+)\)", found[1] if found else ""):
        if type_:
            names |= dict.fromkeys(untyped, type_)
            untyped.clear()
        else:
            each = [name.replace("<leg>", leg) for leg in legs] if "<leg>" in name else [name]
            names |= dict.fromkeys(each, "")
            untyped += each
    return names


def live(ros: Ros, what: str, node: Any) -> dict[str, str]:
    """Return a node's endpoints as the graph shows them, names relative to its namespace.

    What every rclpy node has, such as logs and parameter services, is left out.
    """
    get = getattr(ros.node, f"get_{what}_names_and_types_by_node")
    namespace = node.get_namespace().rstrip("/")
    names = {}
    for name, types in get(node.get_name(), node.get_namespace()):
        if name in ("/rosout", "/parameter_events") or name.startswith(
            f"{namespace}/{node.get_name()}/"
        ):
            continue
        assert name.startswith(f"{namespace}/"), f"{name} does not move with the namespace"
        (type_,) = types
        names[name.removeprefix(f"{namespace}/")] = re.sub("/(msg|srv)/", "/", type_)
    return names


def agree(promised: dict[str, str], held: dict[str, str]) -> bool:
    """Return whether names agree, and types where the docstring gives them."""
    return promised.keys() == held.keys() and all(
        type_ in ("", held[name]) for name, type_ in promised.items()
    )


@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_a_sim_node_has_what_its_docstring_lists(ros: Ros, world: str) -> None:
    """Topics of every leg of its world, of the types listed; no service, no client."""
    node = make(ros, SimNode, "/a/b", world=world)
    assert node.legs == (LEGS if world == "walker" else ("leg",))
    published = documented(SimNode, "Publishes", node.legs)
    assert len(published) == 4 + 2 * len(node.legs)
    assert agree(published, live(ros, "publisher", node))
    received = documented(SimNode, "Subscribes", node.legs)
    assert len(received) == 2 + 2 * len(node.legs)
    assert agree(received, live(ros, "subscriber", node))
    assert not live(ros, "client", node)
    assert not live(ros, "service", node)


@pytest.mark.parametrize("leg", [*LEGS, "leg"])
def test_a_leg_has_its_own_topics_the_phase_and_the_table_alone(ros: Ros, leg: str) -> None:
    """Locality on the live graph: exactly these endpoints, and no other, in any namespace."""
    node = make(ros, LegNode, "/robot_3", leg=leg)
    joint_state = "sensor_msgs/JointState"
    assert live(ros, "subscriber", node) == {
        f"{leg}/joint_states": joint_state,
        f"{leg}/contact": joint_state,
        "cpg/phase": "sensor_msgs/JointState",
    }
    assert live(ros, "publisher", node) == {
        f"{leg}/command": joint_state,
        f"{leg}/transition": joint_state,
    }
    assert live(ros, "client", node) == {
        "table/push": "rcl_interfaces/SetParametersAtomically",
        "table/pull": "rcl_interfaces/GetParameters",
    }
    assert not live(ros, "service", node)
    # and this is what its docstring says
    assert agree(documented(LegNode, "Subscribes", [leg]), live(ros, "subscriber", node))
    assert agree(documented(LegNode, "Publishes", [leg]), live(ros, "publisher", node))
    calls = {n: t for n, t in documented(LegNode, "Calls", [leg]).items() if "/" in n}
    assert agree(calls, live(ros, "client", node))


def test_a_leg_that_does_not_share_calls_nobody(ros: Ros) -> None:
    """With ``shared`` false a leg has no client."""
    node = make(ros, LegNode, shared=False)
    assert not live(ros, "client", node)
    assert len(live(ros, "subscriber", node)) == 3


def test_a_leg_that_has_no_use_for_a_table_calls_nobody(ros: Ros) -> None:
    """A scripted leg that does not learn needs no table node; one that learns does."""
    idle = make(ros, LegNode, "/a", policy="scripted", learning=False)
    assert not live(ros, "client", idle)
    busy = make(ros, LegNode, "/b", policy="scripted", learning=True)
    assert len(live(ros, "client", busy)) == 2


def test_a_cpg_node_hears_the_clock_and_says_the_phase(ros: Ros) -> None:
    """The CPG's only publisher is the phase, its only subscription the clock."""
    node = make(ros, CpgNode, "/robot_3")
    assert live(ros, "publisher", node) == {"cpg/phase": "sensor_msgs/JointState"}
    assert live(ros, "subscriber", node) == {"clock": "rosgraph_msgs/Clock"}
    assert agree(documented(CpgNode, "Publishes", []), live(ros, "publisher", node))
    assert agree(documented(CpgNode, "Subscribes", []), live(ros, "subscriber", node))
    assert not live(ros, "client", node)
    assert not live(ros, "service", node)


def test_a_table_node_has_what_its_docstring_lists(ros: Ros) -> None:
    """Four services, no topic."""
    node = make(ros, TableNode, "/robot_3")
    services = documented(TableNode, "Services", [])
    assert len(services) == 4
    assert all(services.values())
    assert agree(services, live(ros, "service", node))
    assert not live(ros, "publisher", node)
    assert not live(ros, "subscriber", node)
    assert not live(ros, "client", node)


def test_the_table_of_topics_is_what_the_nodes_have(ros: Ros) -> None:
    """``topics``' docstring lists every name and type on the graph, and what only bags have."""
    rows = re.findall(
        r"^``([^`]+)``(?: \(service\))? +(\w+/)(\w*)(?:.*\n +(\w+))?", topics.__doc__ or "", re.M
    )
    listed = {name: package + (type_ or rest) for name, package, type_, rest in rows}
    held: dict[str, str] = {}
    for kind in NODES:
        node = make(ros, kind, leg="leg", world="trainer")
        for what in ("publisher", "subscriber", "client", "service"):
            held |= live(ros, what, node)
    on_the_graph = {n: t for n, t in listed.items() if not n.startswith("run/")}
    assert {n.replace("leg/", "<leg>/"): t for n, t in held.items()} == on_the_graph
    in_bags = (topics.RUN_METADATA, topics.VALUES, topics.VISITS, topics.CRC)
    assert {t.name: t.kind.replace("/msg", "") for t in in_bags} == {
        n: t for n, t in listed.items() if n not in on_the_graph
    }


# -- parameters --------------------------------------------------------------------------------


def declared(node: Any) -> dict[str, Any]:
    """Return a node's own parameters."""
    return {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name not in ("use_sim_time", "start_type_description_service")
    }


@pytest.mark.parametrize("kind", NODES)
def test_a_node_has_the_parameters_its_docstring_lists(ros: Ros, kind: Any) -> None:
    """No more, no fewer, at their defaults, described, read-only, and in their ranges."""
    node = make(ros, kind)
    expected: dict[str, Any] = {}
    for name in documented(kind, "Parameters", []):
        if name.endswith(".*"):
            group = {n: s.default for n, s in SPECS.items() if n.startswith(name[:-1])}
            assert group, f"{name} is no group"
            expected |= group
        else:
            expected[name] = OPTIONS[name].default
    expected |= NEEDED.get(kind, {})
    expected = {getattr(OPTIONS.get(n), "declared", "") or n: v for n, v in expected.items()}
    told = {option.declared or name: option.doc for name, option in OPTIONS.items()}
    for name, value in declared(node).items():
        plain = expected.pop(name)
        assert value == (list(plain) if isinstance(plain, tuple) else plain), name
        described = node.describe_parameter(name)
        assert described.read_only
        if name in told:
            assert described.description == told[name]
            continue
        spec = SPECS[name]
        assert spec.doc in described.description
        if spec.form:
            assert f"({spec.form})" in described.description
            many, one = ParameterType.PARAMETER_STRING_ARRAY, ParameterType.PARAMETER_STRING
            assert described.type == (many if isinstance(spec.default, tuple) else one)
            continue
        assert f"[{spec.unit}]" in described.description
        if isinstance(spec.default, tuple):
            assert described.type == ParameterType.PARAMETER_DOUBLE_ARRAY
        elif not (math.isfinite(spec.low) and math.isfinite(spec.high)):
            assert not described.integer_range
            assert not described.floating_point_range
            assert "finite" in described.additional_constraints
        elif isinstance(spec.default, int):
            (whole,) = described.integer_range
            assert (whole.from_value, whole.to_value, whole.step) == (spec.low, spec.high, 0)
        else:
            (real,) = described.floating_point_range
            assert (real.from_value, real.to_value, real.step) == (spec.low, spec.high, 0.0)
    assert not expected, "listed, not declared"


@pytest.mark.parametrize("kind", NODES)
def test_parameters_can_be_dumped(ros: Ros, kind: Any) -> None:
    """``ros2 param dump`` nests names at their dots: none is a value and a group as well."""
    nested: dict[str, Any] = {}
    for name, value in declared(make(ros, kind)).items():
        *groups, last = name.split(".")
        inner = nested
        for group in groups:
            inner = inner.setdefault(group, {})
            assert isinstance(inner, dict), f"{name}: {group} is a value"
        assert last not in inner, name
        inner[last] = value


def test_a_leg_is_named_by_either_word(ros: Ros) -> None:
    """``leg`` and ``leg_name`` at the start, alike; two names that differ are refused."""
    for names in ({"leg": "rear_left"}, {"leg_name": "rear_left"}):
        node = LegNode(context=ros.context, parameter_overrides=overrides(names))
        assert node.module.leg == "rear_left"
        assert declared(node)["leg_name"] == "rear_left"
        node.destroy_node()
    both = overrides({"leg": "rear_left", "leg_name": "front_left"})
    with pytest.raises(ParameterError, match="contradict"):
        LegNode(context=ros.context, parameter_overrides=both)


@pytest.mark.parametrize("kind", [*NODES, RecorderNode])
@pytest.mark.parametrize("asked", [["--help"], ["-h", "--ros-args", "-r", "__ns:=/x"]])
def test_help_says_what_a_node_is_and_its_parameters(
    kind: Any, asked: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """All that are its own with their meaning, its groups, how ROS takes them; and it ends."""
    assert node_main(kind, asked) == 0
    said = capsys.readouterr()
    assert not said.err
    for name in documented(kind, "Parameters", []):
        if name.endswith(".*"):
            assert name in said.out.splitlines()[-1]
        else:
            assert re.search(rf"^  {name}:=.*{re.escape(OPTIONS[name].doc)}", said.out, re.M), name
    assert said.out.startswith("usage: ")
    assert "--ros-args" in said.out.splitlines()[0]
    assert str(kind.__doc__).splitlines()[0] in said.out


@pytest.mark.parametrize("kind", [*NODES, RecorderNode])
def test_an_argument_that_nobody_knows_is_refused(
    kind: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """A parameter without ``--ros-args -p``, as it is often typed: one line, and 2."""
    for given in (["world:=trainer"], ["--ros-args", "-r", "__ns:=/x", "--", "world:=trainer"]):
        assert node_main(kind, given) == 2
        error = capsys.readouterr().err
        wanted = r"error: \w+_node has no argument 'world:=trainer'; --ros-args -p .*\n"
        assert re.fullmatch(wanted, error)


@pytest.mark.parametrize("kind", NODES)
def test_parameters_cannot_be_changed_while_running(ros: Ros, kind: Any) -> None:
    """What was read once cannot be changed to something that nobody reads."""
    node = make(ros, kind)
    for name, value in declared(node).items():
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful, name


def test_a_whole_number_is_taken_for_a_real_one_and_a_float_without_fraction_for_a_whole(
    ros: Ros,
) -> None:
    """``-p gait.period:=1`` is what it looks like."""
    node = make(
        ros, SimNode, gait__period=1, gait__ticks=16.0, leg__knee_speeds=[-2, 0, 2], patience=3
    )
    values = declared(node)
    for name, value in (("gait.period", 1.0), ("patience", 3.0), ("gait.ticks", 16)):
        assert values[name] == value
        assert type(values[name]) is type(value)
    assert list(values["leg.knee_speeds"]) == [-2.0, 0.0, 2.0]


WRONG: list[tuple[Any, dict[str, Any], str]] = [
    *[
        (kind, {"gait.perod": 1.0}, r"no parameter 'gait.perod'; did you mean gait.period")
        for kind in NODES
    ],
    (CpgNode, {"nonsense": 1}, "no parameter 'nonsense'"),
    (CpgNode, {"gait": 1}, "no parameter 'gait'"),
    (CpgNode, {"gait.period": 0.05}, r"gait.period = 0.05 is out of range: 0.1 to 10.0 \[s\]"),
    (CpgNode, {"gait.period": math.nan}, "gait.period = nan is out of range"),
    (CpgNode, {"gait.period": math.inf}, "gait.period = inf is out of range"),
    (CpgNode, {"gait.period": "fast"}, "gait.period must be a number .* 'fast'"),
    (CpgNode, {"gait.period": True}, "gait.period must be a number .* True"),
    (CpgNode, {"gait.period": [0.5]}, "gait.period must be a number"),
    (CpgNode, {"gait.ticks": 32.5}, "gait.ticks must be a whole number .* 32.5"),
    (CpgNode, {"gait.ticks": 24}, "gait.ticks = 24 must be a power of two"),
    (CpgNode, {"walker.mass": -1.0}, "walker.mass = -1.0 is out of range"),  # another's, yet wrong
    (SimNode, {"leg.knee_speeds": []}, "leg.knee_speeds must not be empty"),
    (SimNode, {"leg.knee_speeds": ["up"]}, "leg.knee_speeds must be a number"),
    (SimNode, {"leg.knee_speeds": [-1.0, 1.0]}, "must rise strictly and have 0.0"),
    (SimNode, {"leg.knee_speeds": 1.0}, "leg.knee_speeds must be a list"),
    (SimNode, {"world": "moon"}, "world = 'moon' must be one of walker, trainer"),
    (SimNode, {"world": 1}, "world = 1 must be a str"),
    (SimNode, {"world": "no.such.World"}, "world = 'no.such.World': there is no module 'no'"),
    (SimNode, {"robot.legs": ["one", "two"]}, r"robot.segment has 4 entries; 2, one for each"),
    (SimNode, {"robot.legs": "one"}, "robot.legs must be a list of names, not 'one'"),
    (SimNode, {"robot.side": [1.0, 1.0, 1.0, 0.5]}, "robot.side = .* must be 1 or -1"),
    (CpgNode, {"parts.cpg": "FixedPeriod"}, "parts.cpg must be a dotted path"),
    (CpgNode, {"parts.cpg": "no.such.Cpg"}, "parts.cpg = 'no.such.Cpg': there is no module 'no'"),
    (CpgNode, {"parts.cpg": "math.pi"}, "parts.cpg = 'math.pi' is no class"),
    (LegNode, {"parts.reward": "leg_node.reward.Mine"}, "parts.reward = .*Mine' cannot be used"),
    (LegNode, {"policy": "leg_node.policy.Mine"}, "policy = .*Mine' cannot be used"),
    (TableNode, {"parts.discretizer": "math.inf"}, "parts.discretizer = 'math.inf' is no class"),
    (SimNode, {"mode": "fast"}, "mode = 'fast' must be one of lockstep, realtime"),
    (SimNode, {"cycles": -2}, "cycles = -2 must be -1 or more"),
    (SimNode, {"cycles": 1.5}, "cycles = 1.5 must be a int"),
    (SimNode, {"cycles": True}, "cycles = True must be a int"),
    (SimNode, {"gui": 1}, "gui = 1 must be a bool"),
    (SimNode, {"patience": -0.5}, "patience = -0.5 must be 0 or more"),
    (SimNode, {"patience": math.nan}, "patience = nan must be 0 or more"),
    (SimNode, {"patience": "long"}, "patience = 'long' must be a float"),
    (SimNode, {"out": "/proc/ember"}, "/proc/ember"),
    (LegNode, {"leg": ""}, "no leg ''; .*front_left, front_right, rear_left, rear_right"),
    (LegNode, {"leg": "tail"}, "no leg 'tail'"),
    (LegNode, {"leg": "middle_left"}, "no leg 'middle_left'; .*rear_right on the walker"),
    (LegNode, {"leg": 1}, "leg = 1 must be a str"),
    (LegNode, {"stage": "run"}, "stage = 'run' must be one of walk, train"),
    (LegNode, {"policy": "best"}, "policy = 'best' must be one of learned, scripted, random"),
    (LegNode, {"seed": -1}, "seed = -1 must be 0 or more"),
    (LegNode, {"seed": 1.5}, "seed = 1.5 must be a int"),
    (LegNode, {"table_patience": -1.0}, "table_patience = -1.0 must be 0 or more"),
    (LegNode, {"table_patience": math.nan}, "table_patience = nan must be 0 or more"),
    (LegNode, {"learning": "yes"}, "learning = 'yes' must be a bool"),
    (LegNode, {"table": "a.npz"}, "shares its table neither loads nor saves"),
    (LegNode, {"save": "a.npz"}, "shares its table neither loads nor saves"),
    (LegNode, {"table": "/no/such.npz", "shared": False}, "no table /no/such.npz"),
    (TableNode, {"table": "/no/such.npz"}, "no table /no/such.npz"),
    (TableNode, {"table": __file__}, "is not a whole ember_ros table"),
    (TableNode, {"stage": "run"}, "stage = 'run' must be one of walk, train"),
    (TableNode, {"state.hip_bins": 0}, "state.hip_bins = 0 is out of range"),
]


@pytest.mark.parametrize(("kind", "wrong", "names"), WRONG)
def test_a_wrong_parameter_is_a_clear_error(
    ros: Ros, kind: Any, wrong: dict[str, Any], names: str
) -> None:
    """The constructor raises an EmberError that names it; the fixture sees no node left."""
    mistaken = overrides({**NEEDED.get(kind, {}), **wrong})
    with pytest.raises(EmberError, match=names):
        kind(context=ros.context, parameter_overrides=mistaken)


@pytest.mark.parametrize("kind", NODES)
def test_parameters_of_other_nodes_are_let_pass(ros: Ros, kind: Any) -> None:
    """One parameter file serves all nodes: every group, and the options of all."""
    every = {
        name: list(s.default) if isinstance(s.default, tuple) else s.default
        for name, s in SPECS.items()
    }
    options = {name: option.default for name, option in OPTIONS.items()} | NEEDED.get(kind, {})
    node = kind(context=ros.context, parameter_overrides=overrides(every | options))
    node.destroy_node()


def test_a_table_of_other_cells_is_refused(ros: Ros, tmp_path: Path) -> None:
    """A table learnt with another partition says so, whoever loads it."""
    other = Params()
    file = tmp_path / "table.npz"
    save_table(file, empty_table(other), other, 0)
    wrong = {"table": str(file), "state.hip_low": -0.6}
    with pytest.raises(TableError, match="another partition"):
        TableNode(context=ros.context, parameter_overrides=overrides(wrong))
    with pytest.raises(TableError, match="another partition"):
        LegNode(
            context=ros.context,
            parameter_overrides=overrides({**wrong, "shared": False, "leg": "leg"}),
        )
    with pytest.raises(ParameterError, match="neither loads nor saves"):
        make(ros, LegNode, table=str(file))


# -- the CPG -----------------------------------------------------------------------------------


def test_a_cpg_publishes_the_phase_of_every_clock(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It follows the clock, back to the start too; what is repeated is answered again."""
    monkeypatch.setattr("cpg_node.node.JUMP_S", 0.0)
    node = make(ros, CpgNode)
    phases = ros.messages(topics.PHASE, raw=True)
    clock = ros.publisher(topics.CLOCK)
    said: list[bytes] = []
    for tick in [0, 1, 2, 2, -1, 3, 32, 33, 0, 1]:
        clock.publish(cdr.pack_clock(tick * TICK_NS))
        if tick >= 0:
            said.append(wire.BeatWire(TICK_NS).pack(Beat(tick, tick / 32)))
        ros.spin_until(lambda: len(phases) >= len(said), f"phase of tick {tick}")
        ros.spin_once(0.0)
    assert phases == said
    assert declared(node)["gait.ticks"] == 32


# -- a leg alone -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tape() -> SignalLog:
    """Record four cycles of the walker."""
    loop, tape = Loop(RunConfig("walker", 4, seed=7)), SignalLog()
    for _ in range(128):
        loop.tick(tape)
    loop.close()
    return tape


def alone(leg: str, tape: SignalLog) -> tuple[list[bytes], str]:
    """Return the commands of a leg without ROS to which a tape is played, and its table's hash."""
    module = make_leg(Params(), leg, seed=3, shared=False)
    pack = wire.CommandWire(leg, TICK_NS).pack
    commands = [
        pack(module.tick(senses[LEGS.index(leg)], beat)) for beat, senses, _ in tape.signals
    ]
    assert module.copy.table.visits.sum() == len(tape.signals) - 1
    return commands, module.copy.table.sha256()


def play(
    ros: Ros,
    leg: str,
    tape: SignalLog,
    order: Callable[[int], Sequence[int]] = lambda n: (0, 1, 2),
    between: Callable[[int], None] = lambda n: None,
) -> tuple[list[bytes], Any]:
    """Return the commands of a leg that does not share, to which a tape is played, and the leg.

    ``order`` says in what order joints, contact and phase of a tick are said.
    """
    node = make(ros, LegNode, leg=leg, shared=False, seed=3)
    answers = ros.messages(topics.command(leg), raw=True)
    received = (topics.joint_states(leg), topics.contact(leg), topics.PHASE)
    publishers = [ros.publisher(topic) for topic in received]
    packer = wire.SenseWire(leg, TICK_NS)
    for n, (beat, senses, _) in enumerate(tape.signals):
        between(n)
        data = [*packer.pack(senses[LEGS.index(leg)]), wire.BeatWire(TICK_NS).pack(beat)]
        for which in order(n):
            publishers[which].publish(data[which])
            ros.spin_once(0.0)
        ros.spin_until(lambda n=n: len(answers) > n, f"a command for tick {n}")  # type: ignore[misc]
    return answers, node


@pytest.mark.parametrize("seed", [0, 1])
def test_what_other_legs_hear_and_say_changes_no_bit_of_a_leg(
    ros: Ros, tape: SignalLog, seed: int
) -> None:
    """Locality: a leg fed recorded senses and phases commands and learns the same, bit for bit.

    All other legs' topics carry random garbage meanwhile, well formed and malformed.
    """
    rng = np.random.default_rng(seed)
    others = [leg for leg in (*LEGS, "leg") if leg != "rear_left"]
    publishers = [
        ros.publisher(topic(leg), matched=False)
        for leg in others
        for topic in (topics.joint_states, topics.contact, topics.command)
    ]

    def garbage(n: int) -> None:
        for which in rng.permutation(len(publishers)):
            leg = others[rng.integers(len(others))]
            sensed = [float(number) for number in rng.normal(0.0, 9.0, 8)]
            sense = LegSense._make([int(rng.integers(200)), *sensed, True, False, True])
            texts = (*wire.SenseWire(leg, TICK_NS).pack(sense), rng.bytes(20))
            publishers[which].publish(texts[rng.integers(len(texts))])

    commands, node = play(ros, "rear_left", tape, between=garbage)
    assert (commands, node.module.copy.table.sha256()) == alone("rear_left", tape)
    assert node.refused == 0


def test_a_leg_answers_whatever_order_a_tick_comes_in(ros: Ros, tape: SignalLog) -> None:
    """Senses and phase of a tick may come in any order, and twice; the commands are the same."""
    rng = np.random.default_rng(0)

    def order(n: int) -> Sequence[int]:
        first, second, third = rng.permutation(3).tolist()
        return first, second, first, third

    commands, node = play(ros, "front_left", tape, order)
    assert (commands, node.module.copy.table.sha256()) == alone("front_left", tape)


def test_a_leg_begins_when_both_services_of_the_table_are_there(ros: Ros, tape: SignalLog) -> None:
    """While ``table/push`` is not served yet its first push would be lost: it waits for both."""
    shared = SharedTable(
        empty_table(Params()), legs=4, cells=cells_sha256(Params()), rate=Params().walk.rate
    )
    pulls: list[Any] = []

    def pull(
        request: GetParameters.Request, response: GetParameters.Response
    ) -> GetParameters.Response:
        pulls.append(request)
        since, upto, wanted = calls.read_pull(request)
        response.values = calls.write_pull_response(
            wanted, shared.pull(since, upto), cells_sha256(Params()), str
        )
        return response

    make(ros, LegNode, leg="rear_left")
    topics.PULL.serve(ros.node, pull)
    answers = ros.messages(topics.command("rear_left"), raw=True)
    beat, senses, _ = tape.signals[0]
    joints, contact = wire.SenseWire("rear_left", TICK_NS).pack(senses[2])
    ros.publisher(topics.joint_states("rear_left")).publish(joints)
    ros.publisher(topics.contact("rear_left")).publish(contact)
    ros.publisher(topics.PHASE).publish(wire.BeatWire(TICK_NS).pack(beat))
    for _ in range(40):
        ros.spin_once()
    assert not pulls
    assert not answers
    topics.PUSH.serve(ros.node, lambda request, response: response)
    ros.spin_until(lambda: answers, "the first command")
    assert len(pulls) == 1


def test_a_leg_without_a_table_says_whom_it_waits_for(
    ros: Ros, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Where no table_node was started, or in another namespace, it names the services it needs."""
    monkeypatch.setattr("leg_node.node.WAIT_S", 0.0)
    said: list[str] = []

    def says(text: str) -> bool:
        said.append(capfd.readouterr().err)
        return text in "".join(said)

    leg = make(ros, LegNode, "/robot")
    ros.spin_until(
        lambda: says("waiting for the table_node: no node serves /robot/table/push"), "it says so"
    )
    ros.remove(leg)
    make(ros, TableNode)
    ros.client(topics.PULL)
    make(ros, LegNode)
    for _ in range(40):
        ros.spin_once()
    assert not says("waiting for the table_node: no node serves /table/push")


def test_a_publisher_that_cannot_be_heard_is_named_with_what_would_be_right(
    ros: Ros, capfd: pytest.CaptureFixture[str]
) -> None:
    """A real leg's command with the default quality of service is volatile, and reaches nobody."""
    make(ros, SimNode, world="trainer")
    kind = topics.class_of(topics.JOINT_STATE)
    publisher = ros.node.create_publisher(kind, "leg/command", 10)
    said: list[str] = []

    def says() -> bool:
        said.append(capfd.readouterr().err)
        return (
            "no messages from a publisher of /leg/command: its durability is incompatible; "
            "reliable, transient_local and keep_last would be right"
        ) in "".join(said)

    ros.spin_until(says, "which topic, and what would be right")
    ros.node.destroy_publisher(publisher)


def test_a_table_is_needed_as_long_as_a_leg_is_there(ros: Ros) -> None:
    """It goes on serving who could hand in; legs that share nothing are nothing to it."""
    table = make(ros, TableNode)
    make(ros, LegNode, "/alone", shared=False)
    assert not table.is_needed()
    leg = make(ros, LegNode)
    ros.spin_until(table.is_needed, "the leg is seen")
    ros.remove(leg)
    ros.spin_until(lambda: not table.is_needed(), "the leg is gone")


# -- the table's services ----------------------------------------------------------------------


def fill(table: Any, seed: int) -> None:
    """Put something into a table."""
    rng = np.random.default_rng(seed)
    table.values[:] = rng.normal(size=len(table))
    table.visits[:] = rng.integers(0, 50, len(table))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Save a table in which something stands."""
    table = empty_table(Params())
    fill(table, 0)
    save_table(tmp_path / "before.npz", table, Params(), 4)
    return tmp_path / "before.npz"


GOOD = UpdateBatch(
    1, "a run", 5, cells_sha256(Params()), (TDUpdate(160, 3, 0.5), TDUpdate(161, 4, -0.25))
)


def push_with(name: str, **fields: Any) -> SetParametersAtomically.Request:
    """Return a good push with one field's value changed, or without the field."""
    request = calls.write_push(GOOD)
    if fields:
        (value,) = (p.value for p in request.parameters if p.name == name)
        for key, content in fields.items():
            setattr(value, key, content)
    else:
        request.parameters = [p for p in request.parameters if p.name != name]
    return request


def push_and(name: str) -> SetParametersAtomically.Request:
    """Return a good push with a field more."""
    request = calls.write_push(GOOD)
    request.parameters.append(Parameter(name, value=1).to_parameter_msg())
    return request


FIELDS = ("leg", "run", "epoch", "cells_sha256", "tick", "cell", "target")
MALFORMED = [
    *[(push_with(name), f"{name} missing") for name in FIELDS],
    (push_and("more"), "'more' is unknown"),
    (push_and("leg"), "'leg' is .*repeated"),
    (push_with("leg", type=ParameterType.PARAMETER_DOUBLE), "leg has parameter type 3"),
    (push_with("target", type=ParameterType.PARAMETER_NOT_SET), "target has parameter type 0"),
    (push_with("tick", integer_array_value=array("q", [160])), "tick, cell and target have"),
    (push_with("target", double_array_value=array("d", [0.5] * 3)), "tick, cell and target have"),
    (push_with("target", double_array_value=array("d", [0.5, math.nan])), "target of cell 4 .*nan"),
    (push_with("target", double_array_value=array("d", [math.inf, 0.0])), "target of cell 3 .*inf"),
    (push_with("cell", integer_array_value=array("q", [3, -1])), "cell -1 is not in 0 to"),
    (push_with("cell", integer_array_value=array("q", [3, 2**40])), "cell 1099511627776 is not"),
    (push_with("tick", integer_array_value=array("q", [-1, 161])), "tick -1"),
    (push_with("cells_sha256", string_value="f" * 64), "cells"),
    (push_with("leg", integer_value=-1), "leg -1"),
    (push_with("epoch", integer_value=-5), "epoch -5"),
    (push_with("run", string_value=""), "run ''"),
    (SetParametersAtomically.Request(), "missing"),
]


def everything(ros: Ros, client: Any) -> tuple[int, bytes, bytes]:
    """Return the version, values and visits of the whole table, by the service."""
    request = GetParameters.Request(names=["version", "values", "visits"])
    version, values, visits = ros.call(client, request).values
    return (
        version.integer_value,
        values.double_array_value.tobytes(),
        visits.integer_array_value.tobytes(),
    )


def test_malformed_pushes_are_refused_with_a_reason_and_change_nothing(
    ros: Ros, file: Path
) -> None:
    """Each kind of nonsense gets ``successful`` false and a reason that names it, no more."""
    node = make(ros, TableNode, table=str(file))
    push, pull = ros.client(topics.PUSH), ros.client(topics.PULL)
    before = everything(ros, pull)
    for count, (request, names) in enumerate(MALFORMED, 1):
        result = ros.call(push, request).result
        assert not result.successful, names
        assert re.search(names, result.reason), result.reason
        assert node.refused == count
    node.shared.merge()
    assert everything(ros, pull) == before
    assert node.shared.table.sha256() == load_table(file, Params())[0].sha256()


def test_a_push_is_merged_once_however_often_it_comes(ros: Ros) -> None:
    """Acknowledged, merged by a pull of its epoch; said again, before or after, changes nothing."""
    node = make(ros, TableNode)
    push, pull = ros.client(topics.PUSH), ros.client(topics.PULL)
    version = everything(ros, pull)[0]
    for n in range(3):
        result = ros.call(push, calls.write_push(GOOD)).result
        assert result.successful
        assert bool(result.reason) == bool(n)  # "received before"
    assert node.shared.table.visits.sum() == 0
    changes = changes_of(ros.call(pull, calls.write_pull(version, 4)))
    assert (changes.version, len(changes.cells)) == (version, 0)
    changes = changes_of(ros.call(pull, calls.write_pull(version, 5)))
    assert changes.version > version
    assert (changes.cells.tolist(), changes.values.tolist()) == ([3, 4], [0.5, -0.25])
    assert changes.visits.tolist() == [1, 1]
    merged = everything(ros, pull)
    assert ros.call(push, calls.write_push(GOOD)).result.successful
    ros.call(pull, calls.write_pull(version, 9))
    assert everything(ros, pull) == merged
    assert node.refused == 0
    # Another life of the same leg is another push.
    assert ros.call(push, calls.write_push(GOOD._replace(run="another"))).result.reason == ""
    ros.call(pull, calls.write_pull(version, 5))
    assert node.shared.table.visits.sum() == 4


def test_the_order_in_which_pushes_come_does_not_matter(ros: Ros) -> None:
    """Pairs of one epoch are merged in the order of ticks and legs."""
    pushes = [
        UpdateBatch(leg, f"run {leg}", 0, GOOD.cells_sha256,
             tuple(TDUpdate(tick, 7, (leg + 1) / (tick + 3)) for tick in range(5)))
        for leg in range(4)
    ]  # fmt: skip
    tables = set()
    for order in ([0, 1, 2, 3], [3, 1, 0, 2], [2, 3, 1, 0]):
        node = make(ros, TableNode)
        push, pull = ros.client(topics.PUSH), ros.client(topics.PULL)
        for leg in order:
            assert ros.call(push, calls.write_push(pushes[leg])).result.successful
        ros.call(pull, calls.write_pull(None, 0))
        assert node.shared.table.visits[7] == 20
        tables.add(node.shared.table.sha256())
        ros.remove(node)
    assert len(tables) == 1


def test_the_whole_table_can_be_pulled(ros: Ros, file: Path) -> None:
    """One call answers with every cell, and with what the table is about; so does a first pull."""
    make(ros, TableNode, table=str(file), seed=11)
    pull = ros.client(topics.PULL)
    table = load_table(file, Params())[0]
    request = GetParameters.Request(names=["values", "cells", "about", "visits"])
    values, cells, about, visits = ros.call(pull, request).values
    assert values.double_array_value.tobytes() == table.values.tobytes()
    assert visits.integer_array_value.tobytes() == table.visits.tobytes()
    assert list(cells.integer_array_value) == list(range(len(table)))
    assert '"seed": 11' in about.string_value
    first = changes_of(ros.call(pull, calls.write_pull(None, -1)))
    assert first.values.tobytes() == table.values.tobytes()
    assert first.visits.tobytes() == table.visits.tobytes()


def changes_of(response: GetParameters.Response) -> Changes:
    """Return the changes that a table of the default parameters answers with."""
    return calls.read_changes(response, empty_table(Params()), cells_sha256(Params()))


@pytest.mark.parametrize("name", ["value", "since=x", f"since={2**63}", f"upto={2**64}"])
def test_a_malformed_pull_is_answered_nothing_and_the_node_lives(ros: Ros, name: str) -> None:
    """Nobody can bring the table down with a pull typed at a terminal."""
    node = make(ros, TableNode)
    pull = ros.client(topics.PULL)
    answer = ros.call(pull, GetParameters.Request(names=[name, "version"]))
    assert not answer.values
    assert node.refused == 1
    (version,) = ros.call(pull, GetParameters.Request(names=["version"])).values
    assert version.type == ParameterType.PARAMETER_INTEGER


def test_save_writes_the_table_and_says_where(ros: Ros, tmp_path: Path, file: Path) -> None:
    """Save answers with path and SHA-256 of a file that loads, pushes of the day included."""
    target = tmp_path / "deep" / "after.npz"
    node = make(ros, TableNode, table=str(file), save=str(target), seed=9)
    push, save = ros.client(topics.PUSH), ros.client(topics.SAVE)
    ros.call(push, calls.write_push(GOOD))
    answer = ros.call(save, Trigger.Request())
    assert answer.success
    before, _ = load_table(file, Params())
    after, about = load_table(target, Params())
    assert answer.message == f"{target}: {after.sha256()}"
    assert about["seed"] == 9
    assert after.visits.sum() == before.visits.sum() + 2
    node.finish(lambda: None)
    assert load_table(target, Params())[0].sha256() == after.sha256()


def test_save_without_a_path_says_what_to_do(ros: Ros) -> None:
    """Success is false, the message says how to give a path, the node goes on."""
    make(ros, TableNode)
    save = ros.client(topics.SAVE)
    for _ in range(2):
        answer = ros.call(save, Trigger.Request())
        assert not answer.success
        assert "save:=FILE" in answer.message


def test_save_to_where_nothing_can_be_written_says_so(ros: Ros, tmp_path: Path) -> None:
    """Success is false, the message names file and reason, and the next save may succeed."""
    folder = tmp_path / "folder"
    node = make(ros, TableNode, save=str(folder / "table.npz"))
    save = ros.client(topics.SAVE)
    shutil.rmtree(folder, ignore_errors=True)
    folder.write_text("a file where a folder should be")
    answer = ros.call(save, Trigger.Request())
    assert not answer.success
    assert f"cannot write the table {folder / 'table.npz'}" in answer.message
    folder.unlink()
    assert ros.call(save, Trigger.Request()).success
    node.finish(lambda: None)


def test_a_table_that_could_never_be_saved_is_refused_at_once(ros: Ros, tmp_path: Path) -> None:
    """Not after hours of learning: the constructor says that ``save`` cannot be written."""
    (tmp_path / "folder").write_text("a file where a folder should be")
    with pytest.raises(TableError, match=r"cannot open .*folder/table\.npz\.store"):
        TableNode(
            context=ros.context,
            parameter_overrides=overrides({"save": str(tmp_path / "folder" / "table.npz")}),
        )


def test_saving_changes_nothing_of_what_is_learnt_after(ros: Ros, tmp_path: Path) -> None:
    """A save between two legs' pushes of one epoch leaves their order of merging alone."""
    first, second = (
        UpdateBatch(leg, f"run {leg}", 0, GOOD.cells_sha256, (TDUpdate(3, 7, target),))
        for leg, target in ((0, 1.0), (1, -0.3))
    )
    tables = set()
    for saves in (False, True):
        node = make(ros, TableNode, save=str(tmp_path / f"table_{saves}.npz"))
        push, pull, save = map(ros.client, (topics.PUSH, topics.PULL, topics.SAVE))
        for leg in (second, first):
            for n in range(3):
                updates = (TDUpdate(3 + n, 7, leg.updates[0].target / (n + 1)),)
                push_ = leg._replace(epoch=n, updates=updates)
                assert ros.call(push, calls.write_push(push_)).result.successful
            if saves:
                assert ros.call(save, Trigger.Request()).success
        ros.call(pull, calls.write_pull(None, 2))
        tables.add(node.shared.table.sha256())
        node.finish(lambda: None)
        ros.remove(node)
    assert len(tables) == 1


def test_what_was_acknowledged_outlives_the_node(ros: Ros, tmp_path: Path) -> None:
    """A node that ends without a word leaves all pushes to the next one, which knows them again."""
    pushes = [GOOD._replace(epoch=epoch, leg=leg) for epoch in (5, 6, 7) for leg in range(4)]
    tables = set()
    for cut in (None, 0, 5, 11):
        options = {"save": str(tmp_path / f"table_{cut}.npz")}
        node = make(ros, TableNode, **options)
        push, pull = ros.client(topics.PUSH), ros.client(topics.PULL)
        for n, each in enumerate(pushes):
            assert ros.call(push, calls.write_push(each)).result.reason == ""
            if n == 5:
                ros.call(pull, calls.write_pull(None, 5))  # some are merged, some are not
            if n == cut:
                ros.remove(node)
                node = make(ros, TableNode, **options)
                assert ros.call(push, calls.write_push(each)).result.successful
                assert "received before" in ros.call(push, calls.write_push(each)).result.reason
        ros.call(pull, calls.write_pull(None, 7))
        tables.add(node.shared.table.sha256())
        node.finish(lambda: None)
        ros.remove(node)
        assert [file.name for file in tmp_path.glob(f"table_{cut}*")] == [f"table_{cut}.npz"]
    assert len(tables) == 1


def test_learning_can_be_switched_off_and_on(ros: Ros) -> None:
    """While off, pushes are acknowledged and dropped; on again, they are merged."""
    node = make(ros, TableNode)
    push, pull, learning = map(ros.client, (topics.PUSH, topics.PULL, topics.LEARNING))
    for epoch, on in enumerate((True, False, False, True), start=5):
        answer = ros.call(learning, SetBool.Request(data=on))
        assert answer.success
        assert ("merged" if on else "dropped") in answer.message
        assert ros.call(push, calls.write_push(GOOD._replace(epoch=epoch))).result.successful
    ros.call(pull, calls.write_pull(None, 9))
    assert node.shared.table.visits.sum() == 2 * len(GOOD.updates)
    assert node.refused == 0


def test_a_sim_node_writes_over_no_run_of_ember(ros: Ros, tmp_path: Path) -> None:
    """Its record beside another one's summary would be neither's."""
    assert FINISHED == SUMMARY
    (tmp_path / SUMMARY).write_text("{}")
    (tmp_path / "cycles.csv").write_text("theirs")
    with pytest.raises(ParameterError, match=r"holds a run of `ember`"):
        make(ros, SimNode, out=str(tmp_path))
    assert (tmp_path / "cycles.csv").read_text() == "theirs"


def test_a_saved_table_is_continued_and_only_an_explicit_option_starts_anew(
    ros: Ros, tmp_path: Path, file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """README's command, given twice: what was learned in between is not lost."""
    options = {"table": str(file), "save": str(tmp_path / "walked.npz")}
    visits: list[int] = []
    for epoch, more in ((5, {}), (6, {}), (5, {"fresh": True})):
        node = make(ros, TableNode, **options, **more)
        push = ros.client(topics.PUSH)
        updates = tuple(u._replace(tick=32 * epoch + n) for n, u in enumerate(GOOD.updates))
        good = GOOD._replace(run=f"run {len(visits)}", epoch=epoch, updates=updates)
        assert ros.call(push, calls.write_push(good)).result.successful
        node.finish(lambda: None)
        ros.remove(node)
        visits.append(load_table(tmp_path / "walked.npz", Params())[0].visits.sum())
        ros.node.destroy_client(push)
    start = load_table(file, Params())[0].visits.sum()
    assert visits == [start + 2, start + 4, start + 2]
    assert f"the parameter table = {file} is ignored" in capfd.readouterr().err


def test_two_tables_of_one_file_are_one_too_many(ros: Ros, tmp_path: Path) -> None:
    """In two namespaces, with the same file: the second one is refused, and the first goes on."""
    options = {"save": str(tmp_path / "table.npz")}
    node = make(ros, TableNode, "/one", **options)
    with pytest.raises(TableError, match="belongs to another table_node"):
        make(ros, TableNode, "/two", **options)
    node.finish(lambda: None)
    assert [each.name for each in tmp_path.iterdir()] == ["table.npz"]


def test_a_push_that_cannot_be_stored_is_kept_by_the_leg(ros: Ros, tmp_path: Path) -> None:
    """The file is gone: the legs walk on alone, and hand everything in when it can be stored."""
    save = tmp_path / "table.npz"
    config = RunConfig("walker", 1000, seed=3)
    robot = Robot(ros, config, sim_node={"patience": PATIENCE_S}, table_node={"save": str(save)})
    robot.spin_to_tick(40)
    store = Path(f"{save}.store")
    store.rename(tmp_path / "away")
    legs = [robot.nodes[f"leg_{leg}"] for leg in LEGS]
    ros.spin_until(lambda: all(leg._table_absent for leg in legs), "all legs walk alone")
    robot.spin_to_tick(robot.tick + 100)
    waiting = [leg.module.copy.oldest_unacknowledged() for leg in legs]
    assert all(waiting)
    (tmp_path / "away").rename(store)
    ros.spin_until(lambda: not any(leg._table_absent for leg in legs), "the table takes pushes")
    robot.spin_to_tick(robot.tick + 64)
    assert all(leg.module.copy.oldest_unacknowledged() not in waiting for leg in legs)
    robot.finish()
    falls = robot.sim.recorder.summary()["falls"]
    table, _ = load_table(save, Params())
    expected = 4 * (robot.tick - 1 - falls)  # and the legs that have sensed the present tick
    assert expected <= table.visits.sum() <= expected + 4
