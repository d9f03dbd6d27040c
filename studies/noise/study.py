"""Study `noise`: error of phi and D against light, distance and stroke, and how near methods come to the bound.

One factor at a time about base cases; all methods that take the preset, on the same draws, with the bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import polars as pl
from pydantic import Field

from phibench.benchmark.scores.answer_errors import Rules
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset
from phibench.estimator.methods.registry import METHODS
from phibench.render.sensor.settings import SensorError
from phibench.scenes.validation import nearest
from phibench.studies.findings import Finding, Row
from phibench.studies.framework import Drawing, Settings, Study, StudyDatasets, StudyResult
from phibench.studies.noise.conditions import BASE, FACTORS, Cell, all_records, applied
from phibench.studies.noise.drawings import error_drawing, ranking_drawing
from phibench.studies.noise.tables import (
    REFERENCE,
    base_findings,
    base_table,
    elasticities,
    floor_findings,
    limit_findings,
    ranking_findings,
    ranking_table,
    table_of,
    with_levels,
)

FEW_PLACES = 20  # the bootstrap resamples places: its intervals of few places are too narrow
_Words = Annotated[tuple[str, ...], Field(strict=False)]
_Levels = Annotated[tuple[float, ...], Field(strict=False)]


class LevelSettings(Settings):
    """Levels by factor; a factor without levels is left out, and the base's own level is measured anyway."""

    exposure_s: _Levels = Field(default=(), description="exposure times, s")
    power_mw: _Levels = Field(default=(), description="powers of the laser, mW")
    read_noise_e: _Levels = Field(default=(), description="read noise, electrons")
    blur_sigma_px: _Levels = Field(default=(), description="optical blur besides defocus, px")
    focus_distance_m: _Levels = Field(default=(), description="distances of the plane of focus, m")
    jpeg_quality: _Levels = Field(default=(), description="libjpeg's quality")
    adc_bits: _Levels = Field(default=(), description="bits of the converter")
    speckle_contrast: _Levels = Field(default=(), description="contrast of the flux, 0.41 to 1")

    @property
    def given(self) -> dict[str, tuple[float, ...]]:
        """Levels of the factors that have some."""
        return {name: tuple(levels) for name, levels in self if levels}


class NoiseSettings(Settings):
    """Settings of the study."""

    recipe: str = Field(default="paper", description="recipe of the base cases, rendered for 1 mW")
    samples: _Words = Field(min_length=1, description="base cases; the first is the main one")
    presets: Annotated[tuple[Literal["bayer-raw", "srgb8", "mjpeg"], ...], Field(strict=False, min_length=1)] = Field(
        description="of the sensor"
    )
    methods: _Words = Field(default=(), description="built-in methods; all if empty")
    places: int = Field(ge=2, le=200, description="places of the spot on its board")
    draws: int = Field(ge=2, le=200, description="draws of the noise at each place")
    box_px: int = Field(ge=24, le=256, description="side of the boxes that methods are given")
    resamples: int = Field(ge=99, le=9999, description="of the bootstrap over places")
    levels: LevelSettings = Field(description="levels by factor; the base is added")


def run(settings: NoiseSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    dataset = datasets.dataset(settings.recipe)
    planned = cells(settings, dataset)
    records = with_levels(all_records(planned, datasets), settings.levels.given)
    rules = Rules(resamples=settings.resamples)
    table = table_of(records, rules)
    slopes = elasticities(records, rules)
    slope_rows = [
        {**{k: v for k, v in vars(e).items() if k != "estimate"}, "slope": e.estimate.value}
        | {"slope_low": e.estimate.low, "slope_high": e.estimate.high}
        for e in slopes
    ]
    shown: dict[str, tuple[Row, ...]] = {}
    findings, pictures = list[Finding](), list[Drawing]()
    for preset in settings.presets:
        for sample in settings.samples:
            findings += base_findings(table, sample, preset)
            findings += floor_findings(table, sample, preset)
            findings += limit_findings(table, sample, preset)
            findings += ranking_findings(slopes, sample, preset)
            shown[f"{preset}, {sample}: base case, 95 % intervals over places"] = base_table(table, sample, preset)
            shown[f"{preset}, {sample}: elasticities of {REFERENCE[preset]}"] = ranking_table(slopes, sample, preset)
        pictures.append(error_drawing(table, settings.samples[0], preset))
    pictures.append(ranking_drawing(slopes, settings.samples[0], settings.presets))
    tables = {"table": table, "elasticities": pl.DataFrame(slope_rows)}
    return StudyResult(tables, tuple(findings), tuple(pictures), shown, _notes(settings))


def cells(settings: NoiseSettings, dataset: Dataset) -> list[Cell]:
    """All cells, those of the costly presets first.

    Raises
    ------
    DatasetError
        If a sample is not in the data set or not visible, or a level is not allowed.
    """
    for name in settings.samples:
        row = dataset[name].row
        if not (row.down.visible and row.up.visible):
            raise DatasetError(f"{name}: its spot is not visible in both images; take another base case")
    methods = settings.methods or tuple(METHODS)
    for name in methods:
        if name not in METHODS:
            raise DatasetError(f"methods: there is no '{name}' here; {nearest(name, tuple(METHODS))}")
    plan = [(s, p, f, x) for p in reversed(settings.presets) for s in settings.samples for f, x in _levels(settings, p)]
    for sample, preset, factor, level in plan:
        try:
            applied(factor, preset, dataset[sample].rig, level)
        except SensorError as error:
            raise DatasetError(f"levels of {factor}: {level:g} is not allowed: {error}") from error
    size = (settings.places, settings.draws, methods, settings.box_px)
    return [Cell(dataset.folder, *case, *size) for case in plan]


def _levels(settings: NoiseSettings, preset: str) -> Iterator[tuple[str, float]]:
    """The base case, then every level that is not the base's."""
    yield BASE, 0.0
    for name, levels in settings.levels.given.items():
        factor = FACTORS[name]
        if preset in factor.presets:
            # the base's own level is the base case
            yield from ((name, x) for x in levels if abs(x - factor.base) > 1e-9)


def _notes(settings: NoiseSettings) -> tuple[str, ...]:
    pairs = settings.places * settings.draws
    few = settings.places < FEW_PLACES
    return (
        f"{pairs} pairs per level ({settings.places} places of the spot, {settings.draws} draws each); intervals are "
        "95 %, bootstrap over places.",
        "Methods get boxes of "
        f"{settings.box_px} px; rates of detection are those inside such a box, not in the whole mirror.",
        "Laser-off frames go only to methods that cannot do without. Bounds are those of one frame per position, with "
        "flux and one background level per filter unknown.",
        "Methods know the rig, its blur and focus and the sensor's numbers; the room behind keeps the "
        "blur and the focus at which it was rendered.",
        "The base is in focus, an optimum: focus distance has no elasticity.",
        *((f"Bootstrap intervals of fewer than {FEW_PLACES} places are too narrow.",) if few else ()),
    )


STUDY = Study(
    "noise",
    "Noise, blur and compression",
    "How do the errors of pixel, phi and depth depend on exposure, laser power, read noise, blur, focus, JPEG quality, "
    "bits and speckle, for every method, and what is the bound?",
    NoiseSettings,
    run,
)
