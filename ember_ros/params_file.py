"""Parameter files: ROS 2's own format, so that one file serves ``ember`` and ``ros2 run``.

A file is read as rcl reads it, not as YAML libraries do: ``5e-03`` is a number, ``1_000`` is none.
What rcl would understand in a way of its own, or for some nodes alone, is refused with the reason.
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
"""Bytes of a file: hundreds of times what all parameters need."""
MAX_DEPTH_OF_FILE = 8
"""Levels of nesting: rcl knows three of ours."""
CONFIG = Path(__file__).parent / "config"
"""The parameter files that come with the package, for ``ember`` and for ``ros2 run`` alike."""

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
    """Read parameter files, each its section ``/**``; what a later one says wins.

    Args:
        files: paths, or names of files that come with the package (``plain``, ``narrow``).
        settings: ``group.field=value`` each, on top of the files.
        base: below the files; the defaults for None.

    Raises:
        ParameterError: one is missing, no YAML, of another form, or names or values are wrong.
    """
    params = base or Params()
    before: set[str] = set()
    for file in map(Path, files):
        own = CONFIG / f"{file}.yaml"
        named = not file.is_file() and str(file) in config_names()
        params = _load(own if named else file, params, before)
    return changed(params, settings)


def robot_legs(files: Sequence[Path | str]) -> tuple[str, ...]:
    """Return the names of the robot's legs as parameter files describe it, for what starts nodes.

    What else is wrong with a file, the nodes say: it may hold options of theirs as well.

    Raises:
        ParameterError: a file cannot be read, or its legs are no names.
    """
    legs: Any = Params().robot.legs
    for file in files:
        try:
            found: Any = _read(read_text(Path(file), MAX_TEXT))
        except (OSError, ValueError) as error:
            raise ParameterError(f"{file}: {error}") from error
        for name in (SECTION, NUMBERS, "robot"):
            found = found.get(name) if isinstance(found, dict) else None
        if isinstance(found, dict):
            legs = found.get("legs", legs)
    return tuple(map(str, check("robot.legs", legs)))  # type: ignore[arg-type]


def changed(params: Params, settings: Sequence[str]) -> Params:
    """Return parameters with some set, each as ``group.field=value``.

    Raises:
        ParameterError: one is not of that form, or its name or value is wrong.
    """
    return replace(params, read_settings(settings))


def read_settings(settings: Sequence[str]) -> Mapping[str, Any]:
    """Return names and values of ``group.field=value`` each, whatever they are set on top of.

    Raises:
        ParameterError: one is not of that form, or its name or value is wrong.
    """
    changes: dict[str, Any] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise ParameterError(f"--set {shown(setting)}: group.field=value would be right")
        try:
            if name.strip() in OPTION_NAMES:
                raise ParameterError(not_a_number(name.strip()))
            changes[name.strip()] = check(name.strip(), _read(value))
        except ValueError as error:
            raise ParameterError(f"--set {shown(setting)}: {error}") from error
    return changes


def not_a_number(option: str) -> str:
    """Return what to say of an option that is given as a parameter of the robot."""
    return (
        f"{option} is an option of nodes, not a number of the robot: a node takes it with "
        f"`-p {option}:=VALUE`, and `ember walk --help` tells the options that `ember` has"
    )


def _load(file: Path, base: Params, before: set[str]) -> Params:
    """Return ``base`` with what a file says; ``before``: the names that files have said so far."""
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
            f"{file}: the section {shown(others[0])} is for some nodes alone, and would make "
            f"another robot of them; {right}"
        )
    section = content[SECTION]
    if not isinstance(section, dict) or set(section) != {NUMBERS}:
        raise ParameterError(f"{file}: {right}")
    numbers = section[NUMBERS]
    if not isinstance(numbers, dict):
        raise ParameterError(f"{file}: {right}")
    try:
        changes = dict(_names(numbers))
        # rcl writes a name with a dot into the place it had, beside a value of another type, and
        # then hands out the one it finds first: not always the later file's.
        if again := sorted(before & set(numbers)):
            raise ParameterError(
                f"an earlier file says {shown(again[0])} too, and nodes do not always take the "
                "later of two when it has a dot; a group and a name in it would be right"
            )
        before |= set(changes)
        return replace(base, changes)
    except ParameterError as error:
        raise ParameterError(f"{file}: {error}") from error


def _names(numbers: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield full names and values; groups may be nested, or written with dots.

    Raises:
        ParameterError: a name is said twice, once nested and once with dots, or is an option's.
    """
    seen: set[str] = set()
    for key, value in numbers.items():
        name = f"{before}{key}"
        found = _names(value, f"{name}.") if isinstance(value, dict) else iter([(name, value)])
        for each, number in found:
            if each in seen:
                raise ParameterError(f"{each} is said twice")
            seen.add(each)
            if each in OPTION_NAMES:
                raise ParameterError(not_a_number(each))
            if not is_ros_own(each):  # no number of the robot, and left to the nodes
                yield each, number


def _read(text: str) -> Any:
    """Return what a YAML text says, as rcl reads it.

    Without recursion and without aliases: no text of a bounded size takes more than its size.

    Raises:
        ValueError: it is no YAML, or what rcl would read otherwise or not at all.
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
                raise ValueError(f"line {line}: {shown(value)} is no name")
            if value in stack[-1]:
                raise ValueError(f"line {line}: {shown(value)} is said twice")
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
                    raise ValueError(f"line {line}: not every rcl reads %YAML; leave it out")
            elif isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
                raise ValueError(f"line {line}: rcl reads no anchors and aliases")
            elif (tag := getattr(event, "tag", None)) is not None:
                raise ValueError(f"line {line}: a tag such as {shown(tag)}; none would be right")
            elif isinstance(event, yaml.ScalarEvent):
                plain = event.style is None
                is_key = isinstance(stack[-1], dict) and keys[-1] is None
                if not event.value and event.style not in ("'", '"'):
                    raise ValueError(
                        f"line {line}: it is empty where a name or value would be right"
                    )
                if plain and set(event.value) & set(":?"):  # in braces, it hangs on libyaml's age
                    raise ValueError(
                        f"line {line}: {shown(event.value)} is no number; of a text, quotes would "
                        "be right"
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
                    raise ValueError(f"line {line}: nothing in brackets, which rcl stumbles over")
                if isinstance(done, list) and any(isinstance(each, (list, dict)) for each in done):
                    raise ValueError(f"line {line}: rcl reads lists of single values alone")
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
        raise ValueError(f"{where}this is no YAML: {str(why)[:100]}") from error
    if not stack[0]:
        raise ValueError("it is empty; `ember params` prints what would be right")
    return stack[0][0]


def _scalar(text: str) -> Any:
    """Return a plain scalar in the kind that rcl finds in it: bool, int, float, or text."""
    if text in _BOOLS:
        return _BOOLS[text]
    if len(text) > 400:
        return text
    for form, base in ((_OCTAL, 8), (_HEX, 16), (_DECIMAL, 10)):
        if form.fullmatch(text):
            # `0` then a digit that is not octal ends an integer there; the rest is read as a float.
            if base == 10 and len(text.lstrip("-+")) > 1 and text.lstrip("-+").startswith("0"):
                return float(text)
            whole = int(text, base)
            return whole if -(2**63) <= whole < 2**63 else float(whole)
    if _FLOAT.fullmatch(text):
        number = float(text)
        # C has no number for what is too small to be kept whole, and rcl takes that for a text.
        small = abs(number) < sys.float_info.min and re.search("[1-9]", re.split("[eE]", text)[0])
        return text if small else number
    if _SPECIAL.fullmatch(text):
        return float(text.replace(".", ""))
    return text


def range_of(spec: Spec) -> str:
    """Return a parameter's range in words, an end that is open too."""
    low, high = spec.low, spec.high
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:g} to {high:g}"
    ends = [f"{low:g} or more"] * math.isfinite(low) + [f"{high:g} or less"] * math.isfinite(high)
    return f"{''.join(ends) or 'any number'}, and finite"


def dump_params(params: Params) -> str:
    """Return the text of a parameter file with every number."""
    return yaml.safe_dump({SECTION: {NUMBERS: as_dict(params)}}, sort_keys=False)
