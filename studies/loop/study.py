"""Study `loop`: a robot that drives up to its target: time, strokes, success, and what spoils them.

A condition changes one thing of a base: the paper's process, plain rooms, three other lights, raw pixels, 1 mW. All
conditions have the same episodes by name: rooms, targets and lights are the same, and so are the deviates of the noise
as long as nothing else differs. Differences from the base are therefore taken episode by episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
import scipy
from pydantic import Field

from phibench.datasets.common.progress import Steps
from phibench.datasets.film.moving_camera import INFO, bake_rooms
from phibench.estimator.geometry.rig_parameters import PRIOR_SIGMA, STROKE_PARAMETERS
from phibench.robot.loop.arena import baked_arenas
from phibench.robot.loop.episodes import Episode, run_episodes
from phibench.robot.loop.simulator import Setup, Task
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.vehicle import PARAMETERS, Vehicle
from phibench.scenes.random_streams import generator
from phibench.studies.findings import Finding, Row, number
from phibench.studies.framework import Settings, Study, StudyDatasets, StudyResult
from phibench.studies.loop.drawings import condition_drawing, process_drawing

BASE, STREAM = "base", "study loop"
_FINDINGS = ("reached", "time", "way", "strokes", "pull of 1 / D", "error of D")
_NO_EFFECT = ("rim_radius_m", "vertex_radius_m", "conic", "mirror_tilt_x_rad", "mirror_tilt_y_rad")  # of a sphere
_FEWEST = 3  # episodes of an interval

PolicyName = Literal["paper", "greedy", "drive-only", "random", "oracle"]
_Numbers = Annotated[tuple[float, ...], Field(strict=False)]


class LoopSettings(Settings):
    """Settings of the study."""

    episodes: int = Field(ge=2, le=2000, description="of each condition")
    policies: Annotated[tuple[PolicyName, ...], Field(strict=False)] = Field(description="compared at the base")
    powers: _Numbers = Field(description="of the laser, relative to 1 mW")
    lights: Annotated[tuple[int, ...], Field(strict=False)] = Field(description="beside the target")
    misalignments: _Numbers = Field(description="sizes, 1 is a rig as built by hand")
    rigs: int = Field(ge=1, le=100, description="drawn for each size")
    slip_sigmas: _Numbers = Field(description="standard deviation of the slip from run to run")
    track_noises: _Numbers = Field(description="random part of a track's way, per root of a metre")
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
        rigs = tuple(Setup(misalignment=misaligned(size, k)) for k in range(settings.rigs))
        yield Condition("misalignment", f"{size:g} of as built", rigs, n)
    for size in settings.misalignments:
        told = replace(base, rig_covariance=covariance(size))
        rigs = tuple(replace(told, misalignment=misaligned(size, k)) for k in range(settings.rigs))
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


def misaligned(size: float, number: int) -> Misalignment:
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

    reached: tuple[float, float, float]
    time_s: tuple[float, float, float]
    driven_m: tuple[float, float, float]
    strokes: tuple[float, float, float]
    pull: tuple[float, float, float]
    error: tuple[float, float, float]


def summary(episodes: Sequence[Episode]) -> ConditionSummary:
    """Summary of episodes: all of those that were reached but for the share and the pull.

    The share has the exact interval of Clopper and Pearson, as every rate of this package.
    """
    reached = [episode for episode in episodes if episode.reached]
    low, high = scipy.stats.binomtest(len(reached), len(episodes)).proportion_ci(method="exact")
    pulls = np.array([episode.pull for episode in episodes if math.isfinite(episode.pull)])
    errors = np.array(
        [episode.stated_m / episode.distance_m - 1.0 for episode in episodes if math.isfinite(episode.stated_m)]
    )
    return ConditionSummary(
        (len(reached) / len(episodes), float(low), float(high)),
        interval([episode.time_s for episode in reached]),
        interval([episode.driven_m for episode in reached]),
        interval([episode.strokes for episode in reached]),
        interval(pulls, rms),
        interval(errors, rms),
    )


def rms(values: Array, axis: int = -1) -> Array:
    """Root mean square."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=axis)))


