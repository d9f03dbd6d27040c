"""Drawing of docs/geometry.png: lengths and angles of the paper. Run `python docs/draw_geometry.py`.

The rays are solved, not sketched. Mirror, lens distance and stroke are enlarged against the room to show the angles.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle

from phibench.render.optics.reflection_point import reflection_points

RADIUS, Z_C, STROKE, SPOT = 0.42, 1.0, 1.75, np.array([4.2, 0.35])
BLUE, RED, GREY = "#1f5fa8", "#c03028", "0.45"


def reflection(eye_z: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lens centre, sphere centre and reflection point in the (x, z) plane for a lens at height `eye_z`."""
    eye, centre = np.array([0.0, eye_z]), np.array([0.0, eye_z + Z_C])
    points = [np.array([[p[0], 0.0, p[1]]]) for p in (SPOT - centre, eye - centre)]
    found, _ = reflection_points(*points, RADIUS)
    return eye, centre, centre + found[0, [0, 2]]


def arc(ax: Axes, at: np.ndarray, size: float, start: float, stop: float, label: str, colour: str, out: float) -> None:
    """Arc between two directions (degrees from +x) with its label on the bisector."""
    ax.add_patch(Arc(at, 2 * size, 2 * size, theta1=min(start, stop), theta2=max(start, stop), color=colour, lw=1.6))
    middle = np.radians(0.5 * (start + stop))
    ax.text(*(at + out * np.array([np.cos(middle), np.sin(middle)])), label, color=colour, ha="center", va="center")


def degrees(v: np.ndarray) -> float:
    """Direction of a vector, degrees from +x."""
    return float(np.degrees(np.arctan2(v[1], v[0])))


def overview(ax: Axes) -> None:
    """Both positions with h, z_c and D, and the triangle of eq. (1)."""
    for eye_z, colour, name in ((0.35, BLUE, "1 (down)"), (0.35 + STROKE, RED, "2 (up)")):
        eye, centre, mirror = reflection(eye_z)
        ax.add_patch(Circle(centre, RADIUS, fill=False, color=colour, lw=1.6))
        ax.plot(*np.stack([eye, mirror, SPOT]).T, color=colour, lw=1.2)
        ax.plot(*eye, "s", color=colour, ms=6)
        ax.plot(*centre, ".", color=colour)
        ax.text(0.52, centre[1] + 0.18, f"position {name}", color=colour, va="center")
        ax.text(-0.14, eye[1], "lens", color=colour, ha="right", va="center")
    ax.plot([0, 0], [0.0, 3.6], color=GREY, lw=0.8, ls="-.")
    ax.plot([SPOT[0] + 0.03] * 2, [0.0, 3.3], color="k", lw=3)
    ax.plot(*SPOT, "*", color=RED, ms=13)
    ax.text(SPOT[0] - 0.08, 3.1, "wall", ha="right")
    ax.text(SPOT[0] - 0.08, SPOT[1] + 0.85, "laser spot", ha="right", color=RED)
    dimension(ax, (0.0, 0.08), (SPOT[0], 0.08), "D", (2.9, 0.12))
    _, centre, mirror = reflection(0.35)
    dimension(ax, (mirror[0], SPOT[1]), (mirror[0], mirror[1]), "$H_1$", (mirror[0] + 0.08, 0.55))
    dimension(ax, (mirror[0], SPOT[1]), (SPOT[0], SPOT[1]), "$D_1$", (1.6, SPOT[1] + 0.04))
    dimension(ax, (-0.62, 0.35), (-0.62, centre[1]), "$z_c$", (-0.98, 0.75))
    dimension(ax, (-1.15, 0.35), (-1.15, 0.35 + STROKE), "h", (-1.4, 1.5))
    for z, out in ((0.35, -1.25), (centre[1], -0.7), (0.35 + STROKE, -1.25)):
        ax.plot([out, -0.5 if z != centre[1] else 0.0], [z, z], color=GREY, lw=0.6)
    ax.set(xlim=(-1.5, 4.4), ylim=(0.0, 3.7), title="lengths")


def dimension(
    ax: Axes, start: tuple[float, float], end: tuple[float, float], label: str, at: tuple[float, float]
) -> None:
    """Double arrow with its label."""
    ax.annotate("", start, end, arrowprops={"arrowstyle": "<->", "lw": 0.9, "shrinkA": 0, "shrinkB": 0})
    ax.text(*at, label, fontsize=12)


def closeup(ax: Axes) -> None:
    """The angles at one reflection point."""
    eye, centre, mirror = reflection(0.35 + STROKE)
    to_eye, to_spot = ((p - mirror) / np.linalg.norm(p - mirror) for p in (eye, SPOT))
    normal = (mirror - centre) / RADIUS
    ax.add_patch(Circle(centre, RADIUS, fill=False, color="k", lw=1.4))
    for v, name, colour in ((to_eye, "to the lens", BLUE), (to_spot, "to the spot", RED), (normal, "normal", "k")):
        ax.annotate("", mirror + 0.62 * v, mirror, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.5})
        ax.text(*(mirror + 0.68 * v), name, color=colour, ha="center", va="center", fontsize=9)
    ax.plot(*np.stack([mirror, mirror - [0, 0.75]]).T, color=GREY, ls="-.", lw=0.9)
    ax.text(*(mirror - [0, 0.80]), "vertical", color=GREY, ha="center", fontsize=9)
    ax.plot(*np.stack([centre, mirror]).T, color="k", ls=":", lw=1)
    n, e, s = degrees(normal), degrees(to_eye), degrees(to_spot)
    arc(ax, mirror, 0.50, -90.0, s, "", RED, 0.5)
    ax.text(mirror[0] + 0.38, mirror[1] - 0.52, r"$\theta = 2\,\varphi_{ray}$", color=RED)
    arc(ax, mirror, 0.36, -90.0, n, "", "k", 0.43)
    ax.text(mirror[0] - 0.02, mirror[1] - 0.40, r"$\varphi_{normal}$", ha="right")
    arc(ax, mirror, 0.16, n, s, "", "#2a8050", 0.16)
    ax.text(mirror[0] + 0.13, mirror[1] - 0.20, r"$\varphi_{incidence}$", color="#2a8050", va="center")
    arc(ax, mirror, 0.20, e, n, "", "#2a8050", 0.2)
    ax.plot(*centre, ".k")
    ax.text(centre[0], centre[1] + 0.04, "sphere centre", ha="center", va="bottom", fontsize=9)
    low, high = mirror - [0.62, 0.90], mirror + [0.86, 0.92]
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title="angles at the reflection point")


def main() -> None:
    """Write the picture beside this file."""
    mpl.use("Agg")
    figure = Figure(figsize=(8.6, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.45, 1.0))
    overview(left)
    closeup(right)
    for ax in (left, right):
        ax.set_aspect("equal")
        ax.axis("off")
    figure.savefig(Path(__file__).with_name("geometry.png"), dpi=100, metadata={"Software": None})


if __name__ == "__main__":
    main()
