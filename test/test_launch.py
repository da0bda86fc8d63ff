"""The launch files, read and started as ``ros2 launch`` does, with each argument they document.

No wheel brings launch and launch_ros. What stands for them here refuses what they refuse: keywords
they do not know, a ``ParameterValue`` whose value is neither of its type nor a substitution, an
argument that is none of its choices, a substitution of something that nobody set.
"""

from __future__ import annotations

import os
import re
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from ember_ros.errors import ParameterError
from ember_ros.params import TRAINER_LEG
from ember_ros.params_file import CONFIG, load_params
from support.legs import LEGS

LAUNCH = Path(__file__).resolve().parents[1] / "ember_ros" / "launch"
FILES = sorted(path.name for path in LAUNCH.glob("*.launch.py"))
SCALARS = (int, float, bool, str)


class Substitution:
    """``launch.Substitution``: a text that is known when the file is launched."""


class LaunchConfiguration(Substitution):
    """``launch.substitutions.LaunchConfiguration``: the value of an argument."""

    def __init__(self, variable_name: str) -> None:
        assert isinstance(variable_name, str)
        self._name = variable_name

    def perform(self, context: LaunchContext) -> str:
        """Return the value; a KeyError stands for launch's SubstitutionFailure."""
        return context.launch_configurations[self._name]


class LaunchContext:
    """``launch.LaunchContext``, as far as it knows arguments."""

    def __init__(self, **given: str) -> None:
        self.launch_configurations = given


class ParameterValue:
    """``launch_ros.parameter_descriptions.ParameterValue``: coerces a substitution, nothing else.

    As ``launch.utilities.type_utils`` has it: a scalar must be of the type already; the text of a
    substitution is made an int or float by Python, a bool by YAML.
    """

    def __init__(self, value: Any, *, value_type: type | None = None) -> None:
        if isinstance(value, SCALARS):
            if value_type is not None and not isinstance(value, value_type):
                raise TypeError(f"{value=} is not an instance of {value_type}")
        elif not isinstance(value, Substitution):
            raise TypeError("value should be either a scalar or a substitution")
        self._value, self._type = value, value_type

    def evaluate(self, context: LaunchContext) -> Any:
        """Return the parameter's value."""
        if not isinstance(self._value, LaunchConfiguration):
            return self._value
        text = self._value.perform(context)
        if self._type is str:
            return text
        if self._type in (int, float):
            return self._type(text)
        value = yaml.safe_load(text)
        if not isinstance(value, self._type or SCALARS):
            raise ValueError(f"Cannot convert value '{text}' to '{self._type}'")
        return value


class Shutdown:
    """``launch.actions.Shutdown``."""

    def __init__(self, *, reason: str = "reason not given") -> None:
        self.reason = reason


class Node:
    """``launch_ros.actions.Node``, with those of its keywords that are used here."""

    def __init__(
        self,
        *,
        executable: str,
        package: str | None = None,
        name: str | None = None,
        namespace: str | None = None,
        parameters: list[Any] | None = None,
        output: str = "log",
        on_exit: list[Any] | None = None,
    ) -> None:
        for parameter in parameters or []:
            if not isinstance(parameter, (str, os.PathLike, dict)):
                raise TypeError(f"parameters: {parameter!r} is neither a file nor a dictionary")
        self.executable, self.package, self.name = executable, package, name
        self.namespace, self.on_exit = namespace, on_exit
        self._parameters = parameters or []

    def parameters(self, context: LaunchContext) -> list[Any]:
        """Return the files as they are, and dictionaries as they come out of the written file."""
        return [self._written(p, context) if isinstance(p, dict) else p for p in self._parameters]

    @staticmethod
    def _written(parameters: dict[str, Any], context: LaunchContext) -> Any:
        values = {}
        for name, value in parameters.items():
            if isinstance(value, ParameterValue):
                values[name] = value.evaluate(context)
            elif isinstance(value, str):  # launch_ros reads a plain text by YAML's rules
                values[name] = yaml.safe_load(value)
            else:
                values[name] = value
            assert isinstance(values[name], SCALARS)
        return yaml.safe_load(yaml.dump(values))


class DeclareLaunchArgument:
    """``launch.actions.DeclareLaunchArgument``."""

    def __init__(
        self,
        name: str,
        *,
        default_value: str | None = None,
        description: str | None = None,
        choices: list[str] | None = None,
    ) -> None:
        assert isinstance(name, str)
        assert default_value is None or isinstance(default_value, str)
        assert choices is None or default_value in choices
        self.name, self.default_value = name, default_value
        self.description, self._choices = description, choices

    def execute(self, context: LaunchContext) -> None:
        """Set the default unless a value is there; refuse what is none of the choices."""
        if self.name not in context.launch_configurations:
            if self.default_value is None:
                raise RuntimeError(f'Required launch argument "{self.name}" was not provided.')
            context.launch_configurations[self.name] = self.default_value
        value = context.launch_configurations[self.name]
        if self._choices is not None and value not in self._choices:
            raise RuntimeError(f'Argument "{self.name}" provided value "{value}" is not valid.')


