"""Draw one episode of the loop from above, and how well three policies know D as time goes: docs/loop.png.

.venv/bin/python docs/draw_loop.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from phibench.estimator.loop.arena import Boxes, generated_arena
from phibench.estimator.loop.policies import POLICIES, SearchingPolicy
from phibench.estimator.loop.simulator import RUNNING, Setup, Simulator
from phibench.scenes.frames import Array

OUT = Path(__file__).with_name("loop.png")
STREAM = ("figure", 4)
COLOURS = {"paper": "#0072b2", "greedy": "#d55e00", "drive-only": "#009e73"}


@dataclass(frozen=True)
class Trace:
    """One episode: shape (n,) each; places of the base (n, 2)."""

    time_s: Array
    place_m: Array
    share: Array
    stroke_m: Array
    outcome: str


def trace(simulator: Simulator, name: str) -> Trace:
    """Run a policy through the episode of `STREAM`."""
    observation = simulator.start(*STREAM)
    policy = POLICIES[name](simulator.setup.known, simulator)
    assert isinstance(policy, SearchingPolicy)
    rows = []
    while simulator.outcome == RUNNING:
        observation = simulator.act(policy.act(observation))
        belief = policy.belief
        share = np.nan if belief is None else belief.distance_sigma_m / belief.distance_m
        rows.append((simulator.time_s, simulator.pose.x_m, simulator.pose.y_m, share, simulator.stroke_m))
    t, x, y, share, stroke = np.array(rows).T
    return Trace(t, np.stack([x, y], axis=-1), share, stroke, simulator.outcome)


def plan(ax: Axes, boxes: Boxes, simulator: Simulator, traces: dict[str, Trace]) -> None:
    """Room, way and target from above."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for centre, axes, half in zip(boxes.centre_m, boxes.axes, boxes.half_m, strict=True):
        outline = centre[:2] + (corners * np.maximum(half[:2], 0.02)) @ axes[:2, :2].T
        ax.add_patch(Polygon(outline, facecolor="#bbbbbb", edgecolor="#888888", linewidth=0.4))
    target = simulator.target.point_m
    ax.add_patch(Circle(target[:2], simulator.setup.task.stand_off_m, fill=False, linestyle=":", edgecolor="black"))
    for name, one in traces.items():
        ax.plot(*one.place_m.T, color=COLOURS[name], linewidth=1.5)
    ax.plot(0, 0, "ks", markersize=5)
    ax.plot(*target[:2], "r*", markersize=12)
    ax.set_aspect("equal")
    low, high = np.minimum(target[:2], 0) - 1.5, np.maximum(target[:2], 0) + 1.5
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m (start: square, target: star)")


def knowledge(ax: Axes, below: Axes, traces: dict[str, Trace]) -> None:
    """Relative standard deviation of D, and the stroke, against time."""
    for name, one in traces.items():
        ax.plot(one.time_s, 100 * one.share, color=COLOURS[name], label=f"{name}: {one.outcome}")
        below.plot(one.time_s, one.stroke_m, color=COLOURS[name])
    ax.set_yscale("log")
    ax.axhline(2.0, color="grey", linewidth=0.8)
    ax.set_ylabel("sigma of D, % (line: tolerance)")
    ax.legend(frameon=False, fontsize=8)
    below.set_ylabel("stroke, m")
    below.set_xlabel("time, s")


def main() -> None:
    """Write the figure."""
    simulator = Simulator(Setup(arenas=tuple(generated_arena("loop", k) for k in range(3, 6))))
    traces = {name: trace(simulator, name) for name in COLOURS}
    figure = Figure(figsize=(10, 4.5), layout="constrained", dpi=110)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.2))
    plan(left.subplots(), simulator.arena.floor, simulator, traces)
    knowledge(*right.subplots(2, 1, sharex=True, height_ratios=(3, 1)), traces)
    figure.savefig(OUT)
    for name, one in traces.items():
        print(name, one.outcome, f"{one.time_s[-1]:.1f} s")


if __name__ == "__main__":
    main()
