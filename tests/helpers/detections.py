"""Shares of spots that are detected without a hint, and of false detections, in the rooms of a data set.

`python tests/helpers/detections.py DATASET [FOLDER SPOTS SEED]` prints the figures for the data set's own spots, or for
so many further ones in each sample's room, whose layers it writes to FOLDER.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from helpers.further_spots import with_further_spots

from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, rate
from phibench.benchmark.scores.strata import CLEAR_SIGMAS
from phibench.datasets.read import Dataset, open_dataset
from phibench.estimator.spots.detect import detect

PRESETS = ("bayer-raw", "srgb8", "mjpeg")


def detections(dataset: Dataset, preset: str) -> tuple[Estimate, Estimate, int, list[str]]:
    """Share of clear spots that is found, share of their images with a false one, their number, and what was wrong."""
    pairs, rows, wrong = dataset_pairs(dataset, preset, hints=False), [], []
    rooms = {row.sample_id: row.room for row in dataset.rows}
    for number in range(len(pairs)):
        truth, answers = pairs.truth(number), detect(pairs.pair(number))
        for position in ("down", "up"):
            spot, answer = getattr(truth, position), getattr(answers, position)
            if not spot.visible or spot.snr < CLEAR_SIGMAS:
                continue
            away = np.inf if answer is None else float(np.hypot(*np.subtract(answer.uv_px, spot.uv_px)))
            found = away <= MATCH_PX
            rows.append((rooms[truth.sample_id], found, answer is not None and not found))
            if not found:
                other = (
                    min(
                        (float(np.hypot(*np.subtract(answer.uv_px, one.uv_px))) for one in spot.distractions),
                        default=np.inf,
                    )
                    if answer is not None
                    else np.inf
                )
                what = "missed" if answer is None else "on another light" if other <= MATCH_PX else "elsewhere"
                wrong.append(f"{truth.sample_id} {position}: {what}, {spot.snr:.0f} sigma, {spot.electrons:.0f} e-")
    labels, found, false = zip(*rows, strict=True)
    clusters = Clusters.of(labels)
    shares = [rate(clusters, np.array(hits, float), Rules()) for hits in (found, false)]
    return shares[0], shares[1], len(rows), wrong


def told(dataset: Dataset, preset: str) -> tuple[Estimate, Estimate]:
    found, false, count, wrong = detections(dataset, preset)
    for name, share in (("found", found), ("false", false)):
        print(f"{preset}, {count} images above 10 sigma, {name}: {share.value:.4f} [{share.low:.4f}, {share.high:.4f}]")
    print("\n".join(wrong))
    return found, false


if __name__ == "__main__":
    shown = open_dataset(Path(sys.argv[1]))
    if len(sys.argv) > 2:
        shown = with_further_spots(shown, Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
    for name in PRESETS:
        told(shown, name)
