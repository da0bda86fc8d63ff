"""The inbox of a leg: whatever order things come in, only complete ticks are used, each once."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.inbox import KEPT, Inbox, Receipt

SOURCES = ("joints", "contact", "phase")
few = settings(max_examples=100, deadline=None, derandomize=True)


def value(source: str, tick: int) -> str:
    """Return what a source says of a tick."""
    return f"{source} {tick}"


def hear(inbox: Inbox, source: str, tick: int) -> list[tuple[str, ...]]:
    """Put what a source says, as a leg does, and return the ticks that became complete."""
    done = []
    if inbox.put(source, tick, value(source, tick)) is Receipt.NEW:
        while (values := inbox.pop(inbox.last + 1)) is not None:
            done.append(values)
    return done


def complete(tick: int) -> tuple[str, ...]:
    """Return all of a tick, in the order of sources."""
    return tuple(value(source, tick) for source in SOURCES)


@few
@given(data=st.data(), ticks=st.integers(1, 12))
def test_any_interleaving_gives_the_same_ticks(data: st.DataObject, ticks: int) -> None:
    """Each source in order, at most a few ticks apart: every tick complete, in order, once."""
    inbox, done = Inbox(*SOURCES), []
    ahead = dict.fromkeys(SOURCES, 0)
    while any(n < ticks for n in ahead.values()):
        slowest = min(ahead.values())
        open_to = [s for s, n in ahead.items() if n < min(ticks, slowest + KEPT)]
        source = data.draw(st.sampled_from(open_to))
        done += hear(inbox, source, ahead[source])
        ahead[source] += 1
    assert done == [complete(tick) for tick in range(ticks)]
    assert inbox.last == ticks - 1


@few
@given(data=st.data())
def test_a_tick_s_sources_come_in_any_order(data: st.DataObject) -> None:
    """In lockstep, where a tick is over before the next: any order, with any repetition."""
    inbox, done = Inbox(*SOURCES), []
    for tick in range(5):
        order = data.draw(st.permutations(SOURCES))
        again = data.draw(st.lists(st.sampled_from(SOURCES), max_size=3))
        for source in [*again, *order, *again]:
            done += hear(inbox, source, tick)
    assert done == [complete(tick) for tick in range(5)]


@few
@given(
    received=st.lists(st.tuples(st.sampled_from(SOURCES), st.integers(-2, 10) | st.just(10**12)))
)
def test_nothing_of_another_tick_is_ever_used(received: list[tuple[str, int]]) -> None:
    """Whatever is heard, lost or repeated: a tick taken is of one tick, and ticks only go on."""
    inbox = Inbox(*SOURCES)
    taken = []
    for source, tick in received:
        inbox.put(source, tick, value(source, tick))
        values = inbox.pop(tick)
        if values is not None:
            assert values == complete(tick)
            taken.append(tick)
    assert taken == sorted(set(taken))


def test_an_incomplete_tick_is_not_there() -> None:
    """Two of three are nothing, and asking does not end the tick."""
    inbox = Inbox(*SOURCES)
    inbox.put("joints", 0, "a")
    inbox.put("phase", 0, "b")
    assert inbox.pop(0) is None
    assert inbox.last == -1
    inbox.put("contact", 0, "c")
    assert inbox.pop(0) == ("a", "c", "b")
    assert inbox.pop(0) is None


def test_what_is_stale_is_refused() -> None:
    """A value of a tick that is over is not kept; that of the last tick is told from others."""
    inbox = Inbox(*SOURCES)
    for source in SOURCES:
        assert inbox.put(source, 3, 0) is Receipt.NEW
    inbox.pop(3)
    assert inbox.put("joints", 3, 0) is Receipt.REPEATED
    assert inbox.put("joints", 3, 1) is Receipt.OVER
    assert inbox.put("joints", 0, 0) is Receipt.OVER
    assert inbox.put("joints", 4, 0) is Receipt.NEW
    assert inbox.pending("joints") == [4]


def test_the_last_value_of_a_tick_counts() -> None:
    """A source that corrects itself within a tick is taken at its last word."""
    inbox = Inbox("one")
    inbox.put("one", 0, "first")
    inbox.put("one", 0, "second")
    assert inbox.pop(0) == ("second",)


def test_ticks_may_be_missed() -> None:
    """A leg that was away takes up at the first complete tick; what lies before it goes."""
    inbox = Inbox(*SOURCES)
    inbox.put("joints", 0, 0)
    inbox.put("contact", 1, 0)
    for source in SOURCES:
        inbox.put(source, 7, source)
    inbox.put("phase", 8, 0)
    assert inbox.pop(7) == SOURCES
    assert [inbox.pending(source) for source in SOURCES] == [[], [], [8]]


def test_stamps_of_the_far_future_do_not_stay() -> None:
    """Bad stamps, however many, neither pile up nor keep the true ticks from being complete."""
    inbox, done = Inbox(*SOURCES), []
    for tick in range(100):
        inbox.put("joints", 10**9 + tick, "bad")
        for source in SOURCES:
            done += hear(inbox, source, tick)
    assert done == [complete(tick) for tick in range(100)]
    assert len(inbox.pending("joints")) <= KEPT


def test_memory_is_bounded() -> None:
    """A source that nobody answers is kept for a few ticks only, the newest heard."""
    inbox = Inbox(*SOURCES)
    for tick in range(10_000):
        inbox.put("joints", tick, 0)
    assert inbox.pending("joints") == list(range(10_000 - KEPT, 10_000))


def test_wrong_stamps_do_not_push_out_a_tick_that_is_nearly_complete() -> None:
    """A burst of far future stamps from one source, while the tick cannot be used yet."""
    inbox = Inbox(*SOURCES)
    for source in SOURCES:
        inbox.put(source, 0, value(source, 0))
    for tick in range(1000, 1000 + 3 * KEPT):
        inbox.put("phase", tick, "bad")
    assert inbox.pop(0) == complete(0)


def test_ticks_that_stay_incomplete_do_not_keep_out_those_that_follow() -> None:
    """A leg that joins a walk may have missed the phase of all ticks that its inbox holds."""
    inbox = Inbox(*SOURCES)
    for tick in range(2 * KEPT):
        inbox.put("joints", tick, value("joints", tick))
        inbox.put("contact", tick, value("contact", tick))
    tick = 100
    for source in SOURCES:
        inbox.put(source, tick, value(source, tick))
    assert inbox.pop(tick) == complete(tick)


def through(inbox: Inbox, *ticks: int) -> None:
    """Hear all of some ticks."""
    for tick in ticks:
        for source in SOURCES:
            inbox.put(source, tick, value(source, tick))
        inbox.pop(tick)


def test_a_new_world_begins_anew() -> None:
    """When all sources speak of one tick from before, time begins anew, and ticks count again."""
    inbox = Inbox(*SOURCES)
    through(inbox, 40, 41)
    assert not inbox.time_restarted()
    for source in SOURCES:
        assert not inbox.time_restarted()
        assert inbox.put(source, 0, value(source, 0)) is Receipt.OVER
    assert inbox.time_restarted()
    assert inbox.last < 0
    assert not inbox.time_restarted()
    through(inbox, 0, 1)
    assert inbox.last == 1


def test_the_first_tick_of_a_new_world_is_complete() -> None:
    """What told that time began anew is that tick's own: it is there to be answered."""
    inbox = Inbox(*SOURCES)
    through(inbox, 40, 41)
    for source in SOURCES:
        inbox.put(source, 0, value(source, 0))
    assert inbox.time_restarted()
    assert inbox.pop(0) == complete(0)


