"""The content of a bag: counts, gaps, provenance, a row per cycle and leg; also as CSV. Pure."""

from __future__ import annotations

import contextlib
import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ember_ros.bag.reader import Bag, Tick
from ember_ros.bag.storage import read_metadata
from ember_ros.errors import BagError
from ember_ros.params import params_sha256
from ember_ros.report.run_statistics import Row, RunStatistics
from ember_ros.signals import BodyState, LegCommand, LegSense, Transition

CYCLES_CSV, TICKS_CSV = "cycles.csv", "ticks.csv"
MAX_GAPS = 20


class BagStatistics:
    """Counts and rows of the ticks of a bag."""

    def __init__(self, bag: Bag) -> None:
        """Begin before the first tick."""
        self.ticks = 0
        self.first: int | None = None
        self.last = -1
        self.gaps: list[tuple[int, int]] = []
        """First and last tick of each gap: ticks that are not in the bag."""
        self.no_senses = dict.fromkeys(bag.legs, 0)
        self.no_command = dict.fromkeys(bag.legs, 0)
        self.falls = 0
        self._statistics = RunStatistics(bag.params, bag.legs)
        self._complete: Tick | None = None  # the last tick with the senses of all legs
        self._legs = bag.legs

    def add(self, tick: Tick) -> None:
        """Count the next tick."""
        if self.first is None:
            self.first = tick.tick
        elif tick.tick != self.last + 1:
            self.gaps.append((self.last + 1, tick.tick - 1))
        self.ticks, self.last, self.falls = self.ticks + 1, tick.tick, tick.body.falls
        for leg, sense, command in zip(self._legs, tick.senses, tick.commands, strict=True):
            self.no_senses[leg] += sense is None
            self.no_command[leg] += command is None
        senses = [sense for sense in tick.senses if sense is not None]
        if len(senses) < len(self._legs):
            return
        before, transitions = self._complete, tick.transitions
        if before is None or before.tick + 1 != tick.tick:  # nothing to credit
            if before is not None and int(before.beat.phase) != int(tick.beat.phase):
                self._end_cycle()
            senses = [sense._replace(first_tick=True) for sense in senses]
            transitions = tuple(map(_uncredited, transitions))
        self._statistics.tick(tick.beat, senses, tick.commands, tick.body, transitions)
        self._complete = tick

    def rows(self) -> list[Row]:
        """Return a row per cycle and leg, and one for the body; nothing may be added after."""
        self._end_cycle()
        return self._statistics.rows

    def _end_cycle(self) -> None:
        """End the cycle that has begun."""
        if self._complete is not None:
            last = [sense._replace(first_tick=True) for sense in self._complete.senses if sense]
            self._statistics.finish(last, self._complete.body)


def info(bag: Bag) -> tuple[dict[str, Any], list[Row]]:
    """Return the content of a bag as plain values, and a row per cycle and leg.

    Raises:
        BagError: the bag is damaged.
    """
    statistics = BagStatistics(bag)
    for tick in bag.ticks():
        statistics.add(tick)
    rows = statistics.rows()
    body = [row for row in rows if row.module == "body"]
    report: dict[str, Any] = {
        "bag": str(bag.path),
        "namespace": "/" + bag.namespace,
        "world": bag.world,
        "messages": {t: int(c.msgcount) for t, c in sorted(bag.connections.items())},
        "first_tick": statistics.first,
        "ticks": statistics.ticks,
        "seconds": statistics.ticks * bag.params.gait.tick_s,
        "cycles": statistics.ticks / bag.params.gait.ticks,
        "falls": statistics.falls,
        "distance_m": sum(row.distance_m or 0.0 for row in body),
        "reward": sum(r.reward for r in body) / len(body) if body and bag.reward_terms else None,
        "lost_ticks": sum(last - first + 1 for first, last in statistics.gaps),
        "gaps": statistics.gaps[:MAX_GAPS],
        "ticks_without_senses": {leg: n for leg, n in statistics.no_senses.items() if n},
        "ticks_without_command": {leg: n for leg, n in statistics.no_command.items() if n},
        "stale_messages": bag.stale,
        "damaged": [damage._asdict() for damage in bag.damages[:MAX_GAPS]],
        "table_sha256": bag.table_sha256,
    }
    if bag.path.is_dir():
        metadata = read_metadata(bag.path)
        report["storage"] = metadata.get("storage_identifier")
        custom = metadata.get("custom_data") or {}
        if isinstance(custom, dict):
            report["provenance"] = {
                name: str(custom[name]) for name in PROVENANCE if name in custom
            }
        report["files"] = {file.name: file.stat().st_size for file in bag.files}
    if bag.run_metadata is not None:
        report["card"] = {
            "legs": {leg: metadata._asdict() for leg, metadata in bag.run_metadata.legs.items()},
            "params_sha256": params_sha256(bag.run_metadata.params),
            "start_table_sha256": bag.run_metadata.start_table_sha256,
            "first_tick": bag.run_metadata.first_tick,
            "versions": dict(bag.run_metadata.versions),
        }
    return report, rows