class OpaqueFunction:
    """``launch.actions.OpaqueFunction``: what it does is not seen before it is launched."""

    def __init__(self, *, function: Callable[[LaunchContext], list[Any]]) -> None:
        self.function = function


class PythonLaunchDescriptionSource:
    """``launch.launch_description_sources.PythonLaunchDescriptionSource``."""

    def __init__(self, launch_file_path: Any) -> None:
        self.path = launch_file_path


class IncludeLaunchDescription:
    """``launch.actions.IncludeLaunchDescription``."""

    def __init__(
        self,
        launch_description_source: PythonLaunchDescriptionSource,
        *,
        launch_arguments: Iterable[tuple[str, str]] | None = None,
    ) -> None:
        self.source = launch_description_source
        self.launch_arguments = dict(launch_arguments or ())


class LaunchDescription:
    """``launch.LaunchDescription``."""

    def __init__(self, initial_entities: Iterable[Any] | None = None) -> None:
        self.entities = list(initial_entities or ())


PARTS: dict[str, tuple[Any, ...]] = {
    "launch": (LaunchContext, LaunchDescription, Substitution),
    "launch.actions": (DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, Shutdown),
    "launch.launch_description_sources": (PythonLaunchDescriptionSource,),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.parameter_descriptions": (ParameterValue,),
}


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let launch files import launch and launch_ros."""
    for name, classes in PARTS.items():
        module = ModuleType(name)
        module.__dict__.update({each.__name__: each for each in classes}, __path__=[])
        monkeypatch.setitem(sys.modules, name, module)


def described(file: str | Path) -> list[Any]:
    """Return the entities of a launch file."""
    entities: list[Any] = runpy.run_path(str(file))["generate_launch_description"]().entities
    return entities


def shown(entities: list[Any]) -> dict[str, DeclareLaunchArgument]:
    """Return the arguments that ``--show-args`` finds: nothing is launched, the first one holds."""
    found: dict[str, DeclareLaunchArgument] = {}
    for entity in entities:
        if isinstance(entity, DeclareLaunchArgument):
            found.setdefault(entity.name, entity)
        elif isinstance(entity, IncludeLaunchDescription) and isinstance(entity.source.path, str):
            for name, argument in shown(described(entity.source.path)).items():
                found.setdefault(name, argument)
    return found


def visit(entities: list[Any], context: LaunchContext) -> list[Node]:
    """Return the nodes that are started."""
    nodes = []
    for entity in entities:
        if isinstance(entity, DeclareLaunchArgument):
            entity.execute(context)
        elif isinstance(entity, OpaqueFunction):
            nodes += entity.function(context)
        elif isinstance(entity, IncludeLaunchDescription):
            context.launch_configurations |= entity.launch_arguments
            nodes += visit(described(entity.source.path), context)
        else:
            assert isinstance(entity, Node)
            nodes.append(entity)
    return nodes


class Launched:
    """What ``ros2 launch ember_ros FILE name:=value ...`` starts."""

    def __init__(self, file: str, **given: str) -> None:
        entities = described(LAUNCH / file)
        assert set(given) <= set(shown(entities))
        context = LaunchContext(**given)
        self.nodes: dict[Any, Node] = {node.name: node for node in visit(entities, context)}
        self.parameters = {
            name: node.parameters(context) for name, node in self.nodes.items()
        }  # when launch_ros evaluates them


WHOLE = {
    "walk.launch.py": ("walker", "walk", LEGS),
    "train.launch.py": ("trainer", "train", (TRAINER_LEG,)),
}


@pytest.mark.parametrize("file", FILES)
def test_a_launch_file_starts_the_whole_graph(file: str) -> None:
    """One sim, one generator, one table, and every leg of that world under a name of its own.

    No recorder: the world itself records if it is given a bag.
    """
    world, stage, legs = WHOLE[file]
    launched = Launched(file)
    assert {name: node.executable for name, node in launched.nodes.items()} == {
        **{node: node for node in ("sim_node", "cpg_node", "table_node")},
        **{f"leg_{leg}": "leg_node" for leg in legs},
    }
    assert {node.package for node in launched.nodes.values()} == {"ember_ros"}
    assert launched.parameters == {
        "sim_node": [{"world": world}],
        "cpg_node": [{"world": world}],
        "table_node": [{"stage": stage}],
        **{f"leg_{leg}": [{"leg": leg, "stage": stage}] for leg in legs},
    }


@pytest.mark.parametrize("file", FILES)
def test_whoever_ends_ends_the_launch(file: str) -> None:
    """A table that cannot be loaded leaves nobody waiting, and no node runs on after the world."""
    for name, node in Launched(file).nodes.items():
        assert node.on_exit, name
        (ending,) = node.on_exit
        assert isinstance(ending, Shutdown)
        assert name in ending.reason


VALUES: dict[str, tuple[str, dict[str, Any]]] = {
    "table": ("t.npz", {"table_node": "t.npz"}),
    "save": ("1.5", {"table_node": "1.5"}),
    "cycles": ("20", {"sim_node": 20}),
    "seed": ("3", {"sim_node": 3, "table_node": 3, "legs": 3}),
    "gui": ("true", {"sim_node": True}),
    "bag": ("7", {"sim_node": "7"}),
    "mode": ("realtime", {"sim_node": "realtime"}),
}
"""For each argument that is a parameter: a value, and what the nodes are given, type and all."""


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("argument", VALUES)
def test_an_argument_becomes_the_parameter_it_names(file: str, argument: str) -> None:
    """A number as a number, a text as a text even where it looks like a number; nobody else's."""
    text, expected = VALUES[argument]
    for name, (parameters,) in {
        name: given or [{}] for name, given in Launched(file, **{argument: text}).parameters.items()
    }.items():
        kind = "legs" if name.startswith("leg_") else name
        assert parameters.get(argument) == expected.get(kind), name
        assert type(parameters.get(argument)) is type(expected.get(kind)), name


