"""Conditions of the study `noise`: the factors that vary, each combination tried, and every method's errors in it.

A factor is a number of the sensor, of the laser, or of the lens; one is changed at a time. A cell is one base case,
preset, factor and level, in which all methods see the same draws. Its spots lie at several places of the board, some
pixels apart, so that all sub-pixel phases occur. Noise is named by place and draw, not by level: levels are compared on
common draws.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.records import record_table
from phibench.datasets.read import Dataset, open_dataset
from phibench.estimator.interface import Answer, Outcome, Pair
from phibench.estimator.methods.joint_fit import joint_of
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig
from phibench.studies.image_cutout import (
    Shot,
    SpotPair,
    bounds_of,
    cut_region,
    cut_rig,
    drawn_pair,
    truth_of,
    without_off,
)

OFF = 0.0  # level of a factor that is switched off
_QUALITY = 85  # of the base case's JPEG, which the study's figures were measured with
BASE = "base"
"""Name of the factor of a cell in which nothing is changed."""
Change = Callable[[str, Rig, float], tuple[Shot, Rig]]


@dataclass(frozen=True)
class Factor:
    """One factor.

    Parameters
    ----------
    label : with its unit, for an axis
    change : from preset, rig and level to how pairs are taken and by which rig
    base : level of the base case
    presets : those that it acts on
    ranked : whether an elasticity about the base says something; not where the base is an optimum
    """

    label: str
    change: Change
    base: float
    presets: tuple[str, ...] = ("bayer-raw", "srgb8", "mjpeg")
    ranked: bool = True


def _base(preset: str, **changes: float) -> Sensor:
    """Sensor of the base case: the preset, with the study's JPEG quality."""
    quality = {"jpeg_quality": _QUALITY} if preset == "mjpeg" else {}
    return sensor(preset, **{**quality, **changes})


def _sensor(key: str, whole: bool = False) -> Change:
    return lambda preset, rig, x: (Shot(_base(preset, **{key: round(x) if whole else x})), rig)


def _power(preset: str, rig: Rig, power_mw: float) -> tuple[Shot, Rig]:
    return Shot(_base(preset), laser_level=power_mw), rig  # layers are rendered for 1 mW


def _bits(preset: str, rig: Rig, bits: float) -> tuple[Shot, Rig]:
    """Another converter over the same range: gain and black level follow the codes."""
    plain = _base(preset)
    scale = 2.0 ** (round(bits) - plain.adc_bits)
    changes = {"gain_dn_per_e": plain.gain_dn_per_e * scale, "black_level_dn": plain.black_level_dn * scale}
    return Shot(_base(preset, adc_bits=round(bits), **changes)), rig


def _speckle(preset: str, rig: Rig, contrast: float) -> tuple[Shot, Rig]:
    # M independent speckle patterns have the contrast 1 / sqrt(M); without speckle there is no M
    return Shot(_base(preset) if contrast == OFF else _base(preset, speckle_m=contrast**-2)), rig


def _blur(preset: str, rig: Rig, sigma_px: float) -> tuple[Shot, Rig]:
    return Shot(_base(preset)), replace(rig, camera=replace(rig.camera, blur_sigma_px=sigma_px))


def _focus(preset: str, rig: Rig, distance_m: float) -> tuple[Shot, Rig]:
    return Shot(_base(preset)), replace(rig, camera=replace(rig.camera, focus_distance_m=distance_m))


FACTORS: dict[str, Factor] = {
    "exposure_s": Factor("exposure, s", _sensor("exposure_s"), 1.0 / 60.0),
    "power_mw": Factor("laser power, mW", _power, 1.0),
    "read_noise_e": Factor("read noise, e-", _sensor("read_noise_e"), 4.0),
    "blur_sigma_px": Factor("optical blur sigma, px", _blur, 0.7),
    "focus_distance_m": Factor("focus distance, m", _focus, 0.23, ranked=False),
    "jpeg_quality": Factor("JPEG quality", _sensor("jpeg_quality", True), float(_QUALITY), ("mjpeg",)),
    "adc_bits": Factor("converter, bits", _bits, 10.0),
    "speckle_contrast": Factor("speckle contrast of the flux", _speckle, OFF),
}
"""By name; the keys are those of the settings, whose levels include the base."""


def shot_and_rig(factor: str, preset: str, rig: Rig, level: float) -> tuple[Shot, Rig]:
    """Shot and rig of a cell; the factor `BASE` changes nothing.

    Raises
    ------
    SensorError
        If the level is not allowed.
    """
    if factor == BASE:
        return Shot(_base(preset)), rig
    return FACTORS[factor].change(preset, rig, level)


