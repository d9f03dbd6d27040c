"""Claims of faint spots: the covariance at the best place says too little, that of the posterior does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.bench_samples import with_tables

from phibench.datasets.read import open_dataset
from phibench.estimator.draw_pairs import pairs_of
from phibench.estimator.interface import Answer
from phibench.estimator.methods.raw_likelihood import with_posteriors
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


@pytest.mark.slow  # 14 pairs of whole frames, detection included: 15 s
def test_accuracy_of_what_faint_spots_claim(bench_dataset: Path) -> None:
    """Raw spots of 6 to 8 sigma: 1.6 at the fit's own covariance, 1.05 at the posterior's, of 38 images once.

    28 images give the rms of 56 numbers: 1 +- 0.095 if the claims are right. 1.35 is 3.7 sigma, false alarms 1e-4; a
    claim that is 1.6 times too small passes with a chance of 3e-3.
    """
    dataset = open_dataset(bench_dataset)
    frames = {**dataset.info.recipe["frames"], "laser_level": 0.05, "exposure_s": 0.01, "hint": 1.0}
    sample = with_tables(dataset, frames=frames)[0]
    drawn = pairs_of(sample.dataset, [sample], "bayer-raw", draws=DRAWS)
    before, after = [], []
    for number in range(DRAWS):
        pair = drawn.pair(number)
        answer = METHODS["raw_maximum_likelihood"](pair)
        if answer.down.uv_px is None or answer.up.uv_px is None:
            continue
        before += pulls(answer, sample.row)
        after += pulls(with_posteriors(pair, answer), sample.row)
    assert len(after) >= DRAWS
    (rms, errors_px) = np.sqrt(np.mean(np.square([before, after]), axis=(1, 3))).T
    print(f"{len(after)} images, pull of the fit {rms[0]:.2f}, of the posterior {rms[1]:.2f}, errors {errors_px} px")
    assert rms[1] < 1.35
    # errors of both are alike to some percent; those of on - off, with the noise of two frames, are 1.2 times as large
    assert errors_px[1] < 1.1 * errors_px[0]
    assert rms[0] > 1.15 * rms[1]  # otherwise the spots are not faint, and nothing was tested
