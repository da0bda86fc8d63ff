"""A figure that a notebook shows, whatever backend it has and whether pyplot is used in it."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure


class Picture(Figure):
    """A matplotlib figure that says itself how it looks."""

    def _repr_png_(self) -> bytes:
        """Return the picture for IPython, which asks where no inline backend is at work yet."""
        out = BytesIO()
        self.savefig(out, format="png")
        return out.getvalue()