PROVENANCE = ("date", "planned_cycles", "cpu", "system", "simd", "blas", "commit")
"""The keys of ``custom_data`` on where and when a bag was recorded."""

CYCLE_COLUMNS = ("module", "reward", "contact", "peak N", "slip m", "distance m", "falls")
"""Of the rows of ``cycle_lines``, behind the cycle or the number of cycles."""


def describe(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the report of ``info`` as pairs of a name and a text."""
    files = report.get("files", {})
    lines = [("bag", report["bag"])]
    if files:
        count = "1 file" if len(files) == 1 else f"{len(files)} files"
        size = sum(files.values()) / 1e6
        lines.append(("storage", f"{report['storage']}, {count}, {size:.2f} MB"))
    lines += [
        ("robot", f"{report['namespace']}, {report['world']}"),
        (
            "ticks",
            f"{report['ticks']} from {report['first_tick']} on: {report['seconds']:g} s, "
            f"{report['cycles']:g} cycles",
        ),
        ("messages", f"{sum(report['messages'].values())} on {len(report['messages'])} topics"),
        ("falls", str(report["falls"])),
        ("distance", f"{report['distance_m']:.3f} m"),
        ("lost ticks", str(report["lost_ticks"])),
    ]
    lines += [("  gap", f"ticks {first} to {last}") for first, last in report["gaps"]]
    for key, what in (("senses", "complete senses"), ("command", "a command")):
        lines += [
            (f"  {leg}", f"{n} ticks without {what}")
            for leg, n in report[f"ticks_without_{key}"].items()
        ]
    lines += [
        ("  damaged", describe_damage(damage["tick"], damage["leg"]))
        for damage in report["damaged"]
    ]
    provenance = report.get("provenance", {})
    lines += [(name.replace("_", " "), text) for name, text in provenance.items()]
    run_metadata = report.get("card")
    if run_metadata is None:
        lines.append(("run", "not recorded: a bag of another recorder, which cannot be replayed"))
    else:
        kinds = {json.dumps(leg, sort_keys=True) for leg in run_metadata["legs"].values()}
        for leg in map(json.loads, sorted(kinds)):
            lines.append(("legs", ", ".join(f"{name} {value}" for name, value in leg.items())))
        lines.append(
            ("versions", ", ".join(f"{k} {v}" for k, v in run_metadata["versions"].items()))
        )
        lines.append(("parameters SHA-256", run_metadata["params_sha256"][:12]))
        lines.append(
            ("table SHA-256, start", (run_metadata["start_table_sha256"] or "not known")[:12])
        )
    if report["table_sha256"]:
        lines.append(("table SHA-256, end", report["table_sha256"][:12]))
    return lines


def describe_damage(tick: int, leg: str) -> str:
    """Return a text on senses whose CRC-32 is not the recorded one."""
    return f"tick {tick}, {leg}: the senses are not the recorded ones"


def cycle_lines(rows: Sequence[Row], *, each: bool) -> list[tuple[str, ...]]:
    """Return a line per module over all cycles, or a line per cycle and module, as text.

    Args:
        rows: of ``info``.
        each: whether each cycle has its own lines.
    """
    if each:
        return [(str(row.cycle), *_summary([row])) for row in rows]
    groups = [
        [row for row in rows if row.module == module]
        for module in dict.fromkeys(row.module for row in rows)
    ]
    return [(str(len(group)), *_summary(group)) for group in groups]


def _summary(group: Sequence[Row]) -> tuple[str, ...]:
    """Return one module's cycles together, in the order of ``CYCLE_COLUMNS``."""
    n = len(group)
    body = group[0].falls is not None
    return (
        group[0].module,
        f"{sum(row.reward for row in group) / n:.3f}",
        f"{sum(row.contact_share or 0.0 for row in group) / n:.0%}",
        f"{max(row.peak_force_n for row in group):.0f}",
        f"{sum(row.slip_m for row in group):.3f}",
        f"{sum(row.distance_m or 0.0 for row in group):.3f}" if body else "",
        str(sum(row.falls or 0 for row in group)) if body else "",
    )


TICK_COLUMNS = (
    "tick",
    "time_s",
    "phase",
    "leg",
    "stance",
    *LegSense._fields[1:],
    "state",
    "action",
    *(f"command_{name}" for name in LegCommand._fields[1:]),
    "reward",
    "td_error",
    *(f"body_{name}" for name in BodyState._fields),
)
"""Of ``ticks.csv``. Senses, stance, state and body are those at the start of the tick; command and
action hold during it. Action, reward with its terms (columns ``reward_<term>``) and TD error are in
the transition that the leg published one tick later; they are empty if it published none."""


def write_csv(bag: Bag, folder: Path) -> list[Path]:
    """Write ``cycles.csv`` (a row per cycle and leg) and ``ticks.csv`` (a row per tick and leg).

    Returns:
        The files.

    Raises:
        BagError: the bag is damaged, or the files exist already or cannot be written.
    """
    files = [folder / CYCLES_CSV, folder / TICKS_CSV]
    existing = [file for file in files if file.exists()]
    if existing:
        raise BagError(f"{existing[0]} is there already; give another --out")
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as opened:
            outs = []
            for file in files:
                outs.append(opened.enter_context(file.open("x", newline="", encoding="utf-8")))
                made.append(file)
            cycles, ticks = outs
            statistics = BagStatistics(bag)
            lines = csv.writer(ticks)
            lines.writerow([*TICK_COLUMNS, *(f"reward_{term}" for term in bag.reward_terms)])
            lines.writerows(_lines(bag, statistics))
            lines = csv.writer(cycles)
            lines.writerow(Row._fields)
            lines.writerows(statistics.rows())
        made.clear()
    except FileExistsError as error:
        raise BagError(f"{error.filename} is there already; give another --out") from error
    except OSError as error:
        raise BagError(f"cannot write into {folder}: {error.strerror}") from error
    finally:
        for file in made:
            file.unlink(missing_ok=True)
    return files


def _lines(bag: Bag, statistics: BagStatistics) -> Iterator[list[Any]]:
    """Yield a row per tick and leg; a tick's reward is in the transition of the next one."""
    before: Tick | None = None
    names = bag.reward_terms

    def rows_of(tick: Tick, after: Tick | None) -> Iterator[list[Any]]:
        follows = after is not None and after.tick == tick.tick + 1
        for n, leg in enumerate(bag.legs):
            sense, command, now = tick.senses[n], tick.commands[n], tick.transitions[n]
            outcome = after.transitions[n] if after is not None and follows else None
            if outcome is not None and not outcome.credited:
                outcome = None
            terms = dict(outcome.terms) if outcome is not None else {}
            yield [
                tick.tick,
                tick.tick * bag.params.gait.tick_s,
                tick.beat.phase,
                leg,
                int(now.next_stance) if now is not None else "",
                *(map(_plain, sense[1:]) if sense else [""] * (len(LegSense._fields) - 1)),
                now.next_state if now is not None else "",
                outcome.action if outcome is not None else "",
                *(command[1:] if command else [""] * (len(LegCommand._fields) - 1)),
                outcome.reward if outcome is not None else "",
                outcome.td_error if outcome is not None else "",
                *tick.body,
                *(terms.get(name, "") for name in names),
            ]

    for tick in bag.ticks():
        statistics.add(tick)
        if before is not None:
            yield from rows_of(before, tick)
        before = tick
    if before is not None:
        yield from rows_of(before, None)


def _uncredited(transition: Transition | None) -> Transition | None:
    """Return a transition with nothing to credit, since the tick before is not in the bag."""
    return transition and transition._replace(state=-1, action=-1)


def _plain(value: float | bool) -> float | int:
    """Return a bit as 0 or 1: every column is a number."""
    return int(value) if isinstance(value, bool) else value
