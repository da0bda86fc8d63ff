"""Reads and writes the file of a Q-table: written atomically, fully checked when read."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import struct
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros.bounded_io import open_file, read_json
from ember_ros.errors import ParameterError, TableError, shown
from ember_ros.params import (
    MAX_CELLS,
    Params,
    as_dict,
    by_full_name,
    cells_sha256,
    params_sha256,
    replace,
)
from ember_ros.shipped import TABLE, shipped_table
from ember_ros.versions import version
from leg_node.assembly import empty_table
from leg_node.table import Table

MAX_SHOWN = 8
"""Differences of parameters that a message lists one by one."""
MAX_ABOUT = 1 << 20
"""Maximum bytes of ``about``, and of a file besides its arrays: a hundred times the usual size."""
_NPY = struct.Struct("<8sH")
_MAGIC = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<>|=]\w+)', 'fortran_order': (True|False), 'shape': \(([\d, ]*)\), \}\s*"
)
"""The header that numpy writes for a plain array; numpy's own reader evaluates it as Python."""


def save_table(
    file: Path, table: Table, params: Params, seed: int, notes: Mapping[str, Any] | None = None
) -> None:
    """Write a table with its provenance, atomically.

    The file is an ``.npz`` of ``values`` and ``visits``, each ``(states, actions)``, and
    ``about``, a JSON text: parameters and their SHA-256, seed, version, and ``notes``.

    Raises:
        TableError: the file cannot be written; an earlier file is unchanged.
    """
    about = {
        **(notes or {}),
        "format": 1,
        "version": version(),
        "seed": seed,
        "params": as_dict(params),
        "params_sha256": params_sha256(params),
        "cells_sha256": cells_sha256(params),
        "table_sha256": table.sha256(),
    }
    text = json.dumps(about, sort_keys=True)
    shape = (table.states, table.actions)
    draft = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, draft = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.", suffix=".npz")
        with os.fdopen(handle, "wb") as out:
            np.savez_compressed(
                out,
                values=table.values.reshape(shape),
                visits=table.visits.reshape(shape),
                about=np.array(text),
            )
            out.flush()
            os.fsync(out.fileno())
        os.chmod(draft, 0o644)
        os.replace(draft, file)
        draft = None
    except OSError as error:
        raise TableError(f"cannot write the table {file}: {error.strerror or error}") from error
    finally:  # also when interrupted
        if draft is not None:
            with contextlib.suppress(OSError):
                os.unlink(draft)


def load_table(file: Path, params: Params) -> tuple[Table, dict[str, Any]]:
    """Read a table and its provenance.

    Nothing is unpacked before the headers in the file state the size that ``params`` require.

    Args:
        file: its path, or ``trained`` for the table that comes with the package.
        params: the parameters to use the table with.

    Returns:
        The table and ``about``, as ``save_table`` writes it.

    Raises:
        TableError: the file is missing, is not a table, is damaged, or its cells have another
            meaning than under ``params``.
    """
    file = shipped_table(file)
    table = empty_table(params)
    try:
        with open_file(file, 16 * len(table) + MAX_ABOUT) as raw, zipfile.ZipFile(raw) as content:
            values, visits = _Member(content, "values"), _Member(content, "visits")
            shape = (table.states, table.actions)
            if values.shape != shape or visits.shape != shape:
                raise TableError(
                    f"{file} has values {shown(values.shape)} and visits {shown(visits.shape)}; "
                    f"these parameters need {shape} (states, actions)"
                )
            if values.dtype != np.float64 or visits.dtype != np.int64:
                raise TableError(
                    f"{file} holds {values.dtype} and {visits.dtype}; float64 values and int64 "
                    "visits would be right"
                )
            about = _about(content)
            table.values[:] = values.read().reshape(-1)
            table.visits[:] = visits.read().reshape(-1)
    except FileNotFoundError:
        raise TableError(
            f"there is no table {file}; `ember train` makes one, {TABLE} comes with the package"
        ) from None
    except TableError:
        raise
    except Exception as error:  # a foreign file makes numpy, zip and zlib raise nearly anything
        raise TableError(
            f"{file} is not a whole ember_ros table (an .npz of values, visits, about): "
            f"{error or type(error).__name__}"
        ) from error
    if not np.isfinite(table.values).all() or (table.visits < 0).any():
        raise TableError(f"{file} holds values that are not finite, or negative visits")
    check_cells(str(file), about.get("cells_sha256"), params)
    if about.get("table_sha256") != table.sha256():
        raise TableError(f"{file} is damaged: its content does not have the SHA-256 it names")
    return table, about


