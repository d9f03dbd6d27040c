"""Drawing of docs/pipeline.png: from a recipe to a score. Run `python docs/draw_pipeline.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

INK, GREY, PAPER = "#1d2733", "#5b6672", "white"
# folder, what it does, what it holds, colour
FOLDERS = (
    ("scenes", "what exists", ("rig, mirror", "room, laser", "misalignment"), "#dbe7f5"),
    ("render", "light and sensor", ("ambient layer", "spot layer, truth", "camera's chain"), "#fbe3d3"),
    ("datasets", "files", ("recipes, workers", "layers, manifest", "frames"), "#dff0df"),
    ("estimator", "answers and scores", ("methods, phi, D", "calibration", "bounds, reports"), "#ece2f3"),
)
WIDTH, GAP, HEIGHT = 1.62, 0.32, 1.5
BOTTOM = 0.85


def folder(ax: Axes, number: int) -> None:
    """One box with its name, its role and three lines of content."""
    name, role, content, colour = FOLDERS[number]
    left = number * (WIDTH + GAP)
    shape = FancyBboxPatch((left, BOTTOM), WIDTH, HEIGHT, boxstyle="round,pad=0,rounding_size=0.08", fc=colour, ec=INK)
    ax.add_patch(shape)
    middle = left + WIDTH / 2
    ax.text(middle, BOTTOM + 1.27, name, ha="center", va="center", fontsize=12.5, weight="bold", color=INK)
    ax.text(middle, BOTTOM + 1.02, role, ha="center", va="center", fontsize=9.5, style="italic", color=GREY)
    for row, line in enumerate(content):
        ax.text(middle, BOTTOM + 0.70 - 0.24 * row, line, ha="center", va="center", fontsize=10, color=INK)
    if number:
        arrow(ax, (left - GAP, BOTTOM + HEIGHT / 2), (left, BOTTOM + HEIGHT / 2))


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Arrow from one box to the next."""
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "lw": 1.8, "color": INK, "shrinkA": 1, "shrinkB": 1})


def outside(ax: Axes, number: float, text: str, down: bool) -> None:
    """Draw the label and arrow below a box: the input or output of a user."""
    x = number * (WIDTH + GAP) + WIDTH / 2
    ends = ((x, 0.44), (x, BOTTOM)) if not down else ((x, BOTTOM), (x, 0.44))
    arrow(ax, *ends)
    ax.text(x, 0.40, text, ha="center", va="top", fontsize=10, color=INK, linespacing=1.1)


def main() -> None:
    """Write the picture beside this file."""
    mpl.use("Agg")
    figure = Figure(figsize=(7.6, 2.5), facecolor=PAPER)
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    for number in range(len(FOLDERS)):
        folder(ax, number)
    outside(ax, 0, "your recipe\n(TOML)", down=False)
    outside(ax, 2, "images with\nexact truth", down=True)
    outside(ax, 2.78, "your method\n(Python)", down=False)
    outside(ax, 3.28, "scores,\nreport", down=True)
    ax.set(xlim=(-0.1, 4 * WIDTH + 3 * GAP + 0.1), ylim=(0.0, BOTTOM + HEIGHT + 0.1))
    ax.axis("off")
    figure.savefig(Path(__file__).with_name("pipeline.png"), dpi=100, metadata={"Software": None})


if __name__ == "__main__":
    main()
