"""Input of the networks, a crop or a whole frame: images of every processing as planes of electrons behind R, G and B.

Crops have 32 x 32 pixels and begin at an even column and row, so that red pixels of the mosaic come first. Raw pixels
are interpolated bilinearly, which loses nothing; 8-bit codes go back through tone curve, colour matrix and white
balance. What is left of the difference on - off is then free of exposure, gain and the brightness of the room. G and B
are brought to the filters of the training: at a bright spot the place hangs on how much of the laser they let through.

Noise is measured in the border of the crop itself.

A whole frame is brought to cells of 2 x 2 pixels: the difference on - off behind R and G in standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import Box, Image
from phibench.estimator.spots.camera_codes import qtables_of, quantisation
from phibench.estimator.spots.image_planes import colour_planes, demosaiced_planes, variance_e2
from phibench.estimator.spots.raw_pixels import raw_electrons
from phibench.scenes.frames import Array, BoolArray

SIDE_PX = 32
WINDOW_PX = SIDE_PX + 1  # with red at all four corners: mirrored and turned, it still begins with red
PLANES = 4  # R, G, B of the difference, and full pixels
SCALARS = 9  # see `crop_input`
FRAME_PLANES = 3  # significance behind R and G, and full pixels
ACCEPTED = ("bayer-raw", "srgb8", "mjpeg")

_MIDDLE = slice(10, 22)  # of a crop: rows and columns in which the spot's centre may lie
_BORDER_PX = 6  # of which background and noise are taken
_SIGMA_OF_MAD = 1.4826
_LEAST_SIGMA = 0.1  # of the card's: rounding and JPEG may leave a border without any noise
_CUT = 3.0  # of relative values: beyond it there is another light
_COMPRESSED = 3.0  # significances beyond it count by their logarithm
_TRAINED = np.array([1.0, 0.10, 0.03])  # response of R, G, B at the laser's line, in `bench-dev`
_MOST_GAIN = 3.0  # of a filter that lets less through: its noise grows as much
_NOISE_STEP = 4  # every fourth cell in both directions is enough for a median


@dataclass(frozen=True)
class CropInput:
    """Input for one crop.

    Attributes
    ----------
    planes : shape (4, 33, 33), float32
        Difference behind R, G, B over the spot's amplitude; 1 where a pixel is full.
    scalars : shape (9,), float32
    """

    planes: NDArray[np.float32]
    scalars: NDArray[np.float32]

    @property
    def views(self) -> tuple[CropView, ...]:
        """Those of `VIEWS` that training has shown: MJPEG with chroma of half the width is not turned."""
        return tuple(view for view in VIEWS if not (view.turned and self.scalars[-1]))


@dataclass(frozen=True)
class CropView:
    """A window mirrored left to right (u = -1), top to bottom (v = -1), and then turned: rows become columns."""

    u: int
    v: int
    turned: bool

    def of(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Crops of 32 x 32 pixels, from windows of 33 x 33 in the last two axes."""
        seen = planes[..., :: self.v, :: self.u]
        return (np.swapaxes(seen, -1, -2) if self.turned else seen)[..., :SIDE_PX, :SIDE_PX]

    @property
    def matrix(self) -> Array:
        """Of vectors (u, v) in the window, which becomes that in the view; orthogonal."""
        flip = np.diag([float(self.u), float(self.v)])
        return flip[::-1] if self.turned else flip


VIEWS = tuple(CropView(u, v, turned) for turned in (False, True) for v in (1, -1) for u in (1, -1))


def crop_origin(uv_px: tuple[float, float]) -> tuple[int, int]:
    """First column and row of the crop about a position: even, with the position within a pixel of its middle."""
    u0, v0 = (2 * round((x - (SIDE_PX - 1) / 2.0) / 2.0) for x in uv_px)
    return int(u0), int(v0)


def cut_part(image: Image, origin_px: tuple[int, int], side_px: int = WINDOW_PX) -> Image:
    """Part of an image, shape (H, W, ...), that may reach over its border.

    Beyond the border stands what is mirrored about the border pixel, which keeps the mosaic's colours in order.
    """
    height, width = image.shape[:2]
    rows, columns = (
        _mirrored(first + np.arange(side_px), n) for first, n in zip(origin_px[::-1], (height, width), strict=True)
    )
    return np.asarray(image[rows[:, None], columns[None, :]])


def _mirrored(index: NDArray[Any], size: int) -> NDArray[Any]:
    inside = np.abs(index)
    return np.clip(np.where(inside >= size, 2 * (size - 1) - inside, inside), 0, size - 1)


def filter_planes(image: Image, card: SensorCard) -> tuple[Array, BoolArray]:
    """Electrons behind R, G, B, shape (3, h, w), and full pixels, shape (h, w), of a part that begins with red."""
    if card.output == "raw":
        signal = raw_electrons(image, card)
        return demosaiced_planes(signal), np.asarray(signal >= card.saturation_e)
    height, width = image.shape[:2]
    colours = colour_planes(image, card, Box(0, 0, width, height))
    return np.asarray(colours.values_e, float), np.asarray(colours.full.any(axis=0))


