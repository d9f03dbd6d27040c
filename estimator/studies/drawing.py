"""Drawings of a study: SVG, or PNG where there are many marks, each with its text alternative."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.figure import Figure

from phibench.estimator.bench import picture
from phibench.estimator.bench.picture import Picture

COLOURS = (*picture.COLOURS, "#000000")
MARKERS, LINES, line_style = picture.MARKERS, picture.LINES, picture.line_style


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
        return picture.picture(self.data, self.kind, self.alt)


@contextmanager
def canvas(width_in: float = 9.0, height_in: float = 4.0) -> Iterator[Figure]:
    """A figure in the style of all studies; draw and call `drawn` inside of the block."""
    with mpl.rc_context(picture.STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained", dpi=130)


def drawn(name: str, figure: Figure, alt: str, kind: str = "svg") -> Drawing:
    """The finished drawing; the same marks give the same bytes."""
    return Drawing(name, picture.encoded(figure, kind), alt, kind)
