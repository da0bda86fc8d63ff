"""What is in a bag: counts, gaps, provenance, a line a cycle and leg; and all as CSV. Pure."""

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
    """What a pass through a bag has come by."""

    def __init__(self, bag: Bag) -> None:
        """Begin before the first tick."""
        self.ticks = 0
        self.first: int | None = None
        self.last = -1
        self.gaps: list[tuple[int, int]] = []
        """First and last tick of each run of ticks that are not in the bag."""
        self.no_senses = dict.fromkeys(bag.legs, 0)
        self.no_command = dict.fromkeys(bag.legs, 0)
        self.falls = 0
        self._recorder = RunStatistics(bag.params, bag.legs)
        self._whole: Tick | None = None
        self._legs = bag.legs

    def see(self, tick: Tick) -> None:
        """Take the next tick."""
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
        whole, transitions = self._whole, tick.transitions
        if whole is None or whole.tick + 1 != tick.tick:  # nothing to be credited
            if whole is not None and int(whole.beat.phase) != int(tick.beat.phase):
                self._end()
            senses = [sense._replace(first_tick=True) for sense in senses]
            transitions = tuple(_uncredited(did) for did in transitions)
        self._recorder.tick(tick.beat, senses, tick.commands, tick.body, transitions)
        self._whole = tick

    def rows(self) -> list[Row]:
        """Return a line a cycle and leg, and one for the body; nothing may be seen after."""
        self._end()
        return self._recorder.rows

    def _end(self) -> None:
        """End the cycle that was begun."""
        if self._whole is not None:
            last = [sense._replace(first_tick=True) for sense in self._whole.senses if sense]
            self._recorder.finish(last, self._whole.body)


def info(bag: Bag) -> tuple[dict[str, Any], list[Row]]:
    """Return what is in a bag as plain values, and a line a cycle and leg.

    Raises:
        BagError: the bag is damaged.
    """
    seen = BagStatistics(bag)
    for tick in bag.ticks():
        seen.see(tick)
    rows = seen.rows()
    body = [row for row in rows if row.module == "body"]
    found: dict[str, Any] = {
        "bag": str(bag.path),
        "namespace": "/" + bag.namespace,
        "world": bag.world,
        "messages": {t: int(c.msgcount) for t, c in sorted(bag.connections.items())},
        "first_tick": seen.first,
        "ticks": seen.ticks,
        "seconds": seen.ticks * bag.params.gait.tick_s,
        "cycles": seen.ticks / bag.params.gait.ticks,
        "falls": seen.falls,
        "distance_m": sum(row.distance_m or 0.0 for row in body),
        "reward": sum(r.reward for r in body) / len(body) if body and bag.reward_terms else None,
        "lost_ticks": sum(last - first + 1 for first, last in seen.gaps),
        "gaps": seen.gaps[:MAX_GAPS],
        "ticks_without_senses": {leg: n for leg, n in seen.no_senses.items() if n},
        "ticks_without_command": {leg: n for leg, n in seen.no_command.items() if n},
        "stale_messages": bag.stale,
        "damaged": [damage._asdict() for damage in bag.damages[:MAX_GAPS]],
        "table_sha256": bag.table_sha256,
    }
    if bag.path.is_dir():
        metadata = read_metadata(bag.path)
        found["storage"] = metadata.get("storage_identifier")
        known = metadata.get("custom_data") or {}
        if isinstance(known, dict):
            found["provenance"] = {name: str(known[name]) for name in PROVENANCE if name in known}
        found["files"] = {file.name: file.stat().st_size for file in bag.files}
    if bag.run_metadata is not None:
        found["card"] = {
            "legs": {leg: told._asdict() for leg, told in bag.run_metadata.legs.items()},
            "params_sha256": params_sha256(bag.run_metadata.params),
            "start_table_sha256": bag.run_metadata.start_table_sha256,
            "first_tick": bag.run_metadata.first_tick,
            "versions": dict(bag.run_metadata.versions),
        }
    return found, rows


PROVENANCE = ("date", "planned_cycles", "cpu", "system", "simd", "blas", "commit")
"""What ``custom_data`` tells of where and when a bag was recorded."""

CYCLE_HEADS = ("module", "reward", "contact", "peak N", "slip m", "distance m", "falls")
"""Of what ``cycles_told`` returns, behind the cycle or the count of cycles."""


