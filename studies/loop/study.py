"""Study `loop`: a robot that drives up to its target: time, strokes, success, what spoils them; statistics, a drawing.

A condition changes one thing of a base: the paper's process, plain rooms, three other lights, raw pixels, 1 mW. All
conditions have the same episodes by name: rooms, targets and lights are the same, and so are the deviates of the noise
as long as nothing else differs. Differences from the base are therefore taken episode by episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.intervals import clopper_pearson, percentile_interval
from phibench.datasets.film.moving_camera import INFO, bake_rooms
from phibench.estimator.geometry.rig_parameters import PRIOR_SIGMA, STROKE_PARAMETERS
from phibench.robot.loop.arena import baked_arenas
from phibench.robot.loop.episodes import Episode, run_episodes
from phibench.robot.loop.policies import POLICIES
from phibench.robot.loop.simulator import Setup, Task
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.vehicle import PARAMETERS, Vehicle
from phibench.scenes.random_streams import generator
from phibench.studies.framework import (
    COLOURS,
    Drawing,
    Ends,
    Finding,
    Numbers,
    Row,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    number,
    rms,
    text_table,
)
from phibench.studies.loop.drawings import process_drawing

BASE, STREAM = "base", "study loop"
_NO_EFFECT = ("rim_radius_m", "vertex_radius_m", "conic", "mirror_tilt_x_rad", "mirror_tilt_y_rad")  # of a sphere
_FEWEST = 3  # episodes of an interval

if TYPE_CHECKING:
    PolicyName = str
else:
    PolicyName = Literal[tuple(POLICIES)]


class LoopSettings(Settings):
    """Settings of the study."""

    episodes: int = Field(ge=2, le=2000, description="of each condition")
    policies: tuple[PolicyName, ...] = Field(description="compared at the base")
    powers: Numbers = Field(description="of the laser, relative to 1 mW")
    lights: tuple[int, ...] = Field(description="beside the target")
    misalignments: Numbers = Field(description="sizes, 1 is a rig as built by hand")
    rigs: int = Field(ge=1, le=100, description="drawn for each size")
    slip_sigmas: Numbers = Field(description="standard deviation of the slip from run to run")
    track_noises: Numbers = Field(description="random part of a track's way, per root of a metre")
    sensitivity_episodes: int = Field(ge=0, le=500, description="of each end of each vehicle parameter's range")
    window_episodes: int = Field(ge=0, le=500, description="with windows around the spots")
    frame_episodes: int = Field(ge=0, le=100, description="with whole frames")
    rooms: int = Field(ge=1, le=100, description="baked, for windows and frames")


@dataclass(frozen=True, eq=False)
class Condition:
    """Some episodes of one policy.

    Attributes
    ----------
    group, name : str
        Quantity that is changed, and its value in words.
    setups : tuple of Setup
        Episodes are shared out among them in turn.
    """

    group: str
    name: str
    setups: tuple[Setup, ...]
    count: int
    policy: str = "paper"

    def run(self) -> list[Episode]:
        """All episodes, numbered alike in every condition."""
        rows = []
        for k, setup in enumerate(self.setups):
            for n in range(k, self.count, len(self.setups)):
                rows += [replace(one, number=n) for one in run_episodes(setup, self.policy, 1, STREAM, n)]
        return sorted(rows, key=lambda one: one.number)


def conditions(settings: LoopSettings) -> Iterator[Condition]:
    """All conditions but those with pixels."""
    n, base = settings.episodes, Setup()
    for policy in settings.policies:
        yield Condition("policy", policy, (base,), n, policy)
    for power in settings.powers:
        yield Condition("laser", f"{power:g} mW", (_with_task(power=power),), n)
    for lights in settings.lights:
        yield Condition("other lights", f"{lights}", (_with_task(lights=lights),), n)
    for size in settings.misalignments:
        rigs = tuple(Setup(misalignment=rig_deviation(size, k)) for k in range(settings.rigs))
        yield Condition("misalignment", f"{size:g} of as built", rigs, n)
    for size in settings.misalignments:
        told = replace(base, rig_covariance=covariance(size))
        rigs = tuple(replace(told, misalignment=rig_deviation(size, k)) for k in range(settings.rigs))
        for policy in ("paper", "greedy") if size == max(settings.misalignments) else ("paper",):
            yield Condition("covariance told", f"{size:g} of as built, {policy}", rigs, n, policy)
    for sigma in settings.slip_sigmas:
        yield Condition("slip from run to run", f"{sigma:g}", (_with_vehicle(slip_sigma=sigma),), n)
    for noise in settings.track_noises:
        yield Condition("track noise", f"{noise:g} m^0.5", (_with_vehicle(track_noise=noise),), n)
    if settings.sensitivity_episodes:
        for name, entry in PARAMETERS.items():
            for value in (entry.low, entry.high):
                setup = (_with_vehicle(**{name: value}),)
                yield Condition("vehicle", f"{name} = {value:g}", setup, settings.sensitivity_episodes)


def pixel_conditions(settings: LoopSettings, datasets: StudyDatasets) -> list[Condition]:
    """Conditions of the three fidelities in baked rooms; rooms that are there are not baked again."""
    wanted = {"windows": settings.window_episodes, "frames": settings.frame_episodes}
    if not any(wanted.values()):
        return []
    folder = datasets.folder / f"loop-rooms-{settings.rooms}"
    if not (folder / INFO).is_file():
        bake_rooms(folder, settings.rooms, STREAM, workers=datasets.workers, console=datasets.console)
    setup = Setup(arenas=baked_arenas(folder))
    conditions = [Condition("fidelity", "exact", (setup,), max(wanted.values()))]
    for fidelity, count in wanted.items():
        if count:
            conditions.append(Condition("fidelity", fidelity, (replace(setup, fidelity=fidelity),), count))  # type: ignore[arg-type]
    return conditions


def _with_task(**numbers: Any) -> Setup:
    return Setup(task=Task(**numbers))


def _with_vehicle(**numbers: Any) -> Setup:
    return Setup(vehicle=Vehicle(**numbers))


def rig_deviation(size: float, number: int) -> Misalignment:
    """Deviations of a rig, `size` times those of a rig that was built by hand; the carriage is exact."""
    rng = generator(STREAM, "rig", number)
    sigmas = {name: sigma for name, sigma in PRIOR_SIGMA.items() if name not in (*STROKE_PARAMETERS, *_NO_EFFECT)}
    return Misalignment(**{name: size * sigma * float(rng.standard_normal()) for name, sigma in sigmas.items()})


def covariance(size: float) -> Array:
    """Covariance of such deviations, shape (p, p), in the order of `rig_parameters.PARAMETERS`."""
    exact = (*STROKE_PARAMETERS, *_NO_EFFECT)
    return np.diag([0.0 if name in exact else (size * sigma) ** 2 for name, sigma in PRIOR_SIGMA.items()])


# -- statistics ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConditionSummary:
    """Numbers of one condition: (value, low, high) each, 95 %; NaN where there are too few episodes."""

    reached: Ends
    time_s: Ends
    driven_m: Ends
    strokes: Ends
    pull: Ends
    error: Ends


@dataclass(frozen=True)
class Quantity:
    """Name of a number in a finding, its column's head, unit, and factor to it."""

    name: str
    head: str
    unit: str
    scale: float = 1.0


