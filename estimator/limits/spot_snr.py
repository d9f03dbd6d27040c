"""Signal to noise of a spot: one number for all outputs of a camera, rising with the light.

With s the spot's light, b the room's and F(m) the Fisher matrix of the image for the mean light m, it is the length of
the way from the image without the spot to that with it,

    SNR = integral from 0 to 1 of sqrt(s^T F(b + t s) s) dt,

place and room known (C. R. Rao, Bull. Calcutta Math. Soc. 37, 81, 1945). Of constant Gaussian noise this is the
matched filter's ratio. Of Poisson noise it is 2 (sqrt(b + s) - sqrt(b)) per pixel. Its square is twice the expected
logarithm of the likelihood ratio as long as the noise changes little on the way. More light makes the way longer: full
pixels, whose information is 0, add nothing and take nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial.legendre import leggauss

from phibench.datasets.exposures.expected import ExpectedRegion
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.limits.off_frame_bound import without_room
from phibench.estimator.limits.position_bound import raw_information

_MANY = 32  # nodes where one costs nothing: 1 % beyond saturation, 1e-3 below it
# Radau's rule with the end of the way, where the bound of the position is computed anyway
_RADAU = (((4.0 - 6.0**0.5) / 10.0, (16.0 + 6.0**0.5) / 36.0), ((4.0 + 6.0**0.5) / 10.0, (16.0 - 6.0**0.5) / 36.0))
_END = 1.0 / 9.0  # its weight there


def raw_snr(
    region: ExpectedRegion, card: SensorCard, frames: FrameCounts | None = None, pattern_known: bool = False
) -> float:
    """Signal to noise on raw pixels.

    Parameters
    ----------
    region : ExpectedRegion
    card : SensorCard
    frames : FrameCounts, optional
        Frames with the laser on and off from which alone the room is known.
    pattern_known : bool
        As for `position_bound.spot_limit`.
    """
    spot, room = region.spot_e, region.background_e
    prnu = 0.0 if pattern_known else card.prnu

    def information(part: float) -> float:
        if frames is None:
            pixels = raw_information(room + part * spot, card, pattern_known=pattern_known)
        else:
            on, off = (raw_information(mean, card, pattern_known=True) for mean in (room + part * spot, room))
            pixels = without_room(on, off, part * spot, frames, prnu)
        return float(np.sum(spot**2 * pixels))

    x, weight = leggauss(_MANY)
    x = 0.5 * (x + 1.0)
    return float(sum(0.5 * w * _speed(information, node) for node, w in zip(x, weight, strict=True)))


def processed_snr(information: Callable[[float], float], at_the_end: float) -> float:
    """Signal to noise of codes or coefficients, by three nodes: within 5 % below saturation.

    Parameters
    ----------
    information : function of t
        s^T F(b + t s) s.
    at_the_end : float
        The same at t = 1.
    """
    return sum(w * _speed(information, x) for x, w in _RADAU) + _END * 2.0 * max(at_the_end, 0.0) ** 0.5


def _speed(information: Callable[[float], float], x: float) -> float:
    """Integrand of the way in x = sqrt(t), in which it is smooth where the room is dark."""
    return 2.0 * x * max(information(x * x), 0.0) ** 0.5
