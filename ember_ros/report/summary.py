"""Format the content of ``summary.json`` as lines for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def summary_lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the summary of a run as pairs of a name, with the unit, and a value."""
    first, last = summary["first"], summary["last"]
    return [
        ("cycles", str(summary["cycles"])),
        ("falls", "-" if summary["world"] == "trainer" else str(summary["falls"])),
        ("cycles in first and in last", str(first["cycles"])),
        ("distance per cycle, first, m", _number(first["distance_per_cycle_m"], ".3f")),
        ("distance per cycle, last, m", _number(last["distance_per_cycle_m"], ".3f")),
        ("stance contact, last", _number(last["contact_share"], ".0%")),
        ("peak force, first, N", _number(first["peak_force_n"], ".0f")),
        ("peak force, last, N", _number(last["peak_force_n"], ".0f")),
        ("ticks per second", _number(summary["ticks_per_s"], ".0f")),
        ("table SHA-256", summary["table_sha256"][:12]),
        ("commands SHA-256", summary["commands_sha256"][:12]),
        ("senses SHA-256", summary["senses_sha256"][:12]),
    ]


def comparison_rows(summaries: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return rows of a name and the value of each run, to compare the runs side by side."""
    columns = [summary_lines(summary) for summary in summaries.values()]
    return [(lines[0][0], *(value for _, value in lines)) for lines in zip(*columns, strict=True)]


def _number(value: float | None, form: str) -> str:
    """Return a number as text, ``-`` for None."""
    return "-" if value is None else format(value, form)
