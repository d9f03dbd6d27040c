"""The paper's experiments as films, with rigs that calibrate themselves: bursts at both ends, whole strokes, summary.

For every rig of the films, a data set of the same recipe gives the calibration (`experiment_tables.calibrate_rig`).
Every film then gives D in two ways, each for several cameras, whose fixed pattern nobody knows:

1. burst: frames at rest at both ends, every other one with the laser off, by the method that is closest to the bound
   (`method_for`), as for stills of so many frames;
2. stroke: all frames of the film, by the joint bundle (`film_bundle`). Of processed images these are both bursts, and
   the frames on the way one by one (`processed_positions`).

Errors of one rig's calibration are common to all its rows. `closure_interval` draws errors that are as the budget says,
that part common, and so tells how far rms over predicted may lie from 1.

A film holds the room around its spot alone. Its images are cut-outs, seen by a camera whose principal point is moved by
as much: mosaic and JPEG blocks keep their phase, because regions begin at whole tiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.calibration.rig.bundle import Bundle
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film, Films
from phibench.datasets.film.film_store import FilmInfo
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset
from phibench.estimator.geometry.status import depth_pull
from phibench.estimator.interface import Image, Pair
from phibench.estimator.methods.registry import method_for
from phibench.robot.film.film_bundle import FilmDepth, film_depth
from phibench.robot.film.film_estimates import EqualLight, bundle_depth, equal_light, seen_film
from phibench.robot.film.film_frames import film_frames, lit_frames
from phibench.robot.film.film_positions import FilmPositions, joined_positions, processed_positions
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.paper.experiment_tables import Procedure, calibrate_rig

COLUMNS = (
    *("film", "experiment", "rig", "camera", "way", "depth_m", "error_m", "sigma_m", "frames"),
    *("film_pixels_m", "two_ends_pixels_m", "calibration_m"),
)
"""The last three: standard deviations of D from pixels and encoder alone, of these frames and, for a raw film, of as
many frames in two bursts at the ends of its stroke; errors of D by one standard deviation of each independent part of
the calibration, a list."""
_DRAWS = 4000  # of `closure_interval`: its ends are good to 1 %


@dataclass(frozen=True)
class FilmProcedure:
    """Settings.

    Parameters
    ----------
    preset : "bayer-raw" or "mjpeg"
    on, off : int
        Most frames of a burst, at each end, with the laser on and off; the film's own rest has every other one on.
    cameras : int
        Cameras with a fixed pattern of their own, 0 to `cameras` - 1, each with a draw of the noise.
    stroke : bool
        Whether the whole stroke is fitted, too.
    sensor : dict
        Numbers of the preset, such as ``jpeg_quality``.
    """

    preset: str = "bayer-raw"
    on: int = 30
    off: int = 30
    cameras: int = 1
    stroke: bool = True
    sensor: dict[str, Any] | None = None


def run_film_experiments(
    films: Films, calibration: Dataset, procedure: FilmProcedure, told: Callable[[], None] = lambda: None
) -> pl.DataFrame:
    """Errors of D of every film, camera and way: one row each, `COLUMNS`; `told` is called after every film.

    Raises
    ------
    DatasetError
        If a rig of the films has no calibration spots in `calibration`, or a film does not rest so long.
    """
    rows: list[dict[str, Any]] = []
    known: dict[str, Bundle] = {}
    for name in films.plans:
        film = films[name]
        rig = film.plan.pair.rig
        if rig not in known:
            if calibration.rigs[rig] != film.plan.scene.rig:
                raise DatasetError(
                    f"{calibration.folder}: rig {rig} is not that of film {name}; make both of one recipe"
                )
            known[rig] = calibrate_rig(calibration, rig, Procedure(procedure.preset))
        for camera in range(procedure.cameras):
            rows += _rows(film, known[rig], procedure, camera)
        told()
    return pl.DataFrame(rows, schema={name: _TYPES.get(name, pl.Float64) for name in COLUMNS})


_TYPES: dict[str, Any] = {
    **dict.fromkeys(("film", "experiment", "rig", "way"), pl.String),
    **dict.fromkeys(("camera", "frames"), pl.Int64),
    "calibration_m": pl.List(pl.Float64),
}


def _rows(film: Film, bundle: Bundle, procedure: FilmProcedure, camera: int) -> list[dict[str, Any]]:
    seen, nan = bursts(film, bundle, procedure, camera), float("nan")
    estimates: list[tuple[str, FilmDepth | None, int, EqualLight | None]] = [("burst", seen.depth, seen.frames, None)]
    if procedure.stroke and procedure.preset == "bayer-raw":
        at, light = whole_stroke(film, bundle, procedure, camera)
        estimates.append(("stroke", at, len(film), light))
    elif procedure.stroke:
        whole = processed_stroke(film, bundle, procedure, camera, seen)
        frames = seen.frames if whole is None else seen.frames + whole.frames - 2
        estimates.append(("stroke", whole, frames, None))
    pair, depth_m, parts = film.plan.pair, film.light_depth_m, _independent(bundle.covariance)
    rows = []
    for way, depth, frames, at_light in estimates:
        estimate, sigma = (nan, nan) if depth is None else (depth.depth_m, depth.sigma_m)
        two_ends_m = at_light.two_ends_m if at_light else nan
        calibration = np.full(len(parts), nan) if depth is None else depth.by_rig_m @ parts
        pixels_m = np.sqrt(max(sigma**2 - float(calibration @ calibration), 0.0)) if depth else nan
        rows.append(
            {
                "film": film.info.film,
                "experiment": pair.experiment,
                "rig": pair.rig,
                "camera": camera,
                "way": way,
                "depth_m": depth_m,
                "error_m": estimate - depth_m,
                "sigma_m": sigma,
                "frames": frames,
                "film_pixels_m": at_light.film_m if at_light else float(pixels_m),
                "two_ends_pixels_m": two_ends_m,
                "calibration_m": calibration.tolist(),
            }
        )
    return rows


def _independent(covariance: Array) -> Array:
    """Matrix L of a covariance L L^T, shape (p, p), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


