"""Built-in method `chain_fit`: each spot fitted in a processed image through the camera's own chain; its likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status, describe
from phibench.estimator.interface import Answer, Box, Pair, Spot
from phibench.estimator.methods.likelihood_maps import SpotLikelihood, claimed_px2, pixels_likelihood, window_likelihood
from phibench.estimator.methods.spot_search import (
    at_detection,
    box_around,
    box_at,
    measured_twice,
    once,
    pair_blur,
    pair_detection,
    seen_depth_m,
    square_around,
    trusted_hints,
)
from phibench.estimator.processed.fit_processed_images import (
    code_data,
    codes_are_independent,
    first_fit,
    fit_jpeg,
    fit_srgb,
    fit_yuyv,
    spot_window,
)
from phibench.estimator.processed.inverse_processing import electrons_before_chroma_loss, mean_unprocessed_electrons
from phibench.estimator.processed.quasi_score import CoefficientWindow
from phibench.estimator.spots.camera_codes import mcu_px
from phibench.estimator.spots.detect import Detection
from phibench.estimator.spots.fit_raw import MISFIT_SIGMAS, SpotData, SpotFit
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.estimator.spots.raw_pixels import (
    Background,
    PatternNoise,
    background_of,
    noise_before_rounding,
    outside_spot,
)
from phibench.scenes.frames import Array

_SIDE_PX = 17  # of the square whose codes are fitted
_AROUND_PX = 21  # of the box whose units a likelihood is made of
_FLAT_CHI2 = 1.5  # below it one level per filter describes the room
_MOST_CHI2 = 30.0  # beyond it the light around the spot is not what the model says


def chain_fit(pair: Pair) -> Answer:
    """Fit both spots where `detect` sees them.

    The blur is what the rig predicts (`spot_blur`), with the beam's size once the distance is known. The room behind
    comes from the laser-off frames where they are there, otherwise from what surrounds the spot. A misfit above 1 per
    degree of freedom widens the covariance by as much. That of a faint spot is its posterior's, about the fit's place.
    """
    if pair.card.output not in PROCESSED:
        missing = Spot.missing(f"chain_fit needs srgb8, yuyv or mjpeg images, not {pair.card.output}")
        return Answer(missing, missing)
    return once(pair, "chain_fit", _fitted)


def _fitted(pair: Pair) -> Answer:
    detections = pair_detection(pair)
    hint_down, hint_up = trusted_hints(pair, detections)

    def measure(depth_m: float | None) -> Answer:
        return Answer(
            _spot_or_place(pair, "down", detections.down, hint_down, depth_m),
            _spot_or_place(pair, "up", detections.up, hint_up, depth_m),
        )

    depth_m = None
    if detections.down is not None and detections.up is not None:  # to 0.2 px, enough for the beam's size
        depth_m = seen_depth_m(pair, Answer(Spot(detections.down.uv_px), Spot(detections.up.uv_px)))
    return measured_twice(measure, pair) if depth_m is None else measure(depth_m)


def _spot_or_place(pair: Pair, position: str, found: Detection | None, hint: Box | None, depth_m: float | None) -> Spot:
    """Fit; or, of a spot that was seen but gives no fit there, the place of the matched filter, without covariance."""
    near = None if found is None else found.uv_px
    return at_detection(found, _spot(pair, position, box_around(found, pair.images[position]) or hint, depth_m, near))


def _spot(pair: Pair, position: str, box: Box | None, depth_m: float | None, near: tuple[float, float] | None) -> Spot:
    if box is None:
        return Spot.missing("no spot found")
    shape = pair.images[position].shape
    region = _region(box, pair.card, shape)
    origin = np.array([[region.u0_px, region.v0_px]])
    on, dark = _parts(pair, position, region)
    background = None if dark is None else _background(dark, None, origin, pair.card)
    lens, model = SpotBlur(pair.rig.camera.blur_sigma_px), SpotModel(_response(pair))
    start = first_fit(on, origin, pair.card, lens, model.response, background, near)[0, :2] + origin[0]
    blur = pair_blur(pair, start, depth_m)

    def answer(fit: SpotFit) -> Spot:
        return _answer(fit, lambda place: spot_likelihood(pair, position, place, depth_m))

    if pair.card.output == "srgb8":
        return answer(_srgb(pair, position, start, blur, model, near))
    if background is None:
        known = outside_spot(start[None], origin, (region.height_px, region.width_px))
        background = _background(on, known, origin, pair.card)
    if pair.card.output == "yuyv":
        return answer(fit_yuyv(on, origin, pair.card, blur, model, background, near_px=near))
    size = (shape[1], shape[0])
    return answer(fit_jpeg(on, origin, pair.card, blur, model, background, size_px=size, near_px=near))


def _region(box: Box, card: SensorCard, shape: tuple[int, ...]) -> Box:
    """Whole units about a box, and one more on each side."""
    down, across = mcu_px(card.jpeg_subsampling)
    u0, u1 = _grown(box.u0_px, box.u0_px + box.width_px, across, shape[1])
    v0, v1 = _grown(box.v0_px, box.v0_px + box.height_px, down, shape[0])
    return Box(u0, v0, u1 - u0, v1 - v0)


def _grown(first: int, last: int, unit: int, size: int) -> tuple[int, int]:
    return max((first // unit - 1) * unit, 0), min((-(-last // unit) + 1) * unit, size // unit * unit)


def _parts(pair: Pair, position: str, box: Box) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Part of all frames of an image, shape (1, f, h, w, c), and of those with the laser off."""
    off = f"{position}_off"
    rows, columns = box.slices
    on, dark = (pair.stack(name)[None, :, rows, columns] if pair.count(name) else None for name in (position, off))
    assert on is not None, "a pair has both positions"
    return on, dark


