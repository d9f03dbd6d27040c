"""Correction of an outline fit to a JPEG frame: the fitted model is compressed again, and the fit's error taken off.

JPEG removes the limb's fine waves. The limb becomes wider and moves, by an amount that depends on the quality, on the
limb's place in the blocks, and on the noise. The fit's own model is known exactly. It goes through the camera's noise
and the same compression, in the same blocks; the fit then errs by about the same. Luma blocks are independent of each
other, so that only the units around the outline are compressed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.outline_least_squares import OutlinePixels, Step
from phibench.calibration.outline.outline_result import JPEG_DRAWS
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import light_of, mcu_px, tone_of
from phibench.estimator.spots.image_planes import full_scale_e, through_jpeg
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

_ROW = 40  # units side by side in the picture that is compressed


@dataclass(frozen=True)
class Units:
    """The units of a frame that some pixels lie in, with a border of 1 px.

    Attributes
    ----------
    u, v : shape (T, h + 2, w + 2)
        Pixels; beyond the frame its border's.
    place : shape (N,)
        Number of each pixel in the packed picture, flat.
    rows : int
        Units that are one above the other in the packed picture.
    """

    u: NDArray[np.int64]
    v: NDArray[np.int64]
    place: NDArray[np.int64]
    rows: int


def units_of(pixels: OutlinePixels, size: tuple[int, int], subsampling: str) -> Units:
    """Units of the pixels, for a frame of `size` (height, width)."""
    h, w = mcu_px(subsampling)
    unit, number = np.unique((pixels.v // h) * size[1] + pixels.u // w, return_inverse=True)
    y, x = np.mgrid[-1 : h + 1, -1 : w + 1]
    v = np.clip((unit // size[1] * h)[:, None, None] + y, 0, size[0] - 1)
    u = np.clip((unit % size[1] * w)[:, None, None] + x, 0, size[1] - 1)
    row, column = np.divmod(number, _ROW)
    place = (row * h + pixels.v % h) * (_ROW * w) + column * w + pixels.u % w
    return Units(u, v, place, -(-len(unit) // _ROW))


@dataclass(frozen=True)
class JpegSimulation:
    """A frame's processing, ready for other light in the pixels around an outline.

    Parameters
    ----------
    frame : shape (H, W, 3), 8 bits
    pixels : OutlinePixels
    card : SensorCard
    """

    frame: NDArray[Any]
    pixels: OutlinePixels
    card: SensorCard

    def drawn(self, model: Array, draws: int) -> Array:
        """Light of the pixels, shape (draws, N), as the fit would see it if its model, shape (N,), were true."""
        units = units_of(self.pixels, (self.frame.shape[0], self.frame.shape[1]), self.card.jpeg_subsampling)
        factor = np.ones(self.frame.shape[:2])
        with np.errstate(all="ignore"):
            # pixels next to black: their ratio says nothing
            factor[self.pixels.v, self.pixels.u] = np.clip(np.nan_to_num(model / self.pixels.y, nan=1.0), 0.25, 4.0)
        linear = light_of(self.frame[units.v, units.u] / 255.0, self.card) * factor[units.v, units.u][..., None]
        return np.array([self._seen(units, linear, k) for k in range(draws)])

    def _seen(self, units: Units, linear: Array, draw: int) -> Array:
        rng = generator("calibration", "outline_jpeg", draw)
        light = linear[:, 1:-1, 1:-1] + _noise(linear, units, self.card, rng)
        codes = np.rint(255.0 * tone_of(light, self.card)).astype(np.uint8)
        image = through_jpeg(_packed(codes, units.rows), self.card)
        decoded = light_of(image.reshape(-1, 3)[units.place] / 255.0, self.card)
        return np.asarray(decoded @ np.array(LUMA) / self.pixels.ray[:, 2] ** 4)


def _noise(linear: Array, units: Units, card: SensorCard, rng: np.random.Generator) -> Array:
    """Noise of demosaiced linear light, shape (T, h, w, 3), for the light (T, h + 2, w + 2, 3) of units and border."""
    gain = np.asarray(card.white_balance) / full_scale_e(card)
    colour = np.broadcast_to(np.arange(3), linear.shape)
    du, dv = card.mosaic_phase
    own = (
        colour == ((units.v + dv) % 2 + (units.u + du) % 2)[..., None]
        if card.mosaic == "bayer"
        else np.ones(linear.shape, bool)
    )
    electrons = np.clip(linear, 0.0, None) / gain
    variance = card.read_noise_e**2 + card.dsnu_e**2 + (card.prnu * electrons) ** 2 + 1.0 / (12.0 * card.dn_per_e**2)
    if card.shot_noise:
        variance = variance + electrons
    noise = np.where(own, rng.standard_normal(linear.shape) * np.sqrt(variance), 0.0) * gain
    if card.mosaic != "bayer":
        return noise[:, 1:-1, 1:-1]
    beside = noise[:, 1:-1, :-2] + noise[:, 1:-1, 2:] + noise[:, :-2, 1:-1] + noise[:, 2:, 1:-1]
    corners = noise[:, :-2, :-2] + noise[:, :-2, 2:] + noise[:, 2:, :-2] + noise[:, 2:, 2:]
    weights = np.where(np.arange(3) == 1, 0.25, 0.5)  # green has a neighbour on each side, red and blue on two
    return np.asarray(noise[:, 1:-1, 1:-1] + weights * beside + np.array([0.25, 0.0, 0.25]) * corners)


def _packed(codes: NDArray[np.uint8], rows: int) -> NDArray[np.uint8]:
    """Units (T, h, w, 3) side by side; what is left of the last row is mid grey."""
    T, h, w, _ = codes.shape
    whole = np.full((rows * _ROW, h, w, 3), 128, np.uint8)
    whole[:T] = codes
    return whole.reshape(rows, _ROW, h, w, 3).transpose(0, 2, 1, 3, 4).reshape(rows * h, _ROW * w, 3)


def corrected_for_jpeg(pixels: OutlinePixels, step: Step, frame: NDArray[Any], card: SensorCard) -> tuple[Array, Array]:
    """Last step of the fit of a JPEG frame, shape (4,), and its covariance, less what JPEG does to the fit.

    The model of the light is drawn through the camera's noise and JPEG, and the fit's answer compared with what was
    put in: first with the blur that was found, which JPEG has made wider, then with the blur that this leaves.
    """
    again, change = JpegSimulation(frame, pixels, card), step.move
    for draws in JPEG_DRAWS:
        off = np.mean(again.drawn(step.model + step.by_parameters @ change, draws), axis=0) - step.model
        change = step.move - (step.solution.move(off) - change)
    # the draws' own mean is left in the scatter: what is large there was not drawn from quite the true light
    return change, step.solution.covariance(pixels.y - step.model)