# Bursts.


@dataclass(frozen=True)
class Bursts:
    """Two bursts at rest.

    Attributes
    ----------
    depth : FilmDepth or None
        None where a spot was not found, or the rays do not meet.
    positions : FilmPositions
        Of both ends in the whole image, fitted; NaN where there is none.
    seen_px : array, shape (2, 2)
        The same; of a spot that was seen and gave no fit, where it was seen.
    offsets_m : array, shape (2,)
    """

    depth: FilmDepth | None
    positions: FilmPositions
    seen_px: Array
    offsets_m: Array
    frames: int


def bursts(film: Film, bundle: Bundle, procedure: FilmProcedure, camera: int) -> Bursts:
    """Positions and depth from frames at rest at both ends.

    Raises
    ------
    DatasetError
        If the film rests for fewer frames than two on and one off.
    """
    pair = burst_pair(film, bundle, procedure, camera)
    frames = sum(pair.count(name) for name in ("down", "down_off", "up", "up_off"))
    uv, C, corner = np.full((2, 2), np.nan), np.full((2, 2, 2), np.nan), (film.info.u0_px, film.info.v0_px)
    answer = method_for(pair.card)(pair)
    for k, spot in enumerate((answer.down, answer.up)):
        if spot.uv_px is not None:
            uv[k] = np.array(spot.uv_px) + corner
        if spot.covariance_px2 is not None:
            C[k] = spot.covariance_px2
    fitted = np.where(np.isfinite(C).all(axis=2), uv, np.nan)
    positions, offsets = FilmPositions(fitted, C, np.zeros((2, 2, 2, 2))), np.array([0.0, pair.stroke_m])
    depth = _depth(bundle, positions, offsets, np.zeros(2)) if positions.good.all() else None
    return Bursts(depth, positions, uv, offsets, frames)


