"""One episode of the study `loop` in four pictures, and episodes as films."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.film.film_video import write_mp4
from phibench.robot.loop.arena import Arena, Boxes, plain_arena
from phibench.robot.loop.episodes import built_in_policy
from phibench.robot.loop.policies import Policy, SearchingPolicy
from phibench.robot.loop.robot_pixels import Window
from phibench.robot.loop.simulator import REACHED, RUNNING, Observation, Setup, Simulator
from phibench.scenes.frames import Array
from phibench.scenes.room import ROBOT_SIZE_M
from phibench.studies.framework import Drawing, canvas, finished_drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
_TARGET, _WAY, _ROBOT = "#cc3311", "#0072b2", "#444444"


@dataclass
class Track:
    """Course of an episode so far, a number per step."""

    time_s: list[float] = field(default_factory=list)
    place_m: list[tuple[float, float]] = field(default_factory=list)
    distance_m: list[float] = field(default_factory=list)
    believed_m: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    stroke_m: list[float] = field(default_factory=list)
    lit: list[bool] = field(default_factory=list)

    def add(self, simulator: Simulator, policy: Any, observation: Observation) -> None:
        """Take in a step."""
        belief = getattr(policy, "belief", None)
        self.time_s.append(simulator.time_s)
        self.place_m.append((simulator.pose.x_m, simulator.pose.y_m))
        self.distance_m.append(simulator.distance_m)
        self.believed_m.append(math.nan if belief is None else belief.distance_m)
        self.sigma_m.append(math.nan if belief is None else belief.distance_sigma_m)
        self.stroke_m.append(simulator.stroke_m)
        self.lit.append(observation.lit)


def episode_steps(
    setup: Setup, policy: str | Policy, *stream: str | int
) -> Iterator[tuple[Simulator, SearchingPolicy, Observation, Track]]:
    """Steps of an episode of a policy, a built-in one by its name."""
    simulator, track = Simulator(setup), Track()
    observation = simulator.start(*stream)
    chosen: Any = built_in_policy(policy)(setup.known, simulator) if isinstance(policy, str) else policy
    while simulator.outcome == RUNNING:
        action = chosen.act(observation)  # the belief then holds this observation
        track.add(simulator, chosen, observation)
        yield simulator, chosen, observation, track
        observation = simulator.act(action)
    track.add(simulator, chosen, observation)
    yield simulator, chosen, observation, track


def process_drawing(seed: int = 4) -> Drawing:
    """One episode of the paper's process: room from above, D as believed, stroke, laser."""
    setup = Setup(arenas=(plain_arena("figure", seed),))
    simulator, _, _, track = list(episode_steps(setup, "paper", "figure", seed))[-1]
    with canvas(10.0, 4.6) as figure:
        parts: Any = figure.subfigures(1, 2, width_ratios=(1, 1.2))
        left, right = parts
        top_view(left.subplots(), simulator, track)
        depth, stroke, laser = right.subplots(3, 1, sharex=True, height_ratios=(3, 1, 0.5))
        belief_axes(depth, track)
        stroke.plot(track.time_s, track.stroke_m, color=_WAY)
        stroke.set_ylabel("stroke, m")
        laser.step(track.time_s, np.array(track.lit, float), color=_TARGET, linewidth=0.8)
        laser.set_yticks([0, 1], ["off", "on"])
        laser.set_xlabel("time, s")
        for time, name in phases(track):
            for ax in (depth, stroke, laser):
                ax.axvline(time, color="grey", linewidth=0.5)
            depth.annotate(name, (time, 1.0), (2, -2), xycoords=("data", "axes fraction"), textcoords="offset points",
                           va="top", fontsize=7)  # fmt: skip
        end, way = track.time_s[-1], simulator.driven_m
        alt = f"One episode: {simulator.outcome} after {end:.1f} s, {way:.2f} m, {simulator.strokes} strokes"
        return finished_drawing("process", figure, alt + ".")


def phases(track: Track) -> list[tuple[float, str]]:
    """Begin of each part of the process."""
    time, known = np.array(track.time_s), np.isfinite(track.sigma_m)
    # moves in a step
    stroke, way = np.abs(np.diff(track.stroke_m)) > 1e-9, np.hypot(*np.diff(track.place_m, axis=0).T) > 0.01
    begins = [(0.0, "identify")]
    if known.any():
        first = int(np.argmax(known))
        begins.append((float(time[first]), "orient"))
        if stroke[first:].any():
            begin = first + int(np.argmax(stroke[first:]))
            begins.append((float(time[begin]), "stroke"))
            if way[begin:].any():
                begins.append((float(time[begin + int(np.argmax(way[begin:]))]), "servo"))
    return begins


def top_view(ax: Axes, simulator: Simulator, track: Track) -> None:
    """Room, robot, way and target from above."""
    from matplotlib.patches import Circle, Polygon

    _boxes(ax, simulator.arena)
    target = simulator.target.point_m
    x, y = map(float, target[:2])
    ax.add_patch(Circle((x, y), simulator.setup.task.stand_off_m, fill=False, linestyle=":", edgecolor="black"))
    ax.plot(*np.array(track.place_m).T, color=_WAY, linewidth=1.5)
    pose = simulator.pose
    c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    outline = 0.5 * _CORNERS * ROBOT_SIZE_M[:2] @ np.array([[c, s], [-s, c]])
    ax.add_patch(Polygon(outline + (pose.x_m, pose.y_m), facecolor="#999944", edgecolor=_ROBOT, alpha=0.8))
    ax.plot(*target[:2], "*", color=_TARGET, markersize=12)
    ax.set_aspect("equal")
    corners = np.array([target[:2], (0.0, 0.0)])
    (left, below), (right, above) = corners.min(axis=0) - 1.4, corners.max(axis=0) + 1.4
    ax.set_xlim(left, right)
    ax.set_ylim(below, above)
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m")


