"""Style, file form and data address of the project's figures: the same marks give the same bytes."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

# M. Okabe, K. Ito: told apart with every kind of colour vision; markers, lines and hatches repeat the distinction
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f")
MARKERS = "osD^vP*X<>"
LINES = ("-", "--", "-.", ":")
STYLE: Any = {
    "svg.hashsalt": "phibench",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "hatch.linewidth": 0.6,
}
_MIME = {"svg": "image/svg+xml", "png": "image/png"}
_METADATA: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "png": {"Software": None}}


@dataclass(frozen=True)
class Picture:
    """A figure as a data address, with its alternative in words."""

    source: str
    alt: str


def line_style(i: int) -> dict[str, Any]:
    """Colour, line and marker of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)], "marker": MARKERS[i % len(MARKERS)]}


def encoded(figure: Figure, kind: str) -> bytes:
    """A figure as a file, "svg" or "png"."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_METADATA[kind])
    return buffer.getvalue()


def picture(data: bytes, kind: str, alt: str) -> Picture:
    """An encoded figure as a picture."""
    return Picture(f"data:{_MIME[kind]};base64,{base64.b64encode(data).decode('ascii')}", alt)