def check_cells(what: str, cells: Any, params: Params) -> None:
    """Check that the cells of a table have the meaning that the parameters define.

    Args:
        what: the table, for the error message.
        cells: ``params.cells_sha256`` of the parameters that the table was learnt with.
        params: the parameters to use the table with.

    Raises:
        TableError: the meaning is another one.
    """
    if cells != cells_sha256(params):
        raise TableError(
            f"{what} was learnt with another partition of the state, other knee speeds, another "
            "stance share or other parts (state.*, leg.load, leg.knee_speeds, gait.stance_share, "
            "parts.*); the parameters that it was learnt with would be right"
        )


def params_of(file: Path, about: Mapping[str, Any]) -> Params:
    """Return the parameters that a table was learnt with.

    Args:
        file: of the table, for the error message.
        about: its provenance.

    Raises:
        TableError: they are missing, or this version has other parameters.
    """
    stored: Any = about.get("params")
    try:
        return replace(Params(), by_full_name(stored))
    except (ParameterError, AttributeError) as error:
        raise TableError(f"{file} has other parameters than this version: {error}") from error


def load_about(file: Path) -> dict[str, Any]:
    """Return the provenance in a table's file, for a table of any size.

    Raises:
        TableError: the file is missing, or is not a table.
    """
    try:
        with open_file(file, 16 * MAX_CELLS + MAX_ABOUT) as raw, zipfile.ZipFile(raw) as content:
            return _about(content)
    except FileNotFoundError:
        raise TableError(f"there is no table {file}; `ember train` makes one") from None
    except Exception as error:
        raise TableError(
            f"{file} is not a whole ember_ros table: {error or type(error).__name__}"
        ) from error


def _about(content: zipfile.ZipFile) -> dict[str, Any]:
    about = read_json(str(_Member(content, "about").read(MAX_ABOUT)), MAX_ABOUT)
    if not isinstance(about, dict):
        raise ValueError("about is not a JSON object")
    return about


def _differences(about: Mapping[str, Any], params: Params) -> list[str]:
    """Return the differences between the parameters of a table and the present ones.

    Args:
        about: provenance of the table.
        params: the present ones.
    """
    stored = about.get("params")
    if not isinstance(stored, Mapping):
        return []
    before, now = by_full_name(stored), by_full_name(as_dict(params))
    return [
        f"{name} {shown(before.get(name, 'missing'))}, now {shown(now.get(name, 'missing'))}"
        for name in dict.fromkeys([*now, *before])
        if before.get(name) != now.get(name)
    ]


def describe_differences(
    table: Path, about: Mapping[str, Any], params: Params, groups: Sequence[str] = ()
) -> str | None:
    """Return one line that lists which parameters of a table differ from the present ones.

    Args:
        table: its file.
        about: its provenance.
        params: the present ones.
        groups: the groups to compare; all groups if empty.

    Returns:
        The line, or None if nothing differs.
    """
    differences = [
        each for each in _differences(about, params) if not groups or each.split(".")[0] in groups
    ]
    if not differences:
        return None
    more = f"; and {len(differences) - MAX_SHOWN} more" if len(differences) > MAX_SHOWN else ""
    return f"{table} was learnt with other parameters: {'; '.join(differences[:MAX_SHOWN])}{more}"


class _Member:
    """One array in an ``.npz``: the header is read at once, the numbers by ``read``."""

    def __init__(self, content: zipfile.ZipFile, name: str) -> None:
        members = [info for info in content.infolist() if info.filename == f"{name}.npy"]
        if len(members) != 1:
            raise ValueError(f"it has {len(members)} members {name}")
        (self._info,) = members
        self._content, self._name = content, name
        if self._info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{name} uses another compression than deflate")
        with content.open(self._info) as raw:
            magic, length = _NPY.unpack(raw.read(_NPY.size))
            header = _HEADER.fullmatch(raw.read(length))
        if magic != _MAGIC or header is None:
            raise ValueError(f"{name} is not a plain array")
        self._offset = _NPY.size + length
        self.dtype = np.dtype(header[1].decode())
        self.shape = tuple(int(size) for size in header[3].replace(b",", b" ").split())
        self._order: Any = "F" if header[2] == b"True" else "C"
        size = math.prod(self.shape) * self.dtype.itemsize
        if self.dtype.hasobject:
            raise ValueError(f"{name} holds Python objects; numbers would be right")
        if self._info.file_size != self._offset + size:
            raise ValueError(
                f"{name} has {self._info.file_size} bytes, but its header states "
                f"{self._offset + size}"
            )

    def read(self, max_bytes: int | None = None) -> NDArray[Any]:
        """Return the array.

        Args:
            max_bytes: its maximum size; None for any size.

        Raises:
            ValueError: it is larger.
        """
        size = self._info.file_size
        if max_bytes is not None and size > max_bytes:
            raise ValueError(f"{self._name} has {size} bytes; up to {max_bytes} would be right")
        with self._content.open(self._info) as raw:
            data = raw.read(size)  # never more; reading the last byte checks the CRC
        return np.frombuffer(data, self.dtype, offset=self._offset).reshape(
            self.shape, order=self._order
        )
