"""How fast a phase grows, as whoever hears the beat can know it. Pure."""

from __future__ import annotations

from ember_ros.signals import Beat


class PhaseRate:
    """Predicts by how much the phase grows in the tick that begins: as much as in the last one.

    A beat tells where the phase is, not where it will be; with a fixed period the prediction is
    exact.
    """

    def __init__(self, first: float) -> None:
        """Begin before any beat.

        Args:
            first: what to predict at the first beat, cycles per tick.
        """
        self._first = self._growth = first
        self._last: Beat | None = None

    def per_tick(self, beat: Beat) -> float:
        """Return the growth, cycles, that is predicted for the tick that begins with ``beat``.

        Ticks that were missed count with their mean; the prediction begins anew where time does.
        """
        last, self._last = self._last, beat
        if last is not None and beat.tick > last.tick and beat.phase >= last.phase:
            self._growth = (beat.phase - last.phase) / (beat.tick - last.tick)
        elif last is not None and beat != last:
            self._growth = self._first
        return self._growth
