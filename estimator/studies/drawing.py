"""Drawings of a study: SVG, or PNG where there are many marks, each with its text alternative."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from phibench.estimator.bench.figures import Picture

# M. Okabe, K. Ito: told apart with every kind of colour vision; markers and lines repeat the distinction
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
MARKERS = "osD^vP*X"
LINES = ("-", "--", "-.", ":")
_STYLE: Any = {"svg.hashsalt": "phibench", "font.size": 9.0, "axes.grid": True, "grid.alpha": 0.35}
_MIME = {"svg": "image/svg+xml", "png": "image/png"}
_METADATA: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "png": {"Software": None}}


@dataclass(frozen=True)
class Drawing:
    """A drawing.

    Attributes
    ----------
    name : str
        File name without its ending.
    data : bytes
    alt : str
        What it shows, in words, with its main numbers.
    kind : "svg" or "png"
    """

    name: str
    data: bytes
    alt: str
    kind: str = "svg"

    @property
    def file_name(self) -> str:
        """Name of its file."""
        return f"{self.name}.{self.kind}"

    def picture(self) -> Picture:
        """The drawing as a data address, for a report."""
        return Picture(f"data:{_MIME[self.kind]};base64,{base64.b64encode(self.data).decode('ascii')}", self.alt)


@contextmanager
def canvas(width_in: float = 9.0, height_in: float = 4.0) -> Iterator[Figure]:
    """A figure in the style of all studies; draw and call `drawn` inside of the block."""
    with mpl.rc_context(_STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained", dpi=130)


def drawn(name: str, figure: Figure, alt: str, kind: str = "svg") -> Drawing:
    """The finished drawing; the same marks give the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_METADATA[kind])
    return Drawing(name, buffer.getvalue(), alt, kind)


def line_style(i: int) -> dict[str, Any]:
    """Colour, line and marker of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)], "marker": MARKERS[i % len(MARKERS)]}