def crop_input(on: Image, off: Image | None, card: SensorCard, response: Sequence[float]) -> CropInput:
    """Input for a window of 33 x 33 pixels.

    Parameters
    ----------
    on, off : shape (33, 33, ...)
        Pixels with the laser on, and off where there are such; without them the border's median is the background.
    response : 3 floats
        Of the filters R, G, B at the laser's line: `Detector.laser_filter_response`.

    Returns
    -------
    CropInput
        Scalars: ln of amplitude over the card's noise; ln of measured over the card's noise; amplitude over the
        saturation; the room's level over the saturation; whether there are pixels with the laser off; ln of JPEG's
        mean steps of luma and chroma over 10 codes, 0 without; whether the pixels are raw; whether they are of MJPEG.
    """
    planes, full = filter_planes(on, card)
    border = np.ones(full.shape, bool)
    border[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    room = np.median(planes[:, border], axis=1)[:, None, None]
    if off is None:
        difference = planes - room
    else:
        dark, dark_full = filter_planes(off, card)
        difference, full = planes - dark, full | dark_full
    difference = difference - np.median(difference[:, border], axis=1)[:, None, None]
    level = float(room[0, 0, 0])
    sigma = float(np.sqrt(variance_e2(np.array(level), card, alike=off is not None) * (1.0 if off is None else 2.0)))
    measured = _SIGMA_OF_MAD * float(np.median(np.abs(difference[0, border])))
    amplitude = max(float(_smoothed(difference[0])[_MIDDLE, _MIDDLE].max()), 0.5 * sigma)
    relative = np.clip(difference / amplitude * _gains(response)[:, None, None], -_CUT, _CUT)
    scalars = (
        np.log(amplitude / sigma),
        np.log(measured / sigma + _LEAST_SIGMA),
        amplitude / card.saturation_e,
        level / card.saturation_e,
        float(off is not None),
        *_steps_ln(card),
        float(card.output == "raw"),
        float(card.output == "mjpeg"),
    )
    return CropInput(np.concatenate([relative, full[None]]).astype(np.float32), np.array(scalars, np.float32))


def _steps_ln(card: SensorCard) -> tuple[float, float]:
    """ln of JPEG's mean steps of luma and chroma over 10 codes; 0 without JPEG."""
    if card.output != "mjpeg":
        return 0.0, 0.0
    luma, chroma = (float(np.log(table.mean() / 10.0)) for table in quantisation(qtables_of(card)))
    return luma, chroma


def _gains(response: Sequence[float]) -> Array:
    """Factors that bring the laser's light behind R, G, B to the filters of the training, red left as it is."""
    share = np.asarray(response, float) / response[0] if response[0] > 0.0 else _TRAINED
    return np.asarray(_TRAINED / np.maximum(share, _TRAINED / _MOST_GAIN))


def _smoothed(plane: Array) -> Array:
    """Mean over (1 2 1) / 4 along both axes, shape (h, w): a peak that noise and mosaic move less."""
    p = np.pad(plane, 1, mode="edge")
    rows = 0.25 * (p[:-2] + 2.0 * p[1:-1] + p[2:])
    return np.asarray(0.25 * (rows[:, :-2] + 2.0 * rows[:, 1:-1] + rows[:, 2:]))


# -- whole frames ----------------------------------------------------------------------------------------------------


def frame_input(on: Image, off: Image, card: SensorCard) -> tuple[NDArray[np.float32], Array]:
    """Input for a frame at half its resolution, and the red light of its cells.

    Parameters
    ----------
    on, off : shape (H, W, ...), H and W even
        Frame or a part of it that begins at an even row and column.

    Returns
    -------
    planes : shape (3, H / 2, W / 2), float32
        Means of on - off behind R and G over cells of 2 x 2 pixels, in standard deviations z of the noise, compressed
        as asinh(z / 3); share of full pixels.
    red_e : shape (H / 2, W / 2)
        Electrons of the difference behind R, mean of a cell.
    """
    (lit, full), (dark, dark_full) = filter_planes(on, card), filter_planes(off, card)
    cells = [_cells(lit[k] - dark[k]) for k in (0, 1)]
    planes = []
    for k, cell in enumerate(cells):
        z = cell / np.sqrt(2.0 * variance_e2(_cells(dark[k]), card, alike=True))
        # the card knows no interpolation, denoising or JPEG: the scale is measured
        scatter = _SIGMA_OF_MAD * float(np.median(np.abs(z[::_NOISE_STEP, ::_NOISE_STEP])))
        planes.append(np.arcsinh(z / max(scatter, _LEAST_SIGMA) / _COMPRESSED))
    planes.append(_cells(full | dark_full))
    return np.stack(planes).astype(np.float32), cells[0]


def _cells(plane: NDArray[Any]) -> Array:
    """Means of cells of 2 x 2 pixels, shape (H / 2, W / 2)."""
    p = np.asarray(plane, float)
    rows = p[::2] + p[1::2]
    return np.asarray(0.25 * (rows[:, ::2] + rows[:, 1::2]))