def _srgb(
    pair: Pair, position: str, start: Array, blur: SpotBlur, model: SpotModel, near: tuple[float, float] | None
) -> SpotFit:
    """Fit a square of 17 x 17 pixels about the start."""
    card, square = pair.card, square_around(start, pair.images[position].shape, _SIDE_PX)
    origin = np.array([[square.u0_px, square.v0_px]])
    on, dark = _parts(pair, position, square)
    own = codes_are_independent(card) and on.shape[1] == 1

    if dark is None:
        flat = fit_srgb(on, origin, card, blur, model, near_px=near)
        if flat.chi2[0] < _FLAT_CHI2:
            return flat
        known = outside_spot(start[None], origin, on.shape[2:4])
        background = _background(on, known, origin, card, own)
    else:
        background = _background(dark, None, origin, card, own)
    behind, extra_e2 = replace(model, background_e=background.mean_e), float(np.median(background.variance_e2))
    return fit_srgb(on, origin, card, blur, behind, extra_e2=extra_e2, background=background, near_px=near)


def _background(
    frames: NDArray[Any], known: Array | None, origin: NDArray[np.int64], card: SensorCard, own: bool = False
) -> Background:
    """Room in a region, of frames (1, f, h, w, c) with the laser off, or of what is `known` of those with it on.

    For the law of a single frame's `own` codes, which counts the pattern of all its light itself.
    """
    seen, rounding = mean_unprocessed_electrons(frames, origin, card)
    x = electrons_before_chroma_loss(seen, origin, card)
    # the converter rounds each frame; codes of 8 bits are counted apart, as `rounding`
    variance = noise_before_rounding(card, not own).variance_e2(x) + 1.0 / (12.0 * card.dn_per_e**2)
    everywhere = np.ones(x.shape) if known is None else known
    pattern = None if own else PatternNoise.of(card)
    background = background_of(x, variance / frames.shape[1] + rounding, everywhere, pattern)
    return replace(background, image=frames) if known is None else background


def _response(pair: Pair) -> tuple[float, float, float]:
    r, g, b = pair.rig.camera.detector.laser_filter_response
    return r, g, b


def _answer(fit: SpotFit, likelihood: Callable[[Spot], SpotLikelihood | None]) -> Spot:
    if fit.status[0] != Status.OK:
        return Spot.missing(describe(int(fit.status[0])))
    if fit.chi2[0] > _MOST_CHI2:
        return Spot.missing(f"what is there is no spot: misfit {fit.chi2[0]:.1f}")
    u, v = (float(x) for x in fit.uv_px[0])
    worse = fit.covariance_px2[0] * max(1.0, float(fit.chi2[0]))
    c = claimed_px2(fit.uv_px[0], worse, lambda: likelihood(Spot((u, v))))
    own = fit.misfit_px2[0]  # of pixels that are fitted one by one; a light of another shape misfits on few of them
    if c is not None and fit.chi2[0] > 1.0 + MISFIT_SIGMAS * math.sqrt(2.0) / _SIDE_PX:
        c = max(c, np.where(np.isfinite(own), own, 0.0), key=np.trace)
    return Spot((u, v), None if c is None else ((float(c[0, 0]), float(c[0, 1])), (float(c[1, 0]), float(c[1, 1]))))


def spot_likelihood(pair: Pair, position: str, spot: Spot, depth_m: float | None) -> SpotLikelihood | None:
    """Likelihood of one image about a spot that `chain_fit` has found; None where its outputs say nothing."""
    uv = np.array(spot.uv_px, float)
    outputs = spot_outputs(pair, position, uv, depth_m)
    return pixels_likelihood(outputs, uv) if isinstance(outputs, SpotData) else window_likelihood(*outputs)


def spot_outputs(
    pair: Pair, position: str, uv: Array, depth_m: float | None
) -> SpotData | tuple[CoefficientWindow, Array, Array]:
    """Outputs of one image about a spot at (u, v), with their model: what a fit and a likelihood are made of.

    Codes where those of a single frame are independent (`codes_are_independent`); else a window, a start and the
    window's corner.
    """
    card, shape = pair.card, pair.images[position].shape
    own = codes_are_independent(card) and pair.count(position) == 1
    box = square_around(uv, shape, _SIDE_PX) if own else box_at((uv[0], uv[1]), shape, _AROUND_PX)
    region = box if own else _region(box, card, shape)
    origin, (on, dark) = np.array([[region.u0_px, region.v0_px]]), _parts(pair, position, region)
    if dark is None:
        background = _background(on, outside_spot(uv[None], origin, on.shape[2:4]), origin, card, own)
    else:
        background = _background(dark, None, origin, card, own)
    blur, model = pair_blur(pair, uv, depth_m), SpotModel(_response(pair))
    if own:
        behind = replace(model, background_e=background.mean_e)
        extra_e2 = float(np.median(background.variance_e2))
        return code_data(on[:, 0], origin, card, blur, behind, extra_e2=extra_e2)
    return spot_window(on, origin, uv, card, blur, model, background, (shape[1], shape[0]))