@pytest.mark.parametrize("file", FILES)
def test_every_argument_is_shown_with_what_it_means(file: str) -> None:
    """``--show-args`` lists all, with a description, and the world that this file starts."""
    arguments = shown(described(LAUNCH / file))
    assert set(arguments) == {*VALUES, "world", "namespace", "params_file"}
    assert all(argument.description for argument in arguments.values())
    assert arguments["world"].default_value == WHOLE[file][0]


@pytest.mark.parametrize("file", FILES)
def test_examples_in_docs_name_arguments_that_are(file: str) -> None:
    """Each ``ros2 launch`` line of the documents and of the file itself can be typed."""
    root = LAUNCH.parents[1]
    pages = (root / "README.md", *root.glob("docs/*.md"), *LAUNCH.glob("*.py"))
    lines = [
        line
        for page in pages
        for line in re.findall(rf"ros2 launch ember_ros {file}(.*)", page.read_text())
    ]
    assert lines
    for line in lines:
        given = dict(re.findall(r"(\w+):=(\S+)", line.partition("`")[0]))
        assert given
        Launched(file, **given)


def test_namespace_and_parameter_file_are_every_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file comes before the arguments, so that these win; its ~ is somebody's home."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "p.yaml").write_text("/**:\n  ros__parameters:\n    patience: 2.0\n")
    launched = Launched("walk.launch.py", namespace="robot", params_file="~/p.yaml", seed="3")
    assert {node.namespace for node in launched.nodes.values()} == {"robot"}
    for parameters in launched.parameters.values():
        assert parameters[0] == str(tmp_path / "p.yaml")
    assert launched.parameters["sim_node"][1] == {"world": "walker", "seed": 3}


def test_there_is_a_node_for_every_leg_that_the_parameter_file_describes() -> None:
    """Six legs of a hexapod; on the trainer one, whatever the file says."""
    file = str(CONFIG / "hexapod.yaml")
    six = load_params("hexapod").robot.legs
    assert len(six) == 6
    for name, legs in (("walk.launch.py", six), ("train.launch.py", (TRAINER_LEG,))):
        launched = Launched(name, params_file=file)
        found = [each for each in launched.nodes if each.startswith("leg_")]
        assert found == [f"leg_{leg}" for leg in legs]
        for leg in legs:
            parameters = launched.parameters[f"leg_{leg}"]
            assert parameters == [file, {"leg": leg, "stage": WHOLE[name][1]}]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "No such file"),
        ("/**: [", "not YAML"),
        ("/**:\n  ros__parameters:\n    robot:\n      legs: [Left]\n", "robot.legs must be a name"),
        ("/**:\n  ros__parameters:\n    robot:\n      legs: [leg, a b]\n", "not 'a b'"),
    ],
)
def test_a_parameter_file_whose_legs_are_not_known_starts_nothing(
    tmp_path: Path, text: str | None, says: str
) -> None:
    """Nobody knows which nodes there should be: it is said before the first one is started."""
    file = tmp_path / "p.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ParameterError, match=says):
        Launched("walk.launch.py", params_file=str(file))


def test_the_trainer_is_no_walker() -> None:
    """train.launch.py with another world is refused, not started as something else."""
    with pytest.raises(RuntimeError, match="not valid"):
        Launched("train.launch.py", world="walker")


def test_what_stands_for_launch_refuses_what_it_refuses() -> None:
    """The mistake that was made once: a text where a number, or a substitution, must be."""
    for value, kind in (("20", int), ("true", bool), (1, str)):
        with pytest.raises(TypeError, match="is not an instance of"):
            ParameterValue(value, value_type=kind)
    with pytest.raises(ValueError, match="invalid literal"):
        ParameterValue(LaunchConfiguration("n"), value_type=int).evaluate(LaunchContext(n="x"))
    with pytest.raises(KeyError):
        LaunchConfiguration("n").perform(LaunchContext())