@pytest.mark.parametrize("late", [(40, 40, 41), (40, 39, 38), (41, 41, 41)])
def test_late_repetitions_are_no_new_world(late: tuple[int, int, int]) -> None:
    """Old messages that come again, of several ticks or of the last one, do not turn time back."""
    inbox = Inbox(*SOURCES)
    through(inbox, 40, 41)
    for source, tick in zip(SOURCES, late, strict=True):
        inbox.put(source, tick, "again")
    assert not inbox.time_restarted()
    assert inbox.last == 41


def test_the_last_tick_repeated_whole_is_no_new_world() -> None:
    """A world that waits repeats its tick; nothing of it is used again."""
    inbox = Inbox(*SOURCES)
    through(inbox, 0)
    for source in SOURCES:
        assert inbox.put(source, 0, value(source, 0)) is Receipt.REPEATED
    assert not inbox.time_restarted()
    assert inbox.pop(0) is None


def test_a_new_world_may_begin_at_the_tick_where_the_old_one_ended() -> None:
    """Both at tick 0: other values are of another world."""
    inbox = Inbox(*SOURCES)
    through(inbox, 0)
    for source in SOURCES:
        inbox.put(source, 0, "phase 0" if source == "phase" else "other")
    assert inbox.time_restarted()
    assert inbox.pop(0) == ("other", "other", "phase 0")


def test_old_repetitions_do_not_add_up_to_a_new_world() -> None:
    """One source repeated once in a while, over a run in which time goes on, is no new world."""
    inbox = Inbox(*SOURCES)
    through(inbox, 10, 11)
    for n, source in enumerate(SOURCES):
        inbox.put(source, 10, "again")
        through(inbox, 12 + n)
    assert not inbox.time_restarted()