def _depth(bundle: Bundle, positions: FilmPositions, offsets_m: Array, sigma_m: Array) -> FilmDepth | None:
    try:
        return film_depth(bundle.rig, positions, offsets_m, sigma_m, bundle.covariance)
    except DatasetError:  # rays that do not meet are no answer
        return None


def burst_pair(film: Film, bundle: Bundle, procedure: FilmProcedure, camera: int) -> Pair:
    """Pair of the film's frames at rest, cut out, with the calibrated rig.

    Raises
    ------
    DatasetError
        If the film rests for fewer frames.
    """
    images: dict[str, list[Image]] = {}
    sensor = film.sensor(procedure.preset, **(procedure.sensor or {}))
    for position, end in zip(("down", "up"), resting_frames(film), strict=True):
        if len(end) < 3:
            raise DatasetError(
                f"film {film.info.film} rests {position} for {len(end)} frames, two with the laser on and one with it "
                "off are the least; raise film.pauses_s"
            )
        on, off, blinks = lit_frames(film, np.array(end))
        images[position] = [_cut_out(film, int(k), procedure, camera, True) for k in on[: procedure.on]]
        images[f"{position}_off"] = [_cut_out(film, int(k), procedure, camera, blinks) for k in off[: procedure.off]]
    nominal = film.plan.pair.nominal_stroke_m
    return Pair.of_frames(
        0,
        images,
        rig=cut_rig(bundle.rig, film.info),
        stroke_m=float(bundle.stroke(np.array(nominal))),
        card=card_of(sensor),
        beam=Beam(),
    )


def resting_frames(film: Film) -> tuple[list[int], list[int]]:
    """Frames that are exposed while the carriage rests at its first and at its last stop."""
    scene, times = film.plan.nominal, film.plan.nominal.times
    half = 0.5 * (times.exposure_s + times.readout_s)
    inner = times.frame_s[:, None] + half * np.linspace(-1.0, 1.0, 9)  # instants of a frame, its rows included
    at = scene.carriage.position_m(inner)
    stops = (scene.carriage.stops_m[0], scene.carriage.stops_m[-1])
    first, last = (np.flatnonzero(np.all(np.abs(at - stop) < 1e-9, axis=1)).tolist() for stop in stops)  # rounding
    return first, last


def _cut_out(film: Film, frame: int, procedure: FilmProcedure, camera: int, laser: bool) -> Image:
    # each camera with a noise of its own
    sensor = procedure.sensor or {}
    return film.cut_out(frame, procedure.preset, camera, camera, laser=laser, **sensor).image


def cut_rig(rig: Rig, film: FilmInfo) -> Rig:
    """Rig whose camera has the pixels of a film's region alone, numbered from its corner."""
    camera = replace(
        rig.camera,
        width_px=film.width_px,
        height_px=film.height_px,
        cx_px=rig.camera.cx_px - film.u0_px,
        cy_px=rig.camera.cy_px - film.v0_px,
    )
    return replace(rig, camera=camera)


# The whole stroke.


def whole_stroke(film: Film, bundle: Bundle, procedure: FilmProcedure, camera: int) -> tuple[FilmDepth, EqualLight]:
    """Depth from all frames of a film, and what two bursts of as many frames would give."""
    nominal = film.plan.pair.nominal_stroke_m
    scale = float(bundle.stroke(np.array(nominal))) / nominal
    seen = seen_film(film_frames(film, camera, camera, procedure.preset, rig=bundle.rig, stroke_scale=scale))
    depth = bundle_depth(seen, bundle.covariance)
    return depth, equal_light(seen, depth.point_world_m)


