"""Drawing of docs/misalignment.png, and the tables of docs/misalignment.md. Run `python docs/draw_misalignment.py`.

A test compares the tables with the page.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch

from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.sensitivities import PARAMETERS as GEOMETRIC
from phibench.estimator.geometry.sensitivities import sensitivity
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.form_error import HARMONICS
from phibench.scenes.frames import Pose
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig

BLUE, RED, GREY = "#1f5fa8", "#c03028", "0.55"
DEPTHS_M, STROKE_M, Z_C_M, BELOW_SPHERE_M = (1.0, 2.5, 4.2), 0.5, 0.30, 0.20
HALF_DEGREE, TENTH = math.radians(0.5), math.radians(0.1)
# Size of an error, the same in words, and percent of D at the three depths by a prototype that shares no code.
BUDGET: dict[str, tuple[float, str, str]] = {
    "tilt_y_rad": (HALF_DEGREE, "0.5 deg", "-5.1 / +0.9 / +2.8"),
    "decentre_x_m": (1e-3, "1 mm", "+1.4 / -1.2 / -2.0"),
    "cx_px": (5.0, "5 px", "+1.4 / -1.2 / -2.0"),
    "radius_m": (6e-4, "1 %", "-0.5 / -1.5 / -1.9"),
    "focal_relative": (0.01, "1 %", "-0.5 / -1.4 / -1.7"),
    "axial_m": (1e-3, "1 mm", "0.2 / 0.5 / 0.6"),
    "stroke_offset_m": (1e-3, "1 mm", "0.2"),
    "stroke_tilt_y_rad": (HALF_DEGREE, "0.5 deg", "0.6 / 0.2 / 0.1"),
    "pitch_rad": (TENTH, "0.1 deg", "0.4 / 0.9 / 1.5"),
    "shift_x_m": (1e-3, "1 mm", "-"),
    "shift_z_m": (1e-3, "1 mm", "-"),
    "stroke_relative": (2e-3, "0.2 %", "-"),
    "k1": (0.03, "0.03", "-"),
    "k2": (0.3, "0.3", "-"),
    "k3": (1.0, "1", "-"),
    "p1": (1e-3, "0.001", "-"),
    "p2": (1e-3, "0.001", "-"),
    "decentre_y_m": (1e-3, "1 mm", "-"),
    "tilt_x_rad": (HALF_DEGREE, "0.5 deg", "-"),
    "cy_px": (5.0, "5 px", "-"),
    "stroke_tilt_x_rad": (HALF_DEGREE, "0.5 deg", "-"),
    "roll_rad": (TENTH, "0.1 deg", "-"),
    "yaw_rad": (TENTH, "0.1 deg", "-"),
    "shift_y_m": (1e-3, "1 mm", "-"),
    **dict.fromkeys(HARMONICS, (2e-5, "20 um", "-")),
}
ESTIMATORS = ("exact", "paper_ray", "paper_normal", "paper_incidence", "paper_outline", "approx_ray")
COMPARED = tuple(name for name in BUDGET if name not in ("k1", "k2", "k3", "p1", "p2", "stroke_relative"))[:10]


def budget_rig() -> Rig:
    """Aligned rig of the budget: lens at 0.45 m when down, z_c = 0.30 m."""
    return dataclasses.replace(default_rig(), T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, Z_C_M)))


def spot_at(depth_m: float) -> np.ndarray:
    """Spot along world +x, 0.20 m below the sphere centre when down."""
    return np.array([depth_m, 0.0, budget_rig().at(0.0).sphere_centre_m[2] - BELOW_SPHERE_M])


def whole_change(name: str, by: float, depth_m: float) -> float:
    """D by the exact estimator with nominal numbers, over the nominal D, minus 1."""
    nominal, m = budget_rig(), Misalignment(**{name: by})
    true = nominal.perturbed(m)
    down, up = (image_of(true.at(offset), spot_at(depth_m)).uv_px for offset in (0.0, m.stroke_m(STROKE_M)))
    return float(depth_exact(nominal, STROKE_M, down, up).depth_m) / depth_m - 1.0


def slope(estimator: str, name: str, depth_m: float) -> float:
    """d(estimate)/d(parameter), metres per unit, at the aligned rig."""
    rig = budget_rig()
    found = sensitivity(estimator, rig, STROKE_M, rig, STROKE_M, spot_at(depth_m))
    return float(found.estimate_gradient[GEOMETRIC.index(name)])


def parameter_table() -> str:
    """Every parameter with unit, range, study magnitude, prior of a calibration, and meaning."""
    rows = []
    for name, one in PARAMETERS.items():
        prior = "-" if math.isnan(one.prior_sigma) else f"{one.prior_sigma:.2g}"
        rows.append((f"`{name}`", one.unit, f"{one.limit:g}", f"{one.study:g}", prior, one.meaning))
    return table(("parameter", "unit", "largest", "study", "prior", "meaning"), rows)


def budget_table() -> str:
    """dD/dp of the exact estimator, and what an error of usual size does, beside the prototype's numbers."""
    rows = []
    for name, (size, words, prototype) in BUDGET.items():
        slopes = " / ".join(number(slope("exact", name, depth)) for depth in DEPTHS_M)
        whole = " / ".join(percent(whole_change(name, size, depth)) for depth in DEPTHS_M)
        linear = " / ".join(percent(slope("exact", name, depth) * size / depth) for depth in DEPTHS_M)
        rows.append((f"`{name}`", slopes, words, linear, whole, prototype))
    return table(
        ("parameter", "dD/dp, m per unit", "error", "slope x error, %", "whole change, %", "prototype, %"), rows
    )


