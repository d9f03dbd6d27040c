"""Sensor card: a sensor's numbers that an estimator may know; and names of presets by their output."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from phibench.render.sensor.settings import Sensor, preset_outputs, sensor


@dataclass(frozen=True)
class SensorCard:
    """Numbers of one sensor, as `render.sensor.settings.Sensor` defines them.

    Attributes
    ----------
    mosaic : "bayer" (RGGB, red at even row and even column) or "mono"
    full_well_e, read_noise_e, row_noise_e, dsnu_e : float, electrons
    prnu : float, relative
    dn_per_e : float
        Overall system gain K, analogue gain included.
    top_dn : int
        Largest code.
    output : "electrons", "raw", "srgb8", "yuyv" or "mjpeg"
        Stage after which the chain ends.
    white_balance : 3 floats
        Gains of R, G, B on linear planes.
    colour_matrix : 3 x 3
        Rows give linear sRGB from white-balanced R, G, B.
    sharpen_amount : float
        Gain of the unsharp mask x + amount (x - blur x), blur (1 2 1)/4 along both axes, after the tone curve.
    jpeg_quality : int
        libjpeg's quality.
    jpeg_subsampling : "4:4:4", "4:2:2" or "4:2:0"
    jpeg_qtables : two tables of 64 steps, row by row, or None
        Of luma and chroma, in place of the quality.
    transfer_function : "srgb", "rec709" or "table"
        Tone curve from linear to encoded R, G, B.
    transfer_points : pairs (linear, encoded), or None
        Of "table"; straight lines join them.
    denoise_luma, denoise_chroma : float
        Share d of the blur in x + d (blur x - x), on Y' and on Cb, Cr, after the unsharp mask.
    denoise_reach_px : int
        Of the blur in Y': 1 is (1 2 1)/4, 2 is (1 4 6 4 1)/16.
    denoise_vertical : float
        Share v of that blur along columns: v (blur) + (1 - v) (no blur).
    denoise_threshold_codes : float or None
        T: a difference d of Y' counts as d exp(-d^2 / 2 T^2) in the blur; as d if T is None.
    ycbcr_range : "full" or "limited"
        Of "yuyv", BT.601: Y' on 0 to 255, or on 16 to 235.
    chroma_taps : 3 floats
        Of "yuyv": weights of columns 2k - 1, 2k and 2k + 1 in chroma sample k.
    mosaic_phase : (du, dv)
        Red of a processed image lies where u + du and v + dv are even: a sensor that is read out mirrored has 1 for 0.
    """

    name: str
    mosaic: Literal["bayer", "mono"]
    exposure_s: float
    shot_noise: bool
    full_well_e: float
    read_noise_e: float
    row_noise_e: float
    prnu: float
    dsnu_e: float
    dark_e_per_s: float
    dn_per_e: float
    black_level_dn: float
    top_dn: int
    output: Literal["electrons", "raw", "srgb8", "yuyv", "mjpeg"]
    white_balance: tuple[float, float, float]
    colour_matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    sharpen_amount: float
    jpeg_quality: int
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"]
    jpeg_qtables: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    transfer_function: Literal["srgb", "rec709", "table"] = "srgb"
    transfer_points: tuple[tuple[float, float], ...] | None = None
    denoise_luma: float = 0.0
    denoise_chroma: float = 0.0
    denoise_reach_px: int = 1
    denoise_vertical: float = 1.0
    denoise_threshold_codes: float | None = None
    ycbcr_range: Literal["full", "limited"] = "full"
    chroma_taps: tuple[float, float, float] = (0.25, 0.5, 0.25)
    mosaic_phase: tuple[int, int] = (0, 0)

    @property
    def saturation_e(self) -> float:
        """Electrons at which a pixel carries no more information: full well or last code, whichever comes first."""
        return min(self.full_well_e, (self.top_dn - 0.5 - self.black_level_dn) / self.dn_per_e)

    @property
    def full_from_e(self) -> float:
        """Reading, electrons, from which on a pixel may be full, though noise that is added later hides it.

        5 deviations of read noise and DSNU, and half a code, below the full well; and as far below the last code. The
        well may lie there, too, when frames have not shown where it is, and a full pixel then reads a code less.
        """
        return min(self.full_well_e - 0.5 / self.dn_per_e, self.saturation_e) - 5.0 * math.hypot(
            self.read_noise_e, self.dsnu_e
        )


def sensor_card(preset: str = "bayer-raw", **changes: Any) -> SensorCard:
    """Card of a preset, with changes: ``sensor_card("mono-raw", analogue_gain=4.0)``.

    Raises
    ------
    SensorError
        If there is no such preset, or a change is not allowed.
    """
    return card_of(sensor(preset, **changes))


def presets_of(*outputs: str) -> tuple[str, ...]:
    """Names of the presets with one of these outputs; of all that end in pixels, if none is given."""
    known = preset_outputs().items()
    return tuple(name for name, output in known if (output in outputs if outputs else output != "electrons"))


def card_of(s: Sensor) -> SensorCard:
    """Card of a sensor."""
    return SensorCard(**{name: getattr(s, name) for name in SensorCard.__dataclass_fields__ if name != "mosaic_phase"})
