"""Parameter files: ROS 2's own format, so that one file serves ``ember`` and ``ros2 run``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ember_ros.errors import ParameterError
from ember_ros.params import Params, as_dict, replace

SECTION = "/**"
NUMBERS = "ros__parameters"


CONFIG = Path(__file__).parent / "config"
"""The parameter files that come with the package, for ``ember`` and for ``ros2 run`` alike."""


def config_names() -> list[str]:
    """Return the names of the parameter files that come with the package."""
    return sorted(file.stem for file in CONFIG.glob("*.yaml"))


def load_params(*files: Path | str) -> Params:
    """Read parameter files, each its section ``/**``; what a later one says wins.

    Args:
        files: paths, or names of files that come with the package (``plain``, ``narrow``).

    Raises:
        ParameterError: one is missing, no YAML, of another form, or names or values are wrong.
    """
    params = Params()
    for file in map(Path, files):
        own = CONFIG / f"{file}.yaml"
        named = not file.is_file() and str(file) in config_names()
        params = _load(own if named else file, params)
    return params


def _load(file: Path, base: Params) -> Params:
    """Return ``base`` with what a file says."""
    right = f"`{SECTION}: {{{NUMBERS}: {{group: {{name: value}}}}}}` would be right"
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        known = ", ".join(config_names())
        raise ParameterError(
            f"cannot read the parameter file {file}: {error.strerror}; a path, or one of {known} "
            "would be right"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterError(f"{file} is no YAML: {error}") from error
    if not isinstance(content, dict) or set(content) != {SECTION}:
        raise ParameterError(f"{file}: {right}; sections for single nodes are read by nodes only")
    section = content[SECTION]
    if not isinstance(section, dict) or set(section) != {NUMBERS}:
        raise ParameterError(f"{file}: {right}")
    numbers = section[NUMBERS] or {}
    if not isinstance(numbers, dict):
        raise ParameterError(f"{file}: {right}")
    changes: dict[str, Any] = {}
    for group, fields in numbers.items():
        if isinstance(fields, dict):
            changes.update({f"{group}.{name}": value for name, value in fields.items()})
        else:  # also written as one dotted name, as `ros2 param dump` does not but people do
            changes[str(group)] = fields
    try:
        return replace(base, changes)
    except ParameterError as error:
        raise ParameterError(f"{file}: {error}") from error


def dump_params(params: Params) -> str:
    """Return the text of a parameter file with every number."""
    return yaml.safe_dump({SECTION: {NUMBERS: as_dict(params)}}, sort_keys=False)