def estimator_table() -> str:
    """dD/dp at D = 2.5 m by estimator."""
    rows = [(f"`{name}`", *(number(slope(e, name, 2.5)) for e in ESTIMATORS)) for name in COMPARED]
    return table(("parameter", *(f"`{name}`" for name in ESTIMATORS)), rows)


def table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown table."""
    lines = [heading, tuple("---" for _ in heading), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def number(value: float) -> str:
    """Three digits; below 1e-6 it is rounding or nothing."""
    return "0" if abs(value) < 1e-6 else f"{value:+.3g}"


def percent(value: float) -> str:
    """Percent to 0.01."""
    return "0" if abs(value) < 5e-5 else f"{100.0 * value:+.2f}"


# -- the figure ----------------------------------------------------------------------------------------------------


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], bend: float = 0.0) -> None:
    """Red arrow from `start` to `end`."""
    style = f"arc3,rad={bend}"
    ax.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, color=RED, connectionstyle=style))


def rig(ax: Axes, lens: tuple[float, float], lean_rad: float, sphere: tuple[float, float], colour: str) -> None:
    """Camera, its axis and the sphere in the (x, z) plane; a lean towards +x is positive."""
    turn = np.array([[math.cos(lean_rad), math.sin(lean_rad)], [-math.sin(lean_rad), math.cos(lean_rad)]])
    body = np.array([[-0.3, -0.25], [0.3, -0.25], [0.3, 0.0], [-0.3, 0.0], [-0.3, -0.25]]) @ turn.T + lens
    axis = np.array([[0.0, 0.0], [0.0, 1.25]]) @ turn.T + lens
    ax.plot(*body.T, color=colour, lw=1.4)
    ax.plot(*axis.T, color=colour, lw=0.9, ls="-.")
    ax.add_patch(Circle(sphere, 0.42, fill=False, color=colour, lw=1.4))
    ax.plot(*sphere, ".", color=colour, ms=4)


def panel(ax: Axes, title: str) -> None:
    """Empty panel with world axes."""
    ax.set_title(title, fontsize=9)
    ax.set_aspect("equal")
    ax.set_xlim(-1.5, 1.9)
    ax.set_ylim(-0.6, 3.5)
    ax.axis("off")
    for label, end in (("x (front)", (-0.75, -0.45)), ("z", (-1.3, 0.1))):
        ax.text(*end, f" {label}", fontsize=8, color=GREY, va="center" if label != "z" else "bottom")
        ax.add_patch(FancyArrowPatch((-1.3, -0.45), end, arrowstyle="-|>", mutation_scale=7, color=GREY))


def sphere_panel(ax: Axes) -> None:
    """The sphere moves."""
    panel(ax, "decentre_x_m,\naxial_m")
    rig(ax, (0.0, 0.0), 0.0, (0.0, 1.6), GREY)
    rig(ax, (0.0, 0.0), 0.0, (0.45, 2.0), BLUE)
    arrow(ax, (0.0, 1.6), (0.45, 1.6))
    arrow(ax, (0.45, 1.6), (0.45, 2.0))
    ax.text(0.55, 1.45, "+x, +z", color=RED, fontsize=8)


def tilt_panel(ax: Axes) -> None:
    """The camera turns about its lens."""
    panel(ax, "tilt_y_rad\n(tilt_x_rad: towards -y)")
    rig(ax, (0.0, 0.0), 0.0, (0.0, 1.6), GREY)
    rig(ax, (0.0, 0.0), 0.35, (0.0, 1.6), BLUE)
    arrow(ax, (0.0, 1.1), (0.38, 1.03), -0.15)
    ax.text(0.5, 0.95, "+", color=RED, fontsize=11)


def stroke_panel(ax: Axes) -> None:
    """The stroke axis leans."""
    panel(ax, "stroke_tilt_y_rad\n(stroke_tilt_x_rad: to -y)")
    rig(ax, (-0.3, 0.0), 0.0, (-0.3, 1.0), GREY)
    rig(ax, (0.35, 1.9), 0.0, (0.35, 2.9), BLUE)
    ax.plot([-0.3, -0.3], [0.0, 2.0], color=GREY, ls=":")
    ax.plot([-0.3, 0.35], [0.0, 1.9], color=BLUE, ls=":")
    arrow(ax, (-0.3, 1.7), (0.25, 1.6), -0.15)
    ax.text(0.45, 1.35, "+", color=RED, fontsize=11)


def motion_panel(ax: Axes) -> None:
    """The whole rig turns about the lens, and shifts, when up."""
    panel(ax, "pitch_rad, shift_x_m\n(up image only)")
    rig(ax, (-0.3, 0.4), 0.0, (-0.3, 2.0), GREY)
    rig(ax, (0.3, 0.4), 0.3, (0.3 + 1.6 * math.sin(0.3), 0.4 + 1.6 * math.cos(0.3)), BLUE)
    arrow(ax, (-0.3, 0.4), (0.3, 0.4))
    arrow(ax, (0.3, 2.5), (0.98, 2.4), -0.15)
    ax.text(1.1, 2.5, "+", color=RED, fontsize=11)


def draw(file: Path) -> None:
    """Write the figure."""
    mpl.use("agg")
    figure = Figure(figsize=(8.0, 3.2))
    panels = (sphere_panel, tilt_panel, stroke_panel, motion_panel)
    for ax, paint in zip(figure.subplots(1, len(panels)), panels, strict=True):
        paint(ax)
    figure.tight_layout()
    figure.savefig(file, dpi=100, metadata={"Software": None})


def main() -> None:
    """Draw the figure and print the tables."""
    draw(Path(__file__).with_name("misalignment.png"))
    print(parameter_table(), budget_table(), estimator_table(), sep="\n")


if __name__ == "__main__":
    main()
