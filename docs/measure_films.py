"""Depths from films against the truth: `measure_films.py FOLDER [--cameras N] [--first N]`.

Run from the repository root on the films of docs/films_of_rooms.toml. Each film has some cameras, with a fixed pattern
and a draw of the noise of their own; the true rig is known, the vibration is not. Pulls are those of `depth_pull`: in D
where sigma is at most 5 % of D, else in 1 / D. Those in D alone stand beside them. Intervals are of normal errors, by
chi squared, as if the cameras of a film were independent; a second one counts films, not cameras.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film, open_films
from phibench.estimator.geometry.status import depth_pull
from phibench.robot.film.film_estimates import bundle_depth, seen_film
from phibench.robot.film.film_frames import film_frames


@dataclass(frozen=True)
class Estimate:
    """One camera's answer for a film; nan where it was refused, with the sentence."""

    film: str
    true_m: float
    depth_m: float = math.nan
    sigma_m: float = math.nan
    half_m: float = math.nan
    half_sigma_m: float = math.nan
    why: str = ""


def estimate(film: Film, camera: int) -> Estimate:
    """Bundle of all frames of one camera, and of the first half of them."""
    frames = film_frames(film, draw=camera, camera_seed=camera)
    true = film.light_depth_m
    try:
        half = bundle_depth(seen_film(frames.until(len(film) // 2)))
        found = bundle_depth(seen_film(frames))
    except DatasetError as error:
        return Estimate(film.info.film, true, why=str(error))
    return Estimate(film.info.film, true, found.depth_m, found.sigma_m, half.depth_m, half.sigma_m)


def rms(pulls: Sequence[float] | np.ndarray, films: int) -> str:
    """Rms pull with the 95 % intervals of as many estimates, and of as many films."""
    n, value = len(pulls), float(np.sqrt(np.mean(np.square(pulls))))
    ends = [[value * math.sqrt(k / chi2.ppf(q, k)) for q in (0.975, 0.025)] for k in (n, films)]
    return f"{value:.2f} [{ends[0][0]:.2f}, {ends[0][1]:.2f}], by films [{ends[1][0]:.2f}, {ends[1][1]:.2f}]"


def main() -> None:
    """Print a line per estimate, then what all say together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cameras", type=int, default=3, help="of each film")
    parser.add_argument("--first", type=int, default=0, help="number of the first camera")
    parser.add_argument("--films", nargs="*", help="ids of some of them")
    given = parser.parse_args()
    held, every = open_films(given.folder), []
    films = list(held) if given.films is None else [held[name] for name in given.films]
    for film in films:
        for camera in range(given.first, given.first + given.cameras):
            one = estimate(film, camera)
            every.append(one)
            print(
                f"{one.film} camera {camera}: D {one.true_m:.4f} m, {one.depth_m:.5f} +- {one.sigma_m:.5f} m; "
                f"first half {one.half_m:.5f} +- {one.half_sigma_m:.5f} m {one.why}",
                flush=True,
            )
    good = [one for one in every if math.isfinite(one.depth_m)]
    D, sigma, true = (np.array([getattr(one, name) for one in good]) for name in ("depth_m", "sigma_m", "true_m"))
    pulls, count = depth_pull(D, sigma, true), len({one.film for one in good})
    wide = int(np.sum(sigma > 0.05 * D))
    print(f"{len(every)} estimates of {len(films)} films, {len(every) - len(good)} refused, {wide} of sigma above 5 %")
    plain = rms((D - true) / sigma, count)
    print(f"bundle: rms pull {rms(pulls, count)}; largest {np.abs(pulls).max():.2f}; in D {plain}")
    print(f"bundle: beyond 5 sigma {int(np.sum(np.abs(pulls) > 5))}; within 95 % {np.mean(np.abs(pulls) <= 1.96):.1%}")
    half, spread = (np.array([getattr(one, name) for one in good]) for name in ("half_m", "half_sigma_m"))
    early = depth_pull(half, spread, true)
    print(f"first half: rms pull {rms(early, count)}; beyond 5 sigma {int(np.sum(np.abs(early) > 5))}")


if __name__ == "__main__":
    main()
