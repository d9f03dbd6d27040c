"""Verdict on a calibration in one sentence, and a picture of the mirror's outline with its residuals enlarged.

Three marks. "bad": the data contradict each other or the priors beyond chance. "doubtful": something unusual that a
person should look at. "good": neither. Parameters that only the prior knows are named under every mark.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.special import chdtrc

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.files import write_bytes
from phibench.estimator.calibration.bundle import Bundle
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.estimator.outline.limb_image import planes_of
from phibench.estimator.outline.outline import SECTORS, Outline
from phibench.estimator.outline.outline_start import grey
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
_P = (0.01, 1e-4)  # probability of a larger chi2: below the first doubtful, below the second bad
_FAR_SIGMAS = (3.0, 5.0)  # largest correction over its prior sigma, of 13: by chance in 3 % and in 1e-5 of all rigs
_ARC = 0.75  # an outline is refused below 0.6
_SHIFT_PX = 0.4  # rms over sectors; in `lab` MJPEG frames have 0.18 px, raw ones 0.12 px, layers 0.05 px
_ONLY_PRIOR = 0.9  # of the prior's sigma is left: the data say next to nothing
_LONGEST_PX, _FONT_PX = 45.0, 18
_GAINS = (5000.0, 2000.0, 1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0)
_FOUND, _RESIDUAL, _UNUSED = (0, 255, 0), (255, 225, 0), (150, 150, 150)


@dataclass(frozen=True)
class Verdict:
    """Mark of a calibration.

    Attributes
    ----------
    mark : str
        "good", "doubtful" or "bad".
    reasons : tuple of str
        What speaks against it, the worst first; nothing for a good one.
    numbers : str
        chi2 and residuals.
    only_prior : tuple of str
        Parameters of which the data say next to nothing.
    """

    mark: str
    reasons: tuple[str, ...]
    numbers: str
    only_prior: tuple[str, ...]

    def __str__(self) -> str:
        why = f" ({'; '.join(self.reasons)})" if self.reasons else ""
        prior = f"; known from the prior only: {', '.join(self.only_prior)}" if self.only_prior else ""
        return f"calibration {self.mark}{why}: {self.numbers}{prior}"


def verdict_of(bundle: Bundle, prior: Array, outlines: list[Outline]) -> Verdict:
    """Judge a calibration.

    Parameters
    ----------
    bundle
    prior : shape (p,)
        Standard deviations that the fit began with.
    outlines : of the images that it used
    """
    p = float(chdtrc(bundle.degrees, bundle.chi2)) if bundle.degrees > 0 else 1.0
    with np.errstate(all="ignore"):
        far = np.nan_to_num(np.abs(bundle.values) / prior)
        left = np.sqrt(np.diag(bundle.covariance)) / prior
    worst, arc = int(np.argmax(far)), min(one.arc for one in outlines)
    shift_px = max(one.shift_rms_px for one in outlines)
    faults = [
        (_level(-np.log(max(p, 1e-300)), *(-np.log(_P))), f"chi2 is too large, p = {p:.1e}"),
        (_level(far[worst], *_FAR_SIGMAS), f"{PARAMETERS[worst]} is corrected by {far[worst]:.1f} prior sigmas"),
        (_level(-arc, -_ARC), f"only {100.0 * arc:.0f} % of an outline could be used"),
        (_level(shift_px, _SHIFT_PX), f"an outline is off by {shift_px:.2f} px rms: another mirror, or a bad frame"),
    ]
    faults = sorted((fault for fault in faults if fault[0]), key=lambda fault: -fault[0])
    numbers = (
        f"chi2 {bundle.chi2:.1f} for {bundle.degrees} degrees of freedom (p = {p:.2g}), "
        f"outline residual {shift_px:.3f} px rms over {100.0 * arc:.0f} % of it"
    )
    only = tuple(n for n, x, s in zip(PARAMETERS, left, prior, strict=True) if s > 0.0 and x > _ONLY_PRIOR)
    mark = (GOOD, DOUBTFUL, BAD)[max((level for level, _ in faults), default=0)]
    return Verdict(mark, tuple(text for _, text in faults), numbers, only)


def write_overlay(
    path: Path, image: NDArray[Any], card: SensorCard | None, nominal: Rig, outline: Outline, title: str = ""
) -> Path:
    """Draw the outline that was found and its residuals, enlarged, onto a frame; PNG, written atomically.

    Parameters
    ----------
    path
    image, card : see `limb_image.planes_of`
    nominal : Rig
    outline : Outline, found in the image
    title : str
        First line of the legend.
    """
    picture = Image.fromarray(visible_picture(image, card)).convert("RGB")
    legend = draw_outline(picture, outline.rig(nominal), outline)
    draw_legend(picture, (title, *legend) if title else legend)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return write_bytes(path, buffer.getvalue())


def draw_outline(picture: Image.Image, rig: Rig, outline: Outline) -> tuple[str, ...]:
    """Draw an outline and its residuals into an RGB picture; `rig` has the sphere where the outline is.

    Returns
    -------
    tuple of str
        Lines of the legend.
    """
    draw = ImageDraw.Draw(picture)
    rim = rig.outline_px(6 * SECTORS)
    shift = outline.shifts_px[_sector_of(rig, rim)]
    gain = _gain(shift)
    outwards = rim - rim.mean(axis=0)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    _line(draw, rim, np.full(len(rim), True), _FOUND)
    _line(draw, rim, np.isnan(shift), _UNUSED, width=3)
    _line(draw, rim + gain * np.nan_to_num(shift)[:, None] * outwards, np.isfinite(shift), _RESIDUAL, width=2)
    return ("green: outline found", f"yellow: residual x {gain:g}", "grey: not used")


def draw_legend(picture: Image.Image, lines: Sequence[str]) -> None:
    """Write lines into the lower left corner of an RGB picture."""
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(_FONT_PX)
    corner, text = (8, picture.height - 8), "\n".join(lines)
    draw.rectangle(draw.multiline_textbbox(corner, text, font, anchor="ld", spacing=6), fill=(0, 0, 0))
    draw.multiline_text(corner, text, (255, 255, 255), font, anchor="ld", spacing=6)


def _level(value: float, *limits: float) -> int:
    """Number of limits that a value is above."""
    return sum(bool(value > limit) for limit in limits)


def _gain(shift_px: Array) -> float:
    """Round factor by which the largest residual becomes some ten pixels long."""
    largest = float(np.nanmax(np.abs(shift_px))) if np.isfinite(shift_px).any() else 0.0
    return next((gain for gain in _GAINS if gain * largest <= _LONGEST_PX), _GAINS[-1])


def _sector_of(rig: Rig, uv_px: Array) -> NDArray[np.int64]:
    """Sector of `Outline.shifts_px` of each pixel on the outline."""
    axis = rig.sphere_in_camera_m / np.linalg.norm(rig.sphere_in_camera_m)
    rays = rig.camera.rays(uv_px)
    across = rays - (rays @ axis)[:, None] * axis
    turn = (np.arctan2(across[:, 1], across[:, 0]) + np.pi) / (2.0 * np.pi)
    return np.floor(turn * SECTORS).astype(np.int64) % SECTORS


def _line(draw: ImageDraw.ImageDraw, uv_px: Array, show: NDArray[np.bool_], colour: Any, width: int = 1) -> None:
    """Closed line through pixels, where both ends of a piece are shown."""
    for k in range(len(uv_px)):
        if show[k - 1] and show[k]:
            draw.line((*uv_px[k - 1], *uv_px[k]), fill=colour, width=width)


def visible_picture(image: NDArray[Any], card: SensorCard | None) -> NDArray[np.uint8]:
    """8-bit picture of a frame or a layer, without colours where it has to be developed first."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    level = grey(planes_of(image, card))
    white = max(float(np.percentile(level, 98.0)), 1e-300)
    return np.rint(255.0 * np.clip(0.8 * level / white, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
