"""What ``summary.json`` says, in lines to be printed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def told(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return a run's summary as pairs of a name with its unit and a value."""
    first, last = summary["first"], summary["last"]
    return [
        ("cycles", str(summary["cycles"])),
        ("falls", "-" if summary["world"] == "trainer" else str(summary["falls"])),
        ("first and last mean cycles", str(first["cycles"])),
        ("distance a cycle, first, m", _number(first["distance_per_cycle_m"], ".3f")),
        ("distance a cycle, last, m", _number(last["distance_per_cycle_m"], ".3f")),
        ("stance contact, last", _number(last["contact_share"], ".0%")),
        ("peak force, first, N", _number(first["peak_force_n"], ".0f")),
        ("peak force, last, N", _number(last["peak_force_n"], ".0f")),
        ("ticks a second", _number(summary["ticks_per_s"], ".0f")),
        ("table SHA-256", summary["table_sha256"][:12]),
        ("commands SHA-256", summary["commands_sha256"][:12]),
        ("senses SHA-256", summary["senses_sha256"][:12]),
    ]


def beside(summaries: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return summaries side by side: rows of a name and the value of each run."""
    columns = [told(summary) for summary in summaries.values()]
    return [(lines[0][0], *(value for _, value in lines)) for lines in zip(*columns, strict=True)]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
