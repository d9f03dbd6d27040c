"""Claims of faint spots: the covariance at the best place says too little, that of the posterior does not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from helpers.bench_samples import with_tables
from helpers.faint_spots import faint_spots

from phibench.datasets.read import open_dataset
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.interface import Answer
from phibench.estimator.methods import raw_likelihood
from phibench.estimator.methods.joint_fit import with_posteriors
from phibench.estimator.methods.likelihood_maps import SpotLikelihood, claimed_px2
from phibench.estimator.methods.registry import METHODS
from phibench.scenes.rig import POSITIONS

DRAWS = 14


def pulls(answer: Answer, row: object) -> list[np.ndarray]:
    """L^-1 e and e of both images, C = L L^T, of spots within 3 px; each shape (2, 2)."""
    found = []
    for position in POSITIONS:
        spot, true = getattr(answer, position), getattr(row, position)
        off = np.array(spot.uv_px) - [true.u_px, true.v_px]
        if np.hypot(*off) < 3.0:
            found.append(np.stack([np.linalg.solve(np.linalg.cholesky(np.array(spot.covariance_px2)), off), off]))
    return found


@pytest.fixture(scope="module")
def faint(bench_dataset: Path) -> dict[str, np.ndarray]:
    """Pulls and errors of raw spots of 10 to 13 sigma: by the curvature, the pair's posterior, the method's claim.

    Whole frames of one sample, detection included: 15 s. Shape of each: (images, 2, 2).
    """
    dataset = open_dataset(bench_dataset)
    frames = {**dataset.info.recipe["frames"], "laser_level": 0.05, "exposure_s": 0.01, "hint": 1.0}
    sample = with_tables(dataset, frames=frames)[0]
    drawn = pairs_of(sample.dataset, [sample], "bayer-raw", draws=DRAWS)
    found: dict[str, list[np.ndarray]] = {"curvature": [], "posterior": [], "claimed": []}
    for number in range(DRAWS):
        pair = drawn.pair(number)
        with pytest.MonkeyPatch.context() as alone:  # the fit's own claim, that of the curvature at its place
            alone.setattr(raw_likelihood, "claimed_px2", lambda uv_px, covariance_px2, likelihood: covariance_px2)
            answer = METHODS["raw_maximum_likelihood"](pair)
        if answer.down.uv_px is None or answer.up.uv_px is None:
            continue
        found["curvature"] += pulls(answer, sample.row)
        found["posterior"] += pulls(with_posteriors(pair, answer), sample.row)
        found["claimed"] += pulls(METHODS["raw_maximum_likelihood"](pair), sample.row)
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.slow  # the frames above
def test_accuracy_of_what_the_posterior_of_faint_spots_claims(faint: dict[str, np.ndarray]) -> None:
    """1.6 at the fit's own covariance, 1.05 at the posterior's, of 38 images once.

    28 images give the rms of 56 numbers: 1 +- 0.095 if the claims are right. 1.35 is 3.7 sigma, false alarms 1e-4; a
    claim that is 1.6 times too small passes with a chance of 3e-3.
    """
    rms, errors_px = np.sqrt(np.mean(np.square([faint["curvature"], faint["posterior"]]), axis=(1, 3))).T
    images = len(faint["posterior"])
    print(f"{images} images, pull of the fit {rms[0]:.2f}, of the posterior {rms[1]:.2f}, errors {errors_px} px")
    assert images >= DRAWS
    assert rms[1] < 1.35
    # errors of both are alike to some percent; those of on - off, with the noise of two frames, are 1.2 times as large
    assert errors_px[1] < 1.1 * errors_px[0]
    assert rms[0] > 1.15 * rms[1]  # otherwise the spots are not faint, and nothing was tested


@pytest.mark.slow  # the same frames
def test_accuracy_of_what_a_fit_of_faint_spots_claims(faint: dict[str, np.ndarray]) -> None:
    """The method's place is the fit's, its claim the mean square of the posterior about it: the same tolerance.

    Where a posterior has two tops some pixels apart, or is skew, no covariance describes it. With the light maps of one
    commit 2 of 120 images were beyond 5 claimed sigma (28 and 27), with those before and after it none of 28, and 24 at
    most of 120 (docs/measurements/spots.md).
    """
    squares = np.sum(np.square(faint["claimed"])[:, 0], axis=1)
    assert math.sqrt(squares.mean() / 2.0) < 1.35
    assert squares.max() < 25.0


@pytest.mark.slow
def test_claims_of_faint_spots_all_over_the_mosaic() -> None:
    """70 spots of 7 sigma: the rms of 140 numbers is 1 +- 0.06 of right claims; 1.24 is 4 sigma, false alarms 3e-5."""
    found = faint_spots(snr=7.0, sigma_px=0.8, room_e=20.0, count=70)
    rms = [math.sqrt(squares.mean() / 2.0) for squares in (found.curvature, found.claimed, found.posterior)]
    print(f"{len(found.claimed)} spots, pull by curvature {rms[0]:.2f}, claimed {rms[1]:.2f}, posterior {rms[2]:.2f}")
    assert len(found.claimed) > 60
    assert max(rms[1:]) < 1.24 < rms[0]
    assert found.claimed.max() < 25.0
    assert found.apart_px.max() < 3.0


def test_a_posterior_without_an_end_claims_nothing() -> None:
    """Light that is 2 sigma everywhere: the fit's own curvature says a tenth of a pixel."""

    def scores(theta: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        F = np.diag([100.0, 100.0, 1.0])[first:, first:]
        off = theta[:, :2] - 7.0
        misfit = 4.0 * (1.0 - np.exp(-25.0 * np.sum(off**2, axis=1))) + (theta[:, 2] - 900.0) ** 2
        score = np.column_stack([np.zeros((len(theta), 2)), 900.0 - theta[:, 2]])[:, first:]
        return misfit, score, np.repeat(F[None], len(theta), axis=0)

    one = SpotLikelihood(scores, np.array([7.0, 7.0, 900.0]), np.zeros(2), 1.0)
    C = np.eye(2) * 0.1**2
    assert claimed_px2(np.full(2, 7.0), C, lambda: one) is None
    sharp = np.eye(2) * 0.01**2
    assert claimed_px2(np.full(2, 7.0), sharp, lambda: one) is sharp  # bright spots are not asked
    assert claimed_px2(np.full(2, 7.0), C, lambda: None) is C