NAMES: tuple[Name, ...] = ("study", "noise")
_MARGIN_PX = 32  # around a spot: what the chain's stages and JPEG's units look at
_REACH_PX = 1.7  # places are drawn from a square of twice as many pixels
_RAD_PER_PX = 7.6e-3  # of elevation, on the default rig


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes
    ----------
    folder : Path of the data set
    sample : id of the base case
    methods : names
    box_px : side of the boxes
    """

    folder: Path
    sample: str
    preset: str
    factor: str
    level: float
    places: int
    draws: int
    methods: tuple[str, ...]
    box_px: int


def cell_records(cell: Cell) -> pl.DataFrame:
    """Records of all methods of a cell: `scores.record_columns.COLUMNS` with method, factor and level."""
    rig, places = _places(cell)
    shot = shot_and_rig(cell.factor, cell.preset, rig, cell.level)[0]
    truths, pairs = [], []
    for k, spot in enumerate(places):
        steady = bounds_of(shot, spot) if shot.sensor.speckle_m is None else None
        for draw in range(cell.draws):
            names = (*NAMES, cell.sample, k, draw)
            number, nominal = k * cell.draws + draw, (spot.rig, spot.stroke_m)
            bounds = steady or bounds_of(shot, spot, names)
            truths.append(truth_of(number, shot, spot, nominal, bounds, draw))
            pairs.append(drawn_pair(number, shot, spot, nominal, names, cell.box_px))
    answers = [method_answers(pair, cell.methods) for pair in pairs]
    tables = []
    for name in answers[0]:
        outcomes = [Outcome(i, *answer[name]) for i, answer in enumerate(answers)]
        table = record_table(truths, outcomes, Rules())
        tables.append(table.with_columns(method=pl.lit(name), factor=pl.lit(cell.factor), level=pl.lit(cell.level)))
    return pl.concat(tables)


def method_answers(pair: Pair, methods: Sequence[str]) -> dict[str, tuple[Answer, float]]:
    """Answers and seconds of the methods that take such a pair; laser-off frames go to those that cannot do without."""
    # each kind of pair with the work that its methods share, such as the search for spots
    with_off, alone = SharedPair.of(pair), SharedPair.of(without_off(pair))
    answers: dict[str, tuple[Answer, float]] = {}
    for name in methods:
        method = METHODS[name]
        seen = with_off if method.needs_off else alone
        if method.refusal(seen):
            continue  # it takes no such frames
        start, reused = time.perf_counter(), seen.work.reused_seconds
        separate = answers.get("raw_maximum_likelihood") or answers.get("chain_fit")
        # the joint fit begins with the separate one, which is the costly part
        answer = joint_of(seen, separate[0]) if name == "joint_fit" and separate else method(seen)
        # what was there already counts: the method takes it alone, too
        answers[name] = (answer, time.perf_counter() - start + seen.work.reused_seconds - reused)
    return answers


@lru_cache(maxsize=1)
def _opened(folder: Path) -> Dataset:
    return open_dataset(folder)


def _places(cell: Cell) -> tuple[Rig, list[SpotPair]]:
    """Rig of a cell, cut, and the spot at its places."""
    dataset = _opened(cell.folder)
    sample = dataset[cell.sample]
    size = sample.rig.camera.height_px, sample.rig.camera.width_px
    uv = [(row.u_px, row.v_px) for row in (sample.truth_row(p) for p in POSITIONS)]
    region = cut_region(uv, size, _MARGIN_PX)
    rig = shot_and_rig(cell.factor, cell.preset, cut_rig(sample.rig, region), cell.level)[1]
    ambient = {p: sample.ambient(p)[(slice(None), *region.slices())].astype(float) for p in POSITIONS}
    stroke_m, spot = sample.row.stroke_m, sample.laser_spot
    spots = [placed_spot(spot, sample.row.depth_m, (*NAMES, cell.sample, k)) for k in range(cell.places)]
    return rig, [
        SpotPair.of(rig, stroke_m, uv_px, dataset.room, ambient, f"{cell.sample}-{k}") for k, uv_px in enumerate(spots)
    ]


def placed_spot(spot: LaserSpot, depth_m: float, names: tuple[Name, ...]) -> LaserSpot:
    """The spot moved on its board by up to some pixels both ways."""
    along, across = spot.tangents()
    a, b = generator(*names, "place").uniform(-_REACH_PX, _REACH_PX, 2) * _RAD_PER_PX * depth_m
    return replace(spot, position_world_m=as_vector(np.array(spot.position_world_m) + a * along + b * across))


def rms_by_place(records: pl.DataFrame, column: str = "distance_px") -> tuple[np.ndarray, np.ndarray]:
    """Sums of squares and numbers of the detected spots of one cell and method, by place in order, shape (n,) each."""
    found = (
        records.with_columns(square=pl.when("detected").then(pl.col(column) ** 2))
        .group_by("sample_id")
        .agg(pl.col("square").sum(), count=pl.col("square").count())
        .sort("sample_id")
    )
    return found["square"].to_numpy().astype(float), found["count"].to_numpy().astype(float)


def within_place_px(records: pl.DataFrame) -> float:
    """Scatter: rms distance of the detected positions from their mean over the draws of a place and image, unbiased."""
    spread = (
        records.filter("detected")
        .group_by("sample_id", "image")
        .agg(square=pl.col("du_px").var() + pl.col("dv_px").var(), n=pl.len())
    )
    spread = spread.filter(pl.col("n") > 1)
    if spread.is_empty():
        return math.nan
    freedom = spread["n"].to_numpy() - 1.0
    return math.sqrt(float(spread["square"].to_numpy() @ freedom) / float(freedom.sum()))
