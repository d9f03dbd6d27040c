"""Which part of the probability each parameter of each drawn sample takes: numbers in [0, 1).

The number of sample i for parameter p is a function of (data set, seed, sequence, p, i) and of nothing else: neither of
how many samples there are nor of which other parameters are drawn. A sample that turns out to be impossible is tried
again with numbers of its own streams, so that no other sample moves.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np

from phibench.datasets.recipe import DRAWABLE
from phibench.datasets.streams import generator
from phibench.scenes.frames import Array

Sequence = Literal["sobol", "independent"]

PARAMETERS = (
    *("stroke_m", "spot.target", "spot.across_m", "spot.up_m", "spot.azimuth_deg", "spot.height_m"),
    *(f"rig.{key}" for key in DRAWABLE),
)
"""Everything that can be drawn; the place in this list is the dimension in Sobol's sequence."""


def first_points(sequence: Sequence, dataset: str, seed: int, count: int) -> dict[str, Array]:
    """Numbers of the first try of samples 0 to `count` - 1, shape (count,), for every parameter.

    "sobol": Sobol's points, not scrambled, each dimension shifted modulo 1 by a number of the parameter's own stream
    (Cranley & Patterson, SIAM J. Numer. Anal. 13, 904, 1976): longer sequences begin with the shorter ones.
    "independent": the parameter's own stream.
    """
    streams = {name: generator(dataset, seed, "random", sequence, name) for name in PARAMETERS}
    if sequence == "independent":
        return {name: stream.random(count) for name, stream in streams.items()}
    from scipy.stats import qmc  # takes a second, and recipes without `[random]` need none

    power = max(count - 1, 0).bit_length()  # scipy warns about numbers that are no power of two
    points = qmc.Sobol(len(PARAMETERS), scramble=False).random_base2(power)[:count]
    return {name: (points[:, k] + stream.random()) % 1.0 for k, (name, stream) in enumerate(streams.items())}


def further_points(
    dataset: str, seed: int, names: Iterable[str], numbers: Iterable[int], attempt: int
) -> dict[str, Array]:
    """Numbers of a later try, 1 and up, of some samples for some parameters: independent, whatever the sequence."""

    def one(name: str, number: int) -> float:
        return float(generator(dataset, seed, "random", name, number, attempt).random())

    return {name: np.array([one(name, i) for i in numbers]) for name in names}
