"""What is said over and over: a few lines a window, the last one always, none uncounted."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from ember_ros.throttle import MAX_TEXT, Throttle


class Said:
    """A throttle, what it let through, and what time it is."""

    def __init__(self, at_once: int = 2) -> None:
        self.lines: list[str] = []
        self.now = 0.0
        self.throttle = Throttle(self.lines.append, 5.0, at_once, lambda: self.now)


def test_a_thousand_lines_a_minute_become_a_few_with_a_count() -> None:
    """Two at once, then one a window with how many it stands for; the last word is the last."""
    said = Said()
    for n in range(1000):
        said.now = n * 0.06
        said.throttle.flush()
        said.throttle.log("leg", f"word {n}")
    said.now = 100.0
    said.throttle.flush()
    assert len(said.lines) <= 2 + 60 / 5 + 1
    assert said.lines[:2] == ["word 0", "word 1"]
    assert said.lines[-1].startswith("word 999")


def test_matters_do_not_hold_each_other_back() -> None:
    """Each matter has a window of its own, and what comes rarely is said at once, as it is."""
    said = Said(at_once=1)
    for matter, text, now in (("a", "1", 0.0), ("a", "2", 1.0), ("b", "3", 1.0)):
        said.now = now
        said.throttle.log(matter, text)
    assert said.lines == ["1", "3"]
    for said.now in (4.9, 5.0, 99.0):
        said.throttle.flush()
    assert said.lines == ["1", "3", "2"]
    said.throttle.log("a", "4")
    assert said.lines == ["1", "3", "2", "4"]


@given(st.lists(st.floats(0.0, 3.0), max_size=60), st.integers(1, 3), st.booleans())
def test_no_line_is_lost_without_a_count(gaps: list[float], at_once: int, often: bool) -> None:
    """Lines said and lines counted are all there were, whenever they come."""
    said = Said(at_once)
    for gap in gaps:
        said.now += gap
        if often:
            said.throttle.flush()
        said.throttle.log("m", "x")
    said.now += 6.0
    said.throttle.flush()
    counts = [re.search(r"and (\d+) more", line) for line in said.lines]
    assert len(said.lines) + sum(int(count[1]) for count in counts if count) == len(gaps)


def test_what_is_still_so_is_said_once_a_window_and_never_when_it_is_over() -> None:
    """A reminder leaves nothing behind to be said later."""
    said = Said()
    for n in range(101):
        said.now = n * 0.1
        said.throttle.remind("start", f"waiting at {said.now}")
    assert said.lines == ["waiting at 0.0", "waiting at 5.0", "waiting at 10.0"]
    said.now = 99.0
    said.throttle.flush()
    assert len(said.lines) == 3


def test_a_line_has_a_bound() -> None:
    """A message that quotes megabytes of another node costs one short line."""
    lines: list[str] = []
    Throttle(lines.append).log("key", "x" * 10**6)
    assert lines == ["x" * MAX_TEXT + "..."]
