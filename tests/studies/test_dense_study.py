"""Study dense: geometry of perfect matches and bounds of cells against other computations; a run of all its parts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.dense_truths import smaller, truth_of

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.dense.dense_bound import dense_bound
from phibench.render.optics.correspondence import correspondence
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import lab
from phibench.studies.dense import study
from phibench.studies.dense.perfect_matches import (
    CENTRAL,
    IN_FOCUS,
    NEAR,
    SIGMA,
    SPHERE,
    TWICE,
    PerfectMatchTask,
    bands,
    coarser_rig,
    nominal_rig_error,
    rig_numbers,
    rigs,
)
from phibench.studies.dense.rendered_pairs import (
    ANSWERS,
    CELL_PX,
    BoundAtStroke,
    FreeFloor,
    MethodOutcome,
    NearLimits,
    RenderedRoom,
    bound_at,
    cell_bound,
    outcome,
)
from phibench.studies.dense.study import STUDY
from phibench.studies.dense.tables import parts_of
from phibench.studies.framework import read_settings

ASKED = PerfectMatchTask((0.425,), 4.0, (1.0, 2.0, 4.0), 0.2, 3.0, 0.05)
ROOM = lab(())


@pytest.fixture(scope="module")
def exact() -> dict[str, Rig]:
    return rigs()


def test_the_central_model_costs_what_the_score_says(exact: dict[str, Rig]) -> None:
    """In the lab the score's own oracles give 0.470 % (`test_what_the_central_model_costs`), printed to 3 digits."""
    found = rig_numbers(ASKED, coarser_rig(exact[SPHERE], 4.0), ROOM, 0.425)
    assert found[CENTRAL] == pytest.approx(0.470, rel=5e-3)
    assert found[TWICE] > 95.0


def test_a_mirror_with_one_viewpoint_costs_nothing_and_scales_with_the_stroke(exact: dict[str, Rig]) -> None:
    """Where rays meet in the focus, D is proportional to h: a stroke that is 1 % longer than told makes D 1 / 1.01."""
    found = rig_numbers(ASKED, coarser_rig(exact[IN_FOCUS], 4.0), ROOM, 0.425)
    assert found[CENTRAL] < 1e-9
    assert found[NEAR] > 0.0
    error = nominal_rig_error(ASKED, exact[IN_FOCUS], Misalignment(stroke_relative=0.01), ROOM, 0.425)
    assert error == pytest.approx(100.0 * (1.0 - 1.0 / 1.01), rel=1e-6)
    assert nominal_rig_error(ASKED, exact[SPHERE], Misalignment(), ROOM, 0.425) < 1e-7


def test_sigma_grows_with_the_error_of_a_match_and_not_with_the_pixels(exact: dict[str, Rig]) -> None:
    """Sigma is that of the full camera whatever the divisor: grids of other pixels agree to some per cent."""
    one, coarse = (
        rig_numbers(replace(ASKED, divisor=d), coarser_rig(exact[SPHERE], d), ROOM, 0.425) for d in (4.0, 8.0)
    )
    twice = rig_numbers(replace(ASKED, matching_px=0.4), coarser_rig(exact[SPHERE], 4.0), ROOM, 0.425)
    assert twice[SIGMA] == pytest.approx(2.0 * one[SIGMA], rel=1e-9)
    assert coarse[SIGMA] == pytest.approx(one[SIGMA], rel=0.03)


def test_bands_have_no_gap() -> None:
    ends = list(bands((1.0, 2.0)).values())
    assert ends == [(0.0, 1.0), (1.0, 2.0), (2.0, np.inf)]