def told(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what ``info`` found, but for the cycles, as pairs of a name and what is to be said."""
    files = found.get("files", {})
    lines = [("bag", found["bag"])]
    if files:
        count = "1 file" if len(files) == 1 else f"{len(files)} files"
        size = sum(files.values()) / 1e6
        lines.append(("storage", f"{found['storage']}, {count}, {size:.2f} MB"))
    lines += [
        ("robot", f"{found['namespace']}, {found['world']}"),
        (
            "ticks",
            f"{found['ticks']} from {found['first_tick']} on: {found['seconds']:g} s, "
            f"{found['cycles']:g} cycles",
        ),
        ("messages", f"{sum(found['messages'].values())} on {len(found['messages'])} topics"),
        ("falls", str(found["falls"])),
        ("distance", f"{found['distance_m']:.3f} m"),
        ("lost ticks", str(found["lost_ticks"])),
    ]
    lines += [("  gap", f"ticks {first} to {last}") for first, last in found["gaps"]]
    for key, what in (("senses", "whole senses"), ("command", "a command")):
        lines += [
            (f"  {leg}", f"{n} ticks without {what}")
            for leg, n in found[f"ticks_without_{key}"].items()
        ]
    lines += [("  damaged", damage_told(each["tick"], each["leg"])) for each in found["damaged"]]
    provenance = found.get("provenance", {})
    lines += [(name.replace("_", " "), each) for name, each in provenance.items()]
    run_metadata = found.get("card")
    if run_metadata is None:
        lines.append(("run", "not told: made by another recorder, cannot be replayed"))
    else:
        kinds = {json.dumps(each, sort_keys=True) for each in run_metadata["legs"].values()}
        for each in map(json.loads, sorted(kinds)):
            said = ", ".join(f"{name} {value}" for name, value in each.items())
            lines.append(("legs", said))
        lines.append(
            ("versions", ", ".join(f"{k} {v}" for k, v in run_metadata["versions"].items()))
        )
        lines.append(("parameters SHA-256", run_metadata["params_sha256"][:12]))
        lines.append(
            ("table SHA-256, start", (run_metadata["start_table_sha256"] or "not known")[:12])
        )
    if found["table_sha256"]:
        lines.append(("table SHA-256, end", found["table_sha256"][:12]))
    return lines


def damage_told(tick: int, leg: str) -> str:
    """Return what is to be said of senses whose CRC is not the recorded one."""
    return f"tick {tick}, {leg}: senses are not those that were recorded"


def cycles_told(rows: Sequence[Row], *, whole: bool) -> list[tuple[str, ...]]:
    """Return a line a module over all cycles, or a line a cycle and module, as text.

    Args:
        rows: of ``info``.
        whole: whether every cycle has lines of its own.
    """
    if whole:
        return [(str(row.cycle), *_over([row])) for row in rows]
    groups = [
        [row for row in rows if row.module == module]
        for module in dict.fromkeys(row.module for row in rows)
    ]
    return [(str(len(group)), *_over(group)) for group in groups]


def _over(group: Sequence[Row]) -> tuple[str, ...]:
    """Return what some cycles of one module came to, in the order of ``CYCLE_HEADS``."""
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
"""Of ``ticks.csv``. Senses, stance, state and body are at the start of the tick, command and action
hold during it. Action, reward and its terms (in columns ``reward_<term>``), and the error of what
was learnt from it, are what the leg published one tick later. Empty where it published nothing."""


def write_csv(bag: Bag, folder: Path) -> list[Path]:
    """Write ``cycles.csv`` (a line a cycle and leg) and ``ticks.csv`` (a line a tick and leg).

    Returns:
        The files.

    Raises:
        BagError: the bag is damaged, or the files are there already or cannot be written.
    """
    files = [folder / CYCLES_CSV, folder / TICKS_CSV]
    there = [file for file in files if file.exists()]
    if there:
        raise BagError(f"{there[0]} is there already; give another --out")
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as opened:
            outs = []
            for file in files:
                outs.append(opened.enter_context(file.open("x", newline="", encoding="utf-8")))
                made.append(file)
            cycles, ticks = outs
            seen = BagStatistics(bag)
            lines = csv.writer(ticks)
            lines.writerow([*TICK_COLUMNS, *(f"reward_{term}" for term in bag.reward_terms)])
            lines.writerows(_lines(bag, seen))
            lines = csv.writer(cycles)
            lines.writerow(Row._fields)
            lines.writerows(seen.rows())
        made.clear()
    except FileExistsError as error:
        raise BagError(f"{error.filename} is there already; give another --out") from error
    except OSError as error:
        raise BagError(f"cannot write into {folder}: {error.strerror}") from error
    finally:
        for file in made:
            file.unlink(missing_ok=True)
    return files


def _lines(bag: Bag, seen: BagStatistics) -> Iterator[list[Any]]:
    """Yield a line a tick and leg; a tick's reward is known one tick later."""
    before: Tick | None = None
    names = bag.reward_terms

    def of(tick: Tick, after: Tick | None) -> Iterator[list[Any]]:
        follows = after is not None and after.tick == tick.tick + 1
        for n, leg in enumerate(bag.legs):
            sense, command, now = tick.senses[n], tick.commands[n], tick.transitions[n]
            did = after.transitions[n] if after is not None and follows else None
            if did is not None and not did.credited:
                did = None
            terms = dict(did.terms) if did is not None else {}
            yield [
                tick.tick,
                tick.tick * bag.params.gait.tick_s,
                tick.beat.phase,
                leg,
                int(now.next_stance) if now is not None else "",
                *(map(_plain, sense[1:]) if sense else [""] * (len(LegSense._fields) - 1)),
                now.next_state if now is not None else "",
                did.action if did is not None else "",
                *(command[1:] if command else [""] * (len(LegCommand._fields) - 1)),
                did.reward if did is not None else "",
                did.td_error if did is not None else "",
                *tick.body,
                *(terms.get(name, "") for name in names),
            ]

    for tick in bag.ticks():
        seen.see(tick)
        if before is not None:
            yield from of(before, tick)
        before = tick
    if before is not None:
        yield from of(before, None)


def _uncredited(did: Transition | None) -> Transition | None:
    """Return a transition that follows no tick that is known, with nothing to credit."""
    return did and did._replace(state=-1, action=-1)


def _plain(value: float | bool) -> float | int:
    """Return a bit as 0 or 1: every column is a number."""
    return int(value) if isinstance(value, bool) else value
