"""Study `baseline`: the paper's tables and figures from rendered frames."""

from __future__ import annotations

from typing import Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.estimator.centroid import find_spot
from phibench.estimator.studies.baseline_drawing import curves_drawing, laws_drawing
from phibench.estimator.studies.baseline_findings import findings, laws_shown, notes, senses_shown
from phibench.estimator.studies.baseline_laws import LawFit, laws_of_noise, published_curve
from phibench.estimator.studies.baseline_table import band_table, experiment_table, experiments_of
from phibench.estimator.studies.drawn_rigs import SENSES, estimates, seen
from phibench.estimator.studies.drawn_spots import found_spots
from phibench.estimator.studies.material import Material
from phibench.estimator.studies.result import Result
from phibench.estimator.studies.study import Settings, Study
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import POSITIONS
from phibench.scenes.streams import generator

METHODS = ("red_centroid", "chain_fit")
TABLES = ("table1", "table2", "table3")
_LEAST = 3


class BaselineSettings(Settings):
    """Settings of the study `baseline`."""

    recipe: str = Field(description="data set of the paper's experiments, aligned")
    preset: Literal["srgb8", "mjpeg"] = Field(description="sensor preset; exposure as the camera chooses it")
    draws: int = Field(ge=2, le=1000, description="draws of the noise that red_centroid reads")
    fit_draws: int = Field(ge=1, le=1000, description="of these, those that chain_fit reads")
    rigs: int = Field(ge=10, le=100_000, description="drawn misalignments, closed form")
    resamples: int = Field(ge=100, le=100_000, description="of the bootstrap")
    rendered: list[str] = Field(description="recipes of misaligned rigs that are rendered too")


def run(settings: BaselineSettings, material: Material) -> Result:
    """Run the study."""
    dataset = material.dataset(settings.recipe)
    experiments, rig = experiments_of(dataset), dataset.samples[0].nominal_rig
    draws = dict(zip(METHODS, (settings.draws, settings.fit_draws), strict=True))
    table = experiment_table(experiments, rig, found_spots(dataset, settings.preset, draws, material.workers))
    bands = band_table(experiments, rig, settings.rigs, generator("study", "baseline", "rigs"))
    laws = laws_of_noise(table, METHODS[0], settings.resamples)
    curves = [
        published_curve(name, *_published(table, name), settings.resamples) for name in TABLES if _long(table, name)
    ]
    rendered = pl.concat([_rendered(name, material) for name in settings.rendered] or [_NONE])
    words = findings(table, bands, laws, curves, rendered)
    return Result(
        {"table": table, "misaligned": bands, "laws": _law_table(laws), "rendered": rendered},
        words,
        (
            curves_drawing(table, bands, METHODS[1], words[0] + " " + words[1]),
            laws_drawing(table, laws, words[3]),
        ),
        {"Errors over the published experiments": senses_shown(table, bands), "Exponents": laws_shown(laws)},
        notes(settings.rendered, settings.fit_draws, table),
    )


_NONE = pl.DataFrame(
    schema={
        "recipe": pl.String,
        "sample_id": pl.String,
        "sense": pl.String,
        "rendered_error_m": pl.Float64,
        "closed_form_error_m": pl.Float64,
    }
)


def _rendered(recipe: str, material: Material) -> pl.DataFrame:
    """Errors of a rendered misaligned rig from its noise-free frames, and by the closed form of `drawn_rigs`."""
    dataset = material.dataset(recipe)
    samples = [sample for sample in dataset if sample.row.down.visible and sample.row.up.visible]
    rows = [sample.row for sample in samples]
    rig = dataset.samples[0].nominal_rig
    wrong = Misalignment(**dataset.info.recipe["misalignment"])
    points, strokes = np.array([row.spot_world_m for row in rows]), np.array([row.nominal_stroke_m for row in rows])
    down, up, true = seen(rig, wrong, points, strokes)
    found = [
        np.array([find_spot(sample.frame(p, laser=True), sample.frame(p, laser=False)).uv_px for sample in samples])
        for p in POSITIONS
    ]
    return pl.DataFrame(
        [
            {
                "recipe": recipe,
                "sample_id": row.sample_id,
                "sense": sense,
                "rendered_error_m": float(estimates(sense, rig, strokes, *found)[i] - row.depth_m),
                "closed_form_error_m": float(estimates(sense, rig, strokes, down, up)[i] - true[i]),
            }
            for sense in SENSES
            for i, row in enumerate(rows)
        ]
    )


def _long(table: pl.DataFrame, experiment: str) -> bool:
    """Whether enough strokes of a table are there for two constants and a residual."""
    return len(_published(table, experiment)[0]) >= _LEAST


def _published(table: pl.DataFrame, experiment: str) -> tuple[Array, Array]:
    rows = table.filter(pl.col("experiment") == experiment).unique("sample_id").sort("stroke_m")
    return rows["stroke_m"].to_numpy(), (rows["published_m"] - rows["depth_m"]).to_numpy()


def _law_table(laws: list[LawFit]) -> pl.DataFrame:
    return pl.DataFrame(
        [
            {
                "quantity": law.name,
                "of": name,
                "exponent": float(law.law.exponents[i]),
                "low": float(law.law.low[i]),
                "high": float(law.law.high[i]),
                "cases": law.cases,
            }
            for law in laws
            for i, name in enumerate(("D", "h"))
        ]
    )


STUDY = Study(
    "baseline",
    "The paper's tables and figures",
    "What do the paper's 25 experiments give when they are rendered, in each sense of phi and on misaligned rigs, and "
    "do the errors follow eq. (7)?",
    BaselineSettings,
    run,
)
