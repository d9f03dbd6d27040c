"""Answers of fits at spots that `detect` saw: `measure_fit_begins.py FOLDER [--preset NAME] [--draws N] ...`.

Run from the repository root on the rooms of docs/rooms_of_fits.toml. The laser is dimmed until the brightest pixel of
each spot holds a share of the full well, 5 % by default. Each pair is asked as whole frames and with boxes of 40 px.
Of the images in which `detect` is within 1 px of the light's centre, the table counts the answers of each fit: how
many there are, how many are beyond 3 px and beyond 5 claimed sigma, and the farthest from the detection.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from phibench.datasets.exposures.pair_draws import CachedSample, PairDraw
from phibench.datasets.exposures.search_boxes import search_boxes
from phibench.datasets.frames.frame_request import FrameRequest
from phibench.datasets.frames.frame_source import FrameSource
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.estimator.drawn_pairs import DrawnPairs
from phibench.estimator.interface import Answer, Box, Pair
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair, pair_detection
from phibench.scenes.rig import POSITIONS

BOX_PX = 40
NEAR_PX, FAR_PX, SIGMAS = 1.0, 3.0, 5.0
FITS = {"raw": ("raw_maximum_likelihood", "joint_fit"), "processed": ("chain_fit", "joint_fit")}


@dataclass(frozen=True)
class Seen:
    """One answer of a fit: errors of `detect` and of the fit, their distance, all pixels; error over claimed sigma."""

    form: str
    method: str
    pair: str
    detect_px: float
    error_px: float
    apart_px: float
    sigmas: float
    sigma_px: float
    z: float
    why: str


def dimmed(sample: Sample, preset: str, share: float, draw: int, laser_off: bool) -> PairDraw:
    """Pair whose spot has a share of the full well in its brightest pixel, the brighter of both images."""
    held = CachedSample.of(sample)
    request = FrameRequest(preset, "auto", laser_level=1e-3)
    sensor = FrameSource.from_request(held, request).sides["down"].chain.sensor
    peaks = [float(held.spot(p).electrons_per_s.max(initial=0.0)) for p in POSITIONS]
    level = share * sensor.full_well_e / (max(peaks) * sensor.exposure_s)
    fixed = {**request.overrides, "analogue_gain": sensor.analogue_gain}
    request = replace(request, exposure=sensor.exposure_s, laser_level=level, overrides=fixed)
    return PairDraw(0, sample.row.sample_id, preset, draw, request, laser_off, None, ())


def with_boxes(pair: Pair, sample: Sample) -> Pair:
    """The pair with boxes of 40 px, in which the spots may be anywhere."""
    down, up = (Box(r.u0_px, r.v0_px, r.shape[1], r.shape[0]) for r in search_boxes(sample, BOX_PX))
    return replace(pair, box_down=down, box_up=up)


def answers(dataset: Dataset, preset: str, share: float, draws: int, laser_off: bool) -> Iterator[Seen]:
    """Answers of all fits for all samples and draws."""
    for sample in dataset:
        if not (sample.row.down.visible or sample.row.up.visible):
            continue
        chosen = [dimmed(sample, preset, share, draw, laser_off) for draw in range(draws)]
        pairs = DrawnPairs(dataset, tuple(replace(one, number=k) for k, one in enumerate(chosen)))
        for k in range(draws):
            pair = pairs.pair(k)
            for form, seen in (("whole", pair), (f"box {BOX_PX}", with_boxes(pair, sample))):
                yield from of_pair(sample, f"{sample.row.sample_id} draw {k}", form, SharedPair.of(seen))


def of_pair(sample: Sample, name: str, form: str, pair: SharedPair) -> Iterator[Seen]:
    """Answers of the fits for one pair."""
    found = pair_detection(pair)
    for method in FITS["raw" if pair.card.output == "raw" else "processed"]:
        answer: Answer = METHODS[method](pair)
        for position in POSITIONS:
            row, one, spot = sample.row.position(position), getattr(found, position), getattr(answer, position)
            if not row.visible or one is None:
                continue
            truth = np.array([row.u_px, row.v_px])
            detect_px = float(np.hypot(*(one.uv_px - truth)))
            if spot.uv_px is None:
                nan = math.nan
                yield Seen(
                    form, method, f"{name} {position}", detect_px, nan, nan, nan, nan, one.significance, spot.status
                )
                continue
            off, apart = np.subtract(spot.uv_px, truth), np.subtract(spot.uv_px, one.uv_px)
            C = np.full((2, 2), np.nan) if spot.covariance_px2 is None else np.array(spot.covariance_px2)
            sigmas = math.sqrt(off @ np.linalg.solve(C, off)) if np.isfinite(C).all() else math.nan
            sigma = math.sqrt(0.5 * np.trace(C))
            yield Seen(
                form,
                method,
                f"{name} {position}",
                detect_px,
                float(np.hypot(*off)),
                float(np.hypot(*apart)),
                sigmas,
                sigma,
                one.significance,
                "",
            )


def table(seen: list[Seen]) -> Iterator[str]:
    """Lines of the table."""
    yield "| form | method | detect within 1 px | answers | beyond 3 px | beyond 5 sigma | farthest from detect, px |"
    yield "|---|---|---|---|---|---|---|"
    for form, method in sorted({(one.form, one.method) for one in seen}):
        near = [x for x in seen if (x.form, x.method) == (form, method) and x.detect_px <= NEAR_PX]
        there = [x for x in near if math.isfinite(x.error_px)]
        far, wild = sum(x.error_px > FAR_PX for x in there), sum(x.sigmas > SIGMAS for x in there)
        most = max((x.apart_px for x in there), default=math.nan)
        yield f"| {form} | `{method}` | {len(near)} | {len(there)} | {far} | {wild} | {most:.2f} |"


def main() -> None:
    """Print the table, then a line for each answer beyond 3 px and each image without one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default="bayer-raw")
    parser.add_argument("--share", type=float, default=0.05, help="of the full well, in the spot's brightest pixel")
    parser.add_argument("--draws", type=int, default=25, help="of the noise, of each sample")
    parser.add_argument("--no-off", action="store_true", help="without laser-off frames")
    given = parser.parse_args()
    dataset = open_dataset(given.folder)
    seen = list(answers(dataset, given.preset, given.share, given.draws, not given.no_off))
    print("\n".join(table(seen)))
    for one in seen:
        if one.detect_px <= NEAR_PX and not one.error_px <= FAR_PX:
            print(f"{one.form} {one.method} {one.pair}: {one.error_px:.2f} px, sigma {one.sigma_px:.2f} px {one.why}")


if __name__ == "__main__":
    main()
