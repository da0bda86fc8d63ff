"""Reads and writes parameter files in ROS 2's format: one file serves ``ember`` and ``ros2 run``.

A file is read as rcl reads it, not as YAML libraries do: ``5e-03`` is a number, ``1_000`` is not.
Content that rcl would read differently, or for some nodes only, is refused with the reason.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ember_ros.bounded_io import read_text
from ember_ros.errors import ParameterError, shown
from ember_ros.options import OPTION_NAMES, is_ros_own
from ember_ros.params import Params, Spec, as_dict, check, replace

SECTION = "/**"
NUMBERS = "ros__parameters"
MAX_TEXT = 1 << 20
"""Maximum bytes of a file: hundreds of times the size of all parameters."""
MAX_DEPTH_OF_FILE = 8
"""Maximum levels of nesting; parameter files of this package have three."""
CONFIG = Path(__file__).parent / "config"
"""Folder of the parameter files that come with the package."""

_TRUE = ("y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON")
_FALSE = ("n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF")
_BOOLS = {**dict.fromkeys(_TRUE, True), **dict.fromkeys(_FALSE, False)}
_OCTAL, _HEX, _DECIMAL = (
    re.compile(form) for form in (r"[-+]?0[0-7]+", r"[-+]?0[xX][0-9a-fA-F]+", r"[-+]?[0-9]+")
)
_FLOAT = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_SPECIAL = re.compile(r"[-+]?\.?(nan|inf|infinity)", re.IGNORECASE)


def config_names() -> list[str]:
    """Return the names of the parameter files that come with the package."""
    return sorted(file.stem for file in CONFIG.glob("*.yaml"))


def load_params(
    *files: Path | str, settings: Sequence[str] = (), base: Params | None = None
) -> Params:
    """Read the section ``/**`` of parameter files; later files override earlier ones.

    Args:
        files: paths, or names of files that come with the package (``plain``, ``narrow``).
        settings: texts ``group.field=value``, which override the files.
        base: the parameters that the files override; the defaults for None.

    Raises:
        ParameterError: a file is missing, is not YAML or has another form, or a name or value is
            wrong.
    """
    params = base or Params()
    earlier: set[str] = set()
    for file in map(Path, files):
        own = CONFIG / f"{file}.yaml"
        named = not file.is_file() and str(file) in config_names()
        params = _load(own if named else file, params, earlier)
    return changed(params, settings)


def robot_legs(files: Sequence[Path | str]) -> tuple[str, ...]:
    """Return the names of the robot's legs in parameter files, for a launch file.

    The rest of a file is not checked here but by the nodes, because it may contain node options.

    Raises:
        ParameterError: a file cannot be read, or its legs are not names.
    """
    legs: Any = Params().robot.legs
    for file in files:
        try:
            content: Any = _read(read_text(Path(file), MAX_TEXT))
        except (OSError, ValueError) as error:
            raise ParameterError(f"{file}: {error}") from error
        for name in (SECTION, NUMBERS, "robot"):
            content = content.get(name) if isinstance(content, dict) else None
        if isinstance(content, dict):
            legs = content.get("legs", legs)
    return tuple(map(str, check("robot.legs", legs)))  # type: ignore[arg-type]


def changed(params: Params, settings: Sequence[str]) -> Params:
    """Return parameters with some of them changed by texts ``group.field=value``.

    Raises:
        ParameterError: a text has another form, or its name or value is wrong.
    """
    return replace(params, read_settings(settings))


def read_settings(settings: Sequence[str]) -> Mapping[str, Any]:
    """Return the names and values in texts ``group.field=value``.

    Raises:
        ParameterError: a text has another form, or its name or value is wrong.
    """
    changes: dict[str, Any] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise ParameterError(f"--set {shown(setting)}: group.field=value would be right")
        try:
            if name.strip() in OPTION_NAMES:
                raise ParameterError(option_message(name.strip()))
            changes[name.strip()] = check(name.strip(), _read(value))
        except ValueError as error:
            raise ParameterError(f"--set {shown(setting)}: {error}") from error
    return changes


def option_message(option: str) -> str:
    """Return the error message for a node option that is set like a parameter of the robot."""
    return (
        f"{option} is an option of nodes, not a parameter of the robot: a node accepts it with "
        f"`-p {option}:=VALUE`, and `ember walk --help` lists the options of `ember`"
    )


def _load(file: Path, base: Params, earlier: set[str]) -> Params:
    """Return ``base`` with the values in a file.

    Args:
        file: the parameter file.
        base: the parameters that it overrides.
        earlier: the names in earlier files; those in this file are added.
    """
    right = f"`{SECTION}: {{{NUMBERS}: {{group: {{name: value}}}}}}` would be right"
    try:
        content = _read(read_text(file, MAX_TEXT))
    except OSError as error:
        known = ", ".join(config_names())
        raise ParameterError(
            f"cannot read the parameter file {file}: {error.strerror}; a path, or one of {known} "
            "would be right"
        ) from error
    except ValueError as error:
        raise ParameterError(f"{file}: {error}") from error
    if not isinstance(content, dict) or SECTION not in content:
        raise ParameterError(f"{file}: {right}")
    if others := [name for name in content if name != SECTION]:
        raise ParameterError(
            f"{file}: the section {shown(others[0])} is for some nodes only, which would then "
            f"have another robot than the others; {right}"
        )
    section = content[SECTION]
    if not isinstance(section, dict) or set(section) != {NUMBERS}:
        raise ParameterError(f"{file}: {right}")
    numbers = section[NUMBERS]
    if not isinstance(numbers, dict):
        raise ParameterError(f"{file}: {right}")
    try:
        changes = dict(_names(numbers))
        # If two files have the same name with a dot and values of different types, rcl keeps both
        # and returns the first one that it finds, which is not always that of the later file.
        if repeated := sorted(earlier & set(numbers)):
            raise ParameterError(
                f"an earlier file sets {shown(repeated[0])} too, and nodes do not always use the "
                "later value of a name with a dot; a group with the name in it would be right"
            )
        earlier |= set(changes)
        return replace(base, changes)
    except ParameterError as error:
        raise ParameterError(f"{file}: {error}") from error


def _names(numbers: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield full names and values; groups may be nested, or written with dots.

    Raises:
        ParameterError: a name is set twice, once nested and once with dots, or is an option.
    """
    known: set[str] = set()
    for key, value in numbers.items():
        name = f"{prefix}{key}"
        nested = _names(value, f"{name}.") if isinstance(value, dict) else iter([(name, value)])
        for each, number in nested:
            if each in known:
                raise ParameterError(f"{each} is set twice")
            known.add(each)
            if each in OPTION_NAMES:
                raise ParameterError(option_message(each))
            if not is_ros_own(each):  # ROS's own parameters are left to the nodes
                yield each, number


def _read(text: str) -> Any:
    """Return the content of a YAML text, as rcl reads it.

    It uses no recursion and refuses aliases, so memory and time are bounded by the text's size.

    Raises:
        ValueError: it is not YAML, or rcl would read it differently or not at all.
    """
    stack: list[Any] = [[]]
    keys: list[str | None] = [None]
    documents = 0

    def put(value: Any, line: int) -> None:
        if isinstance(stack[-1], list):
            stack[-1].append(value)
            return
        if keys[-1] is None:
            if not isinstance(value, str):
                raise ValueError(f"line {line}: {shown(value)} is not a name")
            if value in stack[-1]:
                raise ValueError(f"line {line}: {shown(value)} is set twice")
            keys[-1] = value
            return
        stack[-1][keys[-1]] = value
        keys[-1] = None

    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise ValueError(f"line {line}: a second document; one would be right")
                if event.version:
                    raise ValueError(f"line {line}: not every rcl reads %YAML; remove it")
            elif isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
                raise ValueError(f"line {line}: rcl does not read anchors and aliases")
            elif (tag := getattr(event, "tag", None)) is not None:
                raise ValueError(f"line {line}: a tag such as {shown(tag)}; none would be right")
            elif isinstance(event, yaml.ScalarEvent):
                plain = event.style is None
                is_key = isinstance(stack[-1], dict) and keys[-1] is None
                if not event.value and event.style not in ("'", '"'):
                    raise ValueError(f"line {line}: empty; a name or a value would be right")
                if plain and set(event.value) & set(":?"):  # depends on libyaml's version in braces
                    raise ValueError(
                        f"line {line}: {shown(event.value)} is not a number; for a text, quotes "
                        "would be right"
                    )
                put(_scalar(event.value) if plain and not is_key else event.value, line)
            elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
                if len(stack) > MAX_DEPTH_OF_FILE:
                    raise ValueError(f"line {line}: nested more than {MAX_DEPTH_OF_FILE} deep")
                stack.append({} if isinstance(event, yaml.MappingStartEvent) else [])
                keys.append(None)
            elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
                done = stack.pop()
                keys.pop()
                if not done:
                    raise ValueError(f"line {line}: empty brackets, which rcl does not read")
                if isinstance(done, list) and any(isinstance(each, (list, dict)) for each in done):
                    raise ValueError(f"line {line}: rcl reads only lists of single values")
                if isinstance(done, list) and len({type(each) for each in done}) > 1:
                    raise ValueError(
                        f"line {line}: {shown(done)} has numbers of two kinds, which rcl refuses; "
                        "1.0 instead of 1 would be right"
                    )
                put(done, line)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        why = getattr(error, "problem", None) or getattr(error, "reason", None) or "damaged"
        raise ValueError(f"{where}not YAML: {str(why)[:100]}") from error
    if not stack[0]:
        raise ValueError("it is empty; `ember params` prints what would be right")
    return stack[0][0]


def _scalar(text: str) -> Any:
    """Return a plain scalar with the type that rcl gives it: bool, int, float or text."""
    if text in _BOOLS:
        return _BOOLS[text]
    if len(text) > 400:
        return text
    for form, base in ((_OCTAL, 8), (_HEX, 16), (_DECIMAL, 10)):
        if form.fullmatch(text):
            # A leading 0 with a digit that is not octal is no integer for rcl, so it reads a float.
            if base == 10 and len(text.lstrip("-+")) > 1 and text.lstrip("-+").startswith("0"):
                return float(text)
            whole = int(text, base)
            return whole if -(2**63) <= whole < 2**63 else float(whole)
    if _FLOAT.fullmatch(text):
        number = float(text)
        # C's strtod reports an underflow for subnormal numbers, and rcl then reads a text.
        small = abs(number) < sys.float_info.min and re.search("[1-9]", re.split("[eE]", text)[0])
        return text if small else number
    if _SPECIAL.fullmatch(text):
        return float(text.replace(".", ""))
    return text


def range_of(spec: Spec) -> str:
    """Return a parameter's range as text, also if an end is open."""
    low, high = spec.low, spec.high
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:g} to {high:g}"
    ends = [f"{low:g} or more"] * math.isfinite(low) + [f"{high:g} or less"] * math.isfinite(high)
    return f"{''.join(ends) or 'any number'}, and finite"


def dump_params(params: Params) -> str:
    """Return the text of a parameter file with all parameters."""
    return yaml.safe_dump({SECTION: {NUMBERS: as_dict(params)}}, sort_keys=False)