QUANTITIES = {
    "reached": Quantity("reached", "reached, %", "%", 100.0),
    "time_s": Quantity("time", "time, s", "s"),
    "driven_m": Quantity("way", "way, m", "m"),
    "strokes": Quantity("strokes", "strokes", "1"),
    "pull": Quantity("pull", "pull", "1"),
    "error": Quantity("rms error of D", "rms error of D, %", "%", 100.0),
}
"""By field of a summary."""


def summary(episodes: Sequence[Episode]) -> ConditionSummary:
    """Summary of episodes: all of those that were reached but for the share and the pull.

    The share has the exact interval of Clopper and Pearson, as every rate of this package.
    """
    reached = [episode for episode in episodes if episode.reached]
    share = (len(reached) / len(episodes), *clopper_pearson(len(reached), len(episodes), 0.95))
    pulls = [episode.pull for episode in episodes if math.isfinite(episode.pull)]
    stated = [episode for episode in episodes if math.isfinite(episode.stated_m)]
    errors = [episode.stated_m / episode.distance_m - 1.0 for episode in stated]
    means = {
        name: interval([getattr(episode, name) for episode in reached]) for name in ("time_s", "driven_m", "strokes")
    }
    return ConditionSummary(share, pull=interval(pulls, rms), error=interval(errors, rms), **means)


def interval(values: Sequence[float] | Array, statistic: Callable[..., Any] = np.mean) -> Ends:
    """Value of a statistic with its interval."""
    x = np.asarray(values, float)
    value = float(statistic(x)) if len(x) else math.nan
    if len(x) < _FEWEST:
        return value, math.nan, math.nan
    if np.ptp(x) == 0.0:  # equal values: nothing to draw anew
        return value, value, value
    low, high = percentile_interval([x], statistic, 2000, generator(STREAM, "bootstrap"))
    return value, float(low[0]), float(high[0])


def delay(episodes: Sequence[Episode], base: Sequence[Episode]) -> Ends:
    """Mean difference in time from the base, over episodes that both reached."""
    times = {episode.number: episode.time_s for episode in base if episode.reached}
    return interval(
        [episode.time_s - times[episode.number] for episode in episodes if episode.reached and episode.number in times]
    )


# -- result ----------------------------------------------------------------------------------------------------------

Runs = dict[Condition, list[Episode]]


