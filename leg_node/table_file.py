"""The file of a Q-table: written whole or not at all, believed only where it is whole."""

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
"""Differences of parameters that are told one by one."""
MAX_ABOUT = 1 << 20
"""Bytes of ``about``, and of all in a file that is not the numbers: a hundred times what it has."""
_NPY = struct.Struct("<8sH")
_MAGIC = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<>|=]\w+)', 'fortran_order': (True|False), 'shape': \(([\d, ]*)\), \}\s*"
)
"""What numpy writes for an array that is no record; its own reader runs it as Python."""


def save_table(
    file: Path, table: Table, params: Params, seed: int, notes: Mapping[str, Any] | None = None
) -> None:
    """Write a table with its provenance, whole or not at all.

    The file is an ``.npz`` of ``values`` and ``visits``, each ``(states, actions)``, and
    ``about``, a JSON text: parameters and their SHA-256, seed, version, and ``notes``.

    Raises:
        TableError: the file cannot be written; what was there before is untouched.
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
    """Read a table and what is known about it.

    Nothing is unpacked before the file says that it has the size which ``params`` ask for.

    Args:
        file: its path, or the name of the one that comes with the package: ``trained``.
        params: that are to be in force.

    Raises:
        TableError: the file is missing, is no table, is damaged, or its cells mean something
            else than ``params`` says.
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
            f"there is no table {file}; `ember train` makes one, and {TABLE} comes with the package"
        ) from None
    except TableError:
        raise
    except Exception as error:  # a foreign file makes numpy, zip and zlib raise nearly anything
        raise TableError(
            f"{file} is not a whole ember_ros table (an .npz of values, visits, about): "
            f"{error or type(error).__name__}"
        ) from error
    if not np.isfinite(table.values).all() or (table.visits < 0).any():
        raise TableError(f"{file} holds values that are not finite or visits under 0")
    check_cells(str(file), about.get("cells_sha256"), params)
    if about.get("table_sha256") != table.sha256():
        raise TableError(f"{file} is damaged: its content does not have the SHA-256 it names")
    return table, about


def check_cells(what: str, cells: Any, params: Params) -> None:
    """Hold that the cells of a table mean what parameters say.

    Args:
        what: the table, for the error.
        cells: ``params.cells_sha256`` of the parameters that it was learnt with.
        params: in force.

    Raises:
        TableError: they mean something else.
    """
    if cells != cells_sha256(params):
        raise TableError(
            f"{what} was learnt with another partition of the state, other knee speeds, another "
            "stance share or other parts (state.*, leg.load, leg.knee_speeds, gait.stance_share, "
            "parts.*); load it with the parameters it was learnt with"
        )


def params_of(file: Path, about: Mapping[str, Any]) -> Params:
    """Return the parameters that a table was learnt with.

    Args:
        file: of the table.
        about: what it says of itself.

    Raises:
        TableError: they are missing, or are not those of this version.
    """
    stored: Any = about.get("params")
    try:
        return replace(Params(), by_full_name(stored))
    except (ParameterError, AttributeError) as error:
        raise TableError(f"{file} has other parameters than this version: {error}") from error


def load_about(file: Path) -> dict[str, Any]:
    """Return what a table's file says of itself, whatever its size.

    Raises:
        TableError: the file is missing, or is no table.
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
        raise ValueError("about is no JSON object")
    return about


def _differences(was: Mapping[str, Any], now: Params) -> list[str]:
    """Return which parameters a table was learnt with that are not in force now.

    Args:
        was: ``about`` of the table's file.
        now: in force.
    """
    stored = was.get("params")
    if not isinstance(stored, Mapping):
        return []
    then, here = by_full_name(stored), by_full_name(as_dict(now))
    return [
        f"{name} {shown(then.get(name, 'not there'))}, now {shown(here.get(name, 'not there'))}"
        for name in dict.fromkeys([*here, *then])
        if then.get(name) != here.get(name)
    ]


def describe_differences(
    table: Path, was: Mapping[str, Any], now: Params, groups: Sequence[str] = ()
) -> str | None:
    """Return in one line what a table was learnt with that is not in force now; None for nothing.

    Args:
        table: its file.
        was: ``about`` of it.
        now: in force.
        groups: that are known now; all without.
    """
    found = [each for each in _differences(was, now) if not groups or each.split(".")[0] in groups]
    if not found:
        return None
    more = f"; and {len(found) - MAX_SHOWN} more" if len(found) > MAX_SHOWN else ""
    return f"{table} was learnt with other parameters: {'; '.join(found[:MAX_SHOWN])}{more}"


class _Member:
    """One array in an ``.npz``, of which only the header was read yet."""

    def __init__(self, content: zipfile.ZipFile, name: str) -> None:
        found = [info for info in content.infolist() if info.filename == f"{name}.npy"]
        if len(found) != 1:
            raise ValueError(f"it has {len(found)} members {name}")
        (self._info,) = found
        self._content, self._name = content, name
        if self._info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{name} is compressed in another way than deflate")
        with content.open(self._info) as raw:
            magic, length = _NPY.unpack(raw.read(_NPY.size))
            header = _HEADER.fullmatch(raw.read(length))
        if magic != _MAGIC or header is None:
            raise ValueError(f"{name} is no plain array")
        self._begin = _NPY.size + length
        self.dtype = np.dtype(header[1].decode())
        self.shape = tuple(int(size) for size in header[3].replace(b",", b" ").split())
        self._order: Any = "F" if header[2] == b"True" else "C"
        size = math.prod(self.shape) * self.dtype.itemsize
        if self.dtype.hasobject or self._info.file_size != self._begin + size:
            raise ValueError(
                f"{name} has {self._info.file_size} bytes, which is not what its header says"
            )

    def read(self, most: int | None = None) -> NDArray[Any]:
        """Return the array, of up to ``most`` bytes."""
        size = self._info.file_size
        if most is not None and size > most:
            raise ValueError(f"{self._name} has {size} bytes; up to {most} would be right")
        with self._content.open(self._info) as raw:
            data = raw.read(size)  # no more, whatever is packed in it; the last byte checks the CRC
        return np.frombuffer(data, self.dtype, offset=self._begin).reshape(
            self.shape, order=self._order
        )