def _boxes(ax: Axes, arena: Arena) -> None:
    from matplotlib.patches import Polygon

    boxes: Boxes = arena.floor
    for centre, axes, half in zip(boxes.centre_m, boxes.axes, boxes.half_m, strict=True):
        # walls are thin: drawn 4 cm wide
        outline = centre[:2] + (_CORNERS * np.maximum(half[:2], 0.02)) @ axes[:2, :2].T
        ax.add_patch(Polygon(outline, facecolor="#bbbbbb", edgecolor="#888888", linewidth=0.4))


def belief_axes(ax: Axes, track: Track) -> None:
    """True D, and what is believed with two standard deviations."""
    t, believed, sigma = (np.array(x) for x in (track.time_s, track.believed_m, track.sigma_m))
    ax.plot(t, track.distance_m, color="black", linewidth=1.0, label="true D")
    ax.plot(t, believed, color=_WAY, linewidth=1.0, label="believed, +- 2 sigma")
    ax.fill_between(t, believed - 2 * sigma, believed + 2 * sigma, color=_WAY, alpha=0.25, linewidth=0)
    ax.set_ylim(0.0, 1.3 * max(track.distance_m))
    ax.set_ylabel("D, m")
    ax.legend(frameon=False, fontsize=7, loc="lower left")


# -- film ------------------------------------------------------------------------------------------------------------


def show_episode(
    setup: Setup, out: Path, policy: str | Policy, *stream: str | int, told: Callable[[], None] = lambda: None
) -> str:
    """Write an episode as an MP4: what the camera sees, the room from above, the belief; return its outcome.

    The camera sees whole frames or windows of baked rooms; of the exact model only the spots are drawn. `told` is
    called after each picture.

    Raises
    ------
    DatasetError
        If the name does not end in .mp4, or PyAV is not installed.
    """
    last = "nothing"

    def pictures() -> Iterator[NDArray[np.uint8]]:
        nonlocal last
        for simulator, chosen, observation, track in episode_steps(setup, policy, *stream):
            last = simulator.outcome
            yield picture(simulator, chosen, observation, track)
            told()

    write_mp4(out, pictures(), 1.0 / setup.task.step_s)
    return last


def picture(simulator: Simulator, policy: Any, observation: Observation, track: Track) -> NDArray[np.uint8]:
    """One picture of an episode, shape (720, 1280, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.8, 7.2), dpi=100)  # fixed margins: a layout engine takes half of a picture's time
    margins = {"left": 0.01, "right": 0.985, "bottom": 0.075, "top": 0.94, "wspace": 0.11, "hspace": 0.2}
    grid = figure.add_gridspec(2, 2, width_ratios=(1.6, 1), height_ratios=(1.2, 1), **margins)
    frame_axes(figure.add_subplot(grid[:, 0]), simulator, policy, observation)
    top_view(figure.add_subplot(grid[0, 1]), simulator, track)
    belief = figure.add_subplot(grid[1, 1])
    belief_axes(belief, track)
    belief.set_xlabel("time, s")
    laser = "on" if observation.lit else "off"
    figure.suptitle(
        f"{track.time_s[-1]:5.1f} s   stroke {simulator.stroke_m:.3f} m   laser {laser}   {simulator.outcome}",
        fontsize=11, color="#117733" if simulator.outcome == REACHED else "black",
    )  # fmt: skip
    agg = FigureCanvasAgg(figure)
    agg.draw()  # type: ignore[no-untyped-call]
    return np.asarray(agg.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def frame_axes(ax: Axes, simulator: Simulator, policy: Any, observation: Observation) -> None:
    """Frame, or the spots alone; rings around spots that were read, a cross where the target is expected."""
    from matplotlib.patches import Circle

    camera = simulator.setup.rig.camera
    if observation.windows:
        ax.imshow(
            pasted_pixels(observation.windows, (camera.height_px, camera.width_px)), cmap="gray", vmin=0.0, vmax=1.0
        )
    if simulator.setup.fidelity != "frames":
        ax.fill(*simulator.setup.rig.outline_px(180).T, fill=False, edgecolor="grey", linewidth=0.8)
    for spot in observation.spots:
        ax.add_patch(Circle((spot.u_px, spot.v_px), 9.0, fill=False, edgecolor="#ddaa33", linewidth=1.2))
    belief = getattr(policy, "belief", None)
    at = None if belief is None else belief.pixel(observation.stroke_m)
    if at is not None:
        ax.plot(*at, "+", color="#33bbee", markersize=14, markeredgewidth=1.5)
    ax.set_xlim(-0.5, camera.width_px - 0.5)
    ax.set_ylim(camera.height_px - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_xlabel("rings: spots that were read; cross: where the target is expected", fontsize=8)


def pasted_pixels(windows: Sequence[Window], size: tuple[int, int]) -> Array:
    """Raw pixels as a grey picture of the whole image, 0 to 1; black where there are none."""
    picture = np.zeros(size)
    for window in windows:
        values = window.pixels.astype(float)
        values = np.maximum(values - np.quantile(values, 0.001), 0.0)  # black, without the darkest pixels of the noise
        height, width = values.shape
        place = slice(window.v0_px, window.v0_px + height), slice(window.u0_px, window.u0_px + width)
        # lamps and spots may be white: the room is shown by what most of its pixels have
        picture[place] = np.clip(values / max(float(np.quantile(values, 0.985)), 1.0), 0.0, 1.0) ** (1 / 2.2)
    return picture