def run(settings: LoopSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    todo = [*conditions(settings), *pixel_conditions(settings, datasets)]
    runs: Runs = {condition: condition.run() for condition in datasets.each(todo, "loop")}
    base = next(rows for condition, rows in runs.items() if condition.policy == "paper" and condition.group == "policy")
    main = {condition: summary(rows) for condition, rows in runs.items() if condition.group != "vehicle"}
    shown = {"Conditions: value and interval of 95 %": condition_table(main)}
    if settings.sensitivity_episodes:
        shown["Vehicle: ends of every range"] = vehicle_table(runs, base)
    drawings = (condition_drawing(main), process_drawing())
    return StudyResult({"table": frame(runs)}, tuple(_findings(runs, main, base)), drawings, shown, _notes(settings))


def frame(runs: Runs) -> pl.DataFrame:
    """A row per episode."""
    rows = [
        {"group": condition.group, "condition": condition.name, "policy": condition.policy, **vars(episode)}
        for condition, episodes in runs.items()
        for episode in episodes
    ]
    return pl.DataFrame(rows)


def _findings(runs: Runs, main: dict[Condition, ConditionSummary], base: Sequence[Episode]) -> Iterator[Finding]:
    for condition, found in main.items():
        where = f"{condition.group} {condition.name}"
        for field, of in QUANTITIES.items():
            finding = Finding.ranged(f"{of.name}, {where}", getattr(found, field), of.unit, of.scale)
            # the others are compared, not required
            yield finding.judged(">=", 95.0) if (field, where) == ("reached", "policy paper") else finding
    for condition, episodes in runs.items():
        if condition.group == "vehicle":
            yield Finding.ranged(f"later by, {condition.name}", delay(episodes, base), "s")
            share = sum(episode.reached for episode in episodes) / len(episodes)
            yield Finding(f"reached, {condition.name}", 100.0 * share, unit="%")


def condition_table(main: dict[Condition, ConditionSummary]) -> tuple[Row, ...]:
    """A row per condition."""
    head = ("condition", *(of.head for of in QUANTITIES.values()))
    rows = (
        (f"{c.group}: {c.name}", *(_cell(getattr(found, field), of.scale) for field, of in QUANTITIES.items()))
        for c, found in main.items()
    )
    return (head, *rows)


def vehicle_table(runs: Runs, base: Sequence[Episode]) -> tuple[Row, ...]:
    """A row per end of a range."""
    return text_table(
        ((c.name, episodes) for c, episodes in runs.items() if c.group == "vehicle"),
        {
            "parameter": lambda end: end[0],
            "unit": lambda end: PARAMETERS[end[0].split(" ")[0]].unit,
            "reached": lambda end: f"{sum(episode.reached for episode in end[1])} of {len(end[1])}",
            "later by, s": lambda end: _cell(delay(end[1], base)),
        },
    )


def _cell(ends: Ends, scale: float = 1.0) -> str:
    value, low, high = (number(scale * x) for x in ends)
    return value if low == "-" else f"{value} ({low} to {high})"


def condition_drawing(main: dict[Condition, ConditionSummary]) -> Drawing:
    """Share that was reached, time and pull of every condition."""
    names = [f"{condition.group}: {condition.name}" for condition in main]
    groups = list(dict.fromkeys(condition.group for condition in main))
    with canvas(11.0, 0.6 + 0.24 * len(names)) as figure:
        axes = figure.subplots(1, 3, sharey=True)
        titles = {"reached": "reached, %", "time_s": "time of those, s", "pull": "pull of 1 / D"}
        for ax, (field, title) in zip(axes, titles.items(), strict=True):
            for row, (condition, numbers) in enumerate(main.items()):
                ends = QUANTITIES[field].scale * np.array(getattr(numbers, field))
                colour = COLOURS[groups.index(condition.group) % len(COLOURS)]
                if math.isfinite(ends[0]):
                    spread = error_bars([ends]) if math.isfinite(ends[1]) else None
                    ax.errorbar([ends[0]], [row], xerr=spread, fmt="o", color=colour, markersize=4, capsize=2)
            ax.set_xlabel(title)
            ax.grid(axis="x", linewidth=0.3)
        axes[2].axvspan(0.9, 1.1, color="#dddddd", zorder=0)
        axes[2].set_xscale("log")
        axes[0].set_yticks(range(len(names)), names, fontsize=7)
        axes[0].invert_yaxis()
        alt = "Share of episodes that were reached: " + "; ".join(
            f"{name} {100 * n.reached[0]:.0f} %" for name, n in zip(names, main.values(), strict=True)
        )
        return finished_drawing("conditions", figure, alt + ".")


def _notes(settings: LoopSettings) -> tuple[str, ...]:
    notes = [
        "Times, ways and strokes are means over the episodes that were reached; intervals are percentile bootstraps.",
        "No motion blur, rolling shutter or speckle; the ground is level.",
    ]
    if not settings.frame_episodes:
        notes.append("No episodes with whole frames in this run.")
    return tuple(notes)


STUDY = Study(
    "loop",
    "A robot that drives up to its target",
    "How long does a robot take until it stands at its target and knows D, and what makes it fail?",
    LoopSettings,
    run,
)
