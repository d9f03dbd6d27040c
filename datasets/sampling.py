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
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.streams import generator

Sequence = Literal["sobol", "independent"]

_OFTEN = (
    *("stroke_m", "spot.target", "spot.across_m", "spot.up_m", "rig.z_c_m", "rig.fx_px", "rig.cx_px", "rig.cy_px"),
    *("rig.radius_m", "rig.decentre_x_m", "rig.decentre_y_m", "rig.tilt_x_rad", "rig.tilt_y_rad"),
    *("rig.stroke_tilt_x_rad", "rig.stroke_tilt_y_rad", "rig.blur_sigma_px", "spot.azimuth_deg", "spot.height_m"),
)
PARAMETERS = (
    *_OFTEN,
    *(name for key in DRAWABLE if (name := f"rig.{key}") not in _OFTEN),
    *(f"misalignment.{key}" for key in MISALIGNMENT),
)
"""Everything that can be drawn; the place in this list is the dimension in Sobol's sequence, whose first ones are the
best: 16 of them correlate by at most 0.25 at 100 samples, where independent ones reach 0.38 (12 seeds each)."""


def first_points(
    sequence: Sequence, dataset: str, seed: int, count: int, names: Iterable[str] = PARAMETERS
) -> dict[str, Array]:
    """Numbers of the first try of samples 0 to `count` - 1, shape (count,), for some parameters.

    "sobol": Sobol's points, each dimension scrambled by the parameter's own stream (Matousek, J. Complexity 14, 527,
    1998), so that longer sequences begin with the shorter ones. Shifts modulo 1 do the same, but leave twice the
    correlation between dimensions at some hundred samples.
    "independent": the parameter's own stream.
    """
    streams = {name: generator(dataset, seed, "random", sequence, name) for name in names}
    if sequence == "independent":
        return {name: stream.random(count) for name, stream in streams.items()}
    from scipy.stats import qmc  # takes a second, and recipes without `[random]` need none

    power = max(count - 1, 0).bit_length()  # scipy warns about numbers that are no power of two
    sequences = (qmc.Sobol(PARAMETERS.index(name) + 1, rng=stream) for name, stream in streams.items())
    return {name: one.random_base2(power)[:count, -1] for name, one in zip(streams, sequences, strict=True)}


def further_points(
    dataset: str, seed: int, names: Iterable[str], numbers: Iterable[int], attempt: int
) -> dict[str, Array]:
    """Numbers of a later try, 1 and up, of some samples for some parameters: independent, whatever the sequence."""

    def one(name: str, number: int) -> float:
        return float(generator(dataset, seed, "random", name, number, attempt).random())

    return {name: np.array([one(name, i) for i in numbers]) for name in names}