def processed_stroke(
    film: Film, bundle: Bundle, procedure: FilmProcedure, camera: int, ends: Bursts
) -> FilmDepth | None:
    """Depth from two bursts of processed frames and from single ones on the way; None where a spot was not seen.

    Frames of a burst that gives no fit are taken one by one, too.
    """
    rough = FilmPositions(ends.seen_px, np.tile(np.eye(2), (2, 1, 1)), np.zeros((2, 2, 2, 2)))
    start = _depth(bundle, rough, ends.offsets_m, np.zeros(2)) if rough.good.all() else None
    if start is None:
        return None  # one end shows no spot
    scale = ends.offsets_m[1] / film.plan.pair.nominal_stroke_m
    sensor = procedure.sensor or {}
    frames = film_frames(film, camera, camera, procedure.preset, rig=bundle.rig, stroke_scale=scale, **sensor)
    fitted = [at for at, good in zip(resting_frames(film), ends.positions.good, strict=True) if good]
    moving = np.flatnonzero(~np.isin(frames.on, np.concatenate([*fitted, []])))
    way, offsets = processed_positions(frames, (ends.depth or start).point_world_m, moving)
    # bursts stand where the carriage was told to, and readings on the way have the encoder's noise
    sigma_m = np.concatenate([np.zeros(2), np.full(len(moving), frames.encoder_sigma_m)])
    return _depth(bundle, joined_positions(ends.positions, way), np.concatenate([ends.offsets_m, offsets]), sigma_m)


# What came out.


def _answered(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows with a depth and its sigma, and their pulls."""
    good = rows.filter(pl.col("error_m").is_finite() & pl.col("sigma_m").is_finite())
    true, error, sigma = (good[name].to_numpy() for name in ("depth_m", "error_m", "sigma_m"))
    return good.with_columns(pl.Series("pull", depth_pull(true + error, sigma, true)))


def summary(rows: pl.DataFrame) -> pl.DataFrame:
    """Per way: films, rms of the relative error, its prediction, pull, share within 95 %, gain of the film.

    Pulls are those of `depth_pull`.
    """
    relative, claim = pl.col("error_m") / pl.col("depth_m"), pl.col("sigma_m") / pl.col("depth_m")
    good = _answered(rows)
    return good.group_by("way", maintain_order=True).agg(
        pl.len().alias("films"),
        (relative**2).mean().sqrt().alias("rms"),
        (claim**2).mean().sqrt().alias("predicted"),
        (pl.col("pull").abs() <= NORMAL_95).mean().alias("within_95"),
        (pl.col("pull") ** 2).mean().sqrt(),
        ((pl.col("film_pixels_m") / pl.col("depth_m")) ** 2).mean().sqrt().alias("pixels"),
        # median over films: one of a short stroke has as much say as one of a long one
        ((pl.col("two_ends_pixels_m") / pl.col("film_pixels_m")) ** 2).median().alias("gain"),
    )


def closure_interval(rows: pl.DataFrame, common_end: bool = False) -> tuple[float, float]:
    """95 % interval of rms over predicted, of relative errors of D, if the budget of these rows is right.

    Errors of a rig's calibration are common to its rows. Those from pixels and encoder are independent; or, with
    `common_end`, half of their variance, that of the lower end, is common to all films of one target and camera, as
    far as it comes from the pattern or from what rounding hides of a room. The truth lies between.
    """
    good = _answered(rows)
    D, sigma = good["depth_m"].to_numpy(), good["sigma_m"].to_numpy()
    common = np.array(good["calibration_m"].to_list()).reshape(len(D), -1)
    own = np.sqrt(np.maximum(sigma**2 - np.sum(common**2, axis=1), 0.0)) / D
    rng = generator("film experiments", "closure")
    errors = own * rng.standard_normal((_DRAWS, len(D)))
    if common_end:
        target = good.select(pl.struct("rig", "experiment", "depth_m", "camera").rank("dense"))[:, 0].to_numpy() - 1
        errors = (errors + own * rng.standard_normal((_DRAWS, target.max() + 1))[:, target]) * np.sqrt(0.5)
    for rig in good["rig"].unique(maintain_order=True):
        mine = (good["rig"] == rig).to_numpy()
        errors[:, mine] += rng.standard_normal((_DRAWS, common.shape[1])) @ (common[mine] / D[mine, None]).T
    ratio = np.sqrt(np.mean(errors**2, axis=1) / np.mean((sigma / D) ** 2))
    low, high = np.quantile(ratio, [0.025, 0.975])  # an interval of 95 %
    return float(low), float(high)