def test_cells_have_the_bound_of_their_middle_pixels() -> None:
    """A pixel of the coarse rig looks where the middle of its cell does; its bound is that of every pixel's motion.

    The motion of the middle stands for the cell's: it changes by some per cent from pixel to pixel here, where the
    camera has a quarter of its pixels, and by jumps at edges of D.
    """
    rig = smaller(Rig(), 4.0)
    fine, coarse = (correspondence(ROOM, r.at(0.0), r.at(0.425)) for r in (rig, coarser_rig(rig, CELL_PX)))
    middle = slice(CELL_PX // 2, None, CELL_PX)
    height, width = (min(a, b) for a, b in zip(fine.seen[middle, middle].shape, coarse.seen.shape, strict=True))
    here, there = fine.uv_px[middle, middle][:height, :width], coarse.uv_px[:height, :width]
    both = np.isfinite(here[..., 0]) & np.isfinite(there[..., 0])
    assert both.sum() > 1000
    assert np.abs(here[both] - (CELL_PX * there[both] + CELL_PX // 2)).max() < 1e-6
    planes = 2000.0 + 500.0 * generator("cells").standard_normal((3, *fine.seen.shape))
    card = sensor_card("bayer-raw")
    depth = np.where(fine.seen, fine.depth_m, np.nan)
    whole = dense_bound(rig, 0.425, card, planes, depth)[middle, middle][:height, :width]
    cells = cell_bound(rig, 0.425, card, planes, coarse)[:height, :width]
    ratio = (cells / whole)[both & np.isfinite(whole)]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
    assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.1


def test_shares_of_the_near_space_and_of_the_floor() -> None:
    """The truth is right everywhere; an answer of nothing nowhere; 4 cm more than the truth, but not 6, is right."""
    truth = truth_of(smaller(Rig(), 4.0))
    near = NearLimits(3.0, 0.05)
    floor = FreeFloor.of(truth, near)
    full = outcome(truth.depth_m, truth, near, floor)
    assert full == MethodOutcome(1.0, 0.0, 1.0, 1.0)
    nothing = outcome(np.full_like(truth.depth_m, np.nan), truth, near, floor)
    assert (nothing.answered, nothing.near, nothing.floor) == (0.0, 0.0, 0.0)
    assert np.isnan(nothing.median)
    assert near.share(truth.found, np.full_like(truth.depth_m, 0.04)) == 1.0
    assert near.share(truth.found, np.full_like(truth.depth_m, 0.06)) == 0.0
    assert outcome(0.5 * truth.depth_m, truth, near, floor).floor < 0.2


def test_hidden_pixels_count_as_unknown() -> None:
    """Pixels that the up image does not show have no sigma; they are no part of the near space that is right."""
    found = truth_of(smaller(Rig(), 8.0)).found
    sigma = np.where(found.seen, 0.01 * found.depth_m, np.nan)
    told = bound_at(0.425, found, sigma, NearLimits(3.0, 0.05))
    assert told.twice == found.seen.sum() / found.of_room.sum()
    assert (told.median, told.over_all) == (pytest.approx(0.01), pytest.approx(0.01))
    none = bound_at(0.425, found, np.where(found.seen, np.inf, np.nan), NearLimits(3.0, 0.05))
    assert (none.median, none.near) == (np.inf, 0.0)


class _Held:
    """One room of perfect matches, coarsely, and made-up rendered rooms."""

    def __init__(self, rendered: list[RenderedRoom]) -> None:
        self._rendered = rendered

    def dataset(self, recipe: str, samples: int) -> None:
        assert (recipe, samples) == ("bench-dev", 6)

    def each(self, cases: Any, what: str) -> Any:
        return iter(cases)

    def map(self, function: Any, cases: Any, what: str) -> list[Any]:
        return self._rendered if what == "dense, rendered pairs" else [function(cases[0])] * len(cases)


def _rendered(number: int) -> RenderedRoom:
    bounds = tuple(BoundAtStroke(h, 1.0 - 0.1 * h, 0.01 / h, 0.05 / h, 0.011 / h, 0.9) for h in (0.1, 1.4))
    shares = {name: MethodOutcome(0.8, 0.01, 0.5 - 0.1 * k, 0.4) for k, name in enumerate(ANSWERS)}
    return RenderedRoom(f"random-{number:06d}", "generated", 0.2 + 0.3 * number, bounds, shares)


def test_all_parts_of_the_study_fit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered = [_rendered(k) for k in (3, 1, 0, 2)]
    monkeypatch.setattr(study, "dense_pairs", lambda *_: rendered)
    monkeypatch.setattr(study, "_spot_stroke_m", lambda settings, depth_m: 0.5 * depth_m)
    changes = {"strokes_m": (0.1, 1.4), "rooms": 2, "divisor": 16.0, "resamples": 100}
    settings = read_settings(STUDY, True).model_copy(update=changes)
    held: Any = _Held(rendered)
    result = STUDY.run(settings, held)
    found = {finding.label: finding for finding in result.findings}
    assert found["bound, h = 1.4 m: both images show"].value == pytest.approx(86.0)
    assert found["rooms whose best stroke by median sigma is 1.4 m"].value == len(rendered)
    assert found["near space right, dense_sweep less dense_sgbm"].value == pytest.approx(10.0)
    assert found[f"{IN_FOCUS}, h = 0.1 m: {CENTRAL}"].value == pytest.approx(0.0, abs=1e-9)
    assert found["spot, D = 2.18 m, rig calibrated: best stroke"].value == 1.09
    assert result.tables["table"].height == len(ANSWERS) * len(rendered)
    assert {len(rows[0]) for rows in result.shown.values()} == {3, 5}
    assert [d.file_name for d in result.drawings] == ["dense.svg"]
    with pytest.raises(DatasetError, match=r"strokes_m = \[1.4, 0.1\]: must rise"):
        STUDY.run(settings.model_copy(update={"strokes_m": (1.4, 0.1)}), held)


def test_parts_are_by_the_own_stroke_and_empty_ones_are_left_out() -> None:
    parts = parts_of([_rendered(k) for k in range(3)], (0.5, 5.0))
    assert {name: len(rooms) for name, rooms in parts.items()} == {
        "all pairs": 3,
        "h below 0.5 m": 1,
        "h 0.5 to 5 m": 2,
    }
