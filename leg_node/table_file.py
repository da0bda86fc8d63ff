"""The file of a Q-table: written whole or not at all, believed only where it is whole."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ember_ros
from ember_ros.errors import TableError
from ember_ros.params import Params, as_dict, cells_sha256, params_sha256
from leg_node.table import Table, empty_table


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
        "version": ember_ros.__version__,
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

    Raises:
        TableError: the file is missing, is no table, is damaged, or its cells mean something
            else than ``params`` says.
    """
    try:
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as content:
            values, visits, text = content["values"], content["visits"], content["about"]
        about = json.loads(str(text))
        if not isinstance(about, dict):
            raise ValueError("about is no JSON object")
    except FileNotFoundError:
        raise TableError(f"there is no table {file}; `ember train` makes one") from None
    except Exception as error:  # a foreign file makes numpy, zip and zlib raise nearly anything
        raise TableError(
            f"{file} is not a whole ember_ros table (an .npz of values, visits, about): {error}"
        ) from error
    table = empty_table(params)
    shape = (table.states, table.actions)
    if values.shape != shape or visits.shape != shape:
        raise TableError(
            f"{file} has values {values.shape} and visits {visits.shape}; these parameters "
            f"need {shape} (states, actions)"
        )
    if values.dtype != np.float64 or visits.dtype != np.int64:
        raise TableError(
            f"{file} holds {values.dtype} and {visits.dtype}; float64 values and int64 visits "
            "would be right"
        )
    if not np.isfinite(values).all() or (visits < 0).any():
        raise TableError(f"{file} holds values that are not finite or visits under 0")
    if about.get("cells_sha256") != cells_sha256(params):
        raise TableError(
            f"{file} was learnt with another partition of the state, other knee speeds or another "
            "stance share (state.*, leg.load, leg.knee_speeds, gait.stance_share); load it with "
            "the parameters it was learnt with"
        )
    table.values[:] = values.reshape(-1)
    table.visits[:] = visits.reshape(-1)
    if about.get("table_sha256") != table.sha256():
        raise TableError(f"{file} is damaged: its content does not have the SHA-256 it names")
    return table, about