def interval(values: Sequence[float] | Array, statistic: Callable[..., Any] = np.mean) -> tuple[float, float, float]:
    """Value of a statistic with its percentile bootstrap interval of 95 %."""
    x = np.asarray(values, float)
    if len(x) < _FEWEST:
        return (float(statistic(x)) if len(x) else math.nan, math.nan, math.nan)
    value = float(statistic(x))
    if np.ptp(x) == 0.0:  # equal values: nothing to draw anew
        return value, value, value
    ends = scipy.stats.bootstrap(
        (x,), statistic, n_resamples=2000, method="percentile", rng=generator(STREAM, "bootstrap")
    ).confidence_interval
    return value, float(ends.low), float(ends.high)


def delay(episodes: Sequence[Episode], base: Sequence[Episode]) -> tuple[float, float, float]:
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
    runs: Runs = {}
    with Steps(datasets.console, "loop", len(todo)) as steps:
        for condition in todo:
            runs[condition] = condition.run()
            steps.advance()
    base = next(rows for condition, rows in runs.items() if condition.policy == "paper" and condition.group == "policy")
    main = {condition: summary(rows) for condition, rows in runs.items() if condition.group != "vehicle"}
    shown = {"Conditions: value and interval of 95 %": condition_table(main)}
    if settings.sensitivity_episodes:
        shown["Vehicle: ends of every range"] = vehicle_table(runs, base)
    drawings = (condition_drawing({(c.group, c.name): s for c, s in main.items()}), process_drawing())
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
        share = Finding.ranged(f"reached, {where}", found.reached, "%", 100.0)
        yield share.judged(">=", 95.0) if where == "policy paper" else share  # the others are compared, not required
        yield Finding.ranged(f"time, {where}", found.time_s, "s")
        yield Finding.ranged(f"way, {where}", found.driven_m, "m")
        yield Finding.ranged(f"strokes, {where}", found.strokes, "1")
        yield Finding.ranged(f"pull, {where}", found.pull, "1")
        yield Finding.ranged(f"rms error of D, {where}", found.error, "%", 100.0)
    for condition, episodes in runs.items():
        if condition.group == "vehicle":
            yield Finding.ranged(f"later by, {condition.name}", delay(episodes, base), "s")
            yield Finding(
                f"reached, {condition.name}",
                100.0 * sum(episode.reached for episode in episodes) / len(episodes),
                unit="%",
            )


def condition_table(main: dict[Condition, ConditionSummary]) -> tuple[Row, ...]:
    """A row per condition."""
    head = ("condition", "reached, %", "time, s", "way, m", "strokes", "pull", "rms error of D, %")
    rows = [
        (
            f"{condition.group}: {condition.name}",
            _cell(found.reached, 100.0),
            _cell(found.time_s),
            _cell(found.driven_m),
            _cell(found.strokes),
            _cell(found.pull),
            _cell(found.error, 100.0),
        )
        for condition, found in main.items()
    ]
    return (head, *rows)


def vehicle_table(runs: Runs, base: Sequence[Episode]) -> tuple[Row, ...]:
    """A row per end of a range."""
    rows = [
        (
            c.name,
            PARAMETERS[c.name.split(" ")[0]].unit,
            f"{sum(episode.reached for episode in found)} of {len(found)}",
            _cell(delay(found, base)),
        )
        for c, found in runs.items()
        if c.group == "vehicle"
    ]
    return (("parameter", "unit", "reached", "later by, s"), *rows)


def _cell(ends: tuple[float, float, float], scale: float = 1.0) -> str:
    value, low, high = (number(scale * x) for x in ends)
    return value if low == "-" else f"{value} ({low} to {high})"


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
