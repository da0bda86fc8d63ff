"""A figure that a notebook can display with any backend and without pyplot."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure


class Picture(Figure):
    """A matplotlib figure with its own PNG representation for notebooks."""

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG; IPython calls this if no inline backend is active."""
        out = BytesIO()
        self.savefig(out, format="png")
        return out.getvalue()
