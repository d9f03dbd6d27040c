"""Tests of how a pair's pixels were processed: Bayer phase, bilinear demosaicing, an earlier JPEG; result `ChainTest`.

A kind of file says little of what a camera did. Three questions are put to the pixels.

* Interpolation: bilinear demosaicing makes two of three colours of a pixel the mean of its neighbours, to half a code.
  So the residual tells where the mosaic begins, and whether this chain made the pixels at all.
* JPEG: coefficients of 8 x 8 blocks of a decoded JPEG lie on a comb of its quantiser's steps.
* Phase of what is compressed: the likelihood of both spots' outputs under the four phases.

DN are asked for their mosaic and for the likeness of their noise (`raw_frames`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dctn
from scipy.ndimage import minimum_filter
from scipy.special import log_ndtr

from phibench.calibration.captures.pair_mistakes import relit_note, relit_positions
from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.calibration.captures.picture_files import Photo
from phibench.calibration.captures.raw_frames import MOST_LIKENESS, PATTERNS, Phase, neighbour_likeness, raw_phase
from phibench.calibration.captures.stored_colours import stored_with_less_note
from phibench.datasets.common.camera_pictures import Subsampling
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.interface import Image, Pair
from phibench.estimator.methods.chain_fit import spot_outputs
from phibench.estimator.processed.chain_model import UNIT_MATRIX
from phibench.estimator.processed.quasi_score import CoefficientWindow, fit_window
from phibench.estimator.spots.camera_codes import light_of, quantisation, tone_of
from phibench.estimator.spots.detect import detect
from phibench.estimator.spots.fit_raw import SpotData
from phibench.estimator.spots.image_planes import ImageError, through_jpeg
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array

PairOf = Callable[[PairPhotos, SensorCard], Pair]

_SIDE_PX = 1024  # of the middle of a picture that is looked at
_PIXELS = 1000  # that must say something
_CUT_CODES = 4.0  # of a residual: beyond it one counts no more
_DIFFERENT = 1.02  # rms of the second phase's residual over the first's, from which on the first is the mosaic's
_ROUNDED = 0.39  # codes: rms that rounding alone leaves, 0.34, or 0.38 through another curve
_CHANGED = 0.5  # codes: rms from which on a picture is not one of those that rounding alone has changed


# -- interpolation -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Interpolation:
    """Residuals of bilinear interpolation, rms in codes, by phase; empty where too few pixels are usable."""

    residual_codes: Mapping[Phase, float]

    @property
    def phase(self) -> Phase | None:
        """The mosaic's phase; None where two are alike."""
        if not self.residual_codes:
            return None
        first, second = sorted(self.residual_codes, key=lambda phase: self.residual_codes[phase])[:2]
        return first if self.residual_codes[second] > _DIFFERENT * self.residual_codes[first] else None

    @property
    def exact(self) -> bool:
        """The pixels were interpolated so, and not changed since."""
        return bool(self.residual_codes) and min(self.residual_codes.values()) < _ROUNDED


def interpolation(images: Sequence[Image], card: SensorCard) -> Interpolation:
    """Residuals of pictures of R, G, B of 8 bits, together."""
    squares = [found for image in images if (found := _squares(_middle(image), card)) is not None]
    if not squares:
        return Interpolation({})
    means = np.sqrt(np.mean(squares, axis=0))
    return Interpolation(dict(zip(PATTERNS, means.tolist(), strict=True)))


def _middle(image: Image) -> Image:
    v, u = (max((size - _SIDE_PX) // 4 * 2, 0) for size in image.shape[:2])
    return image[v : v + _SIDE_PX, u : u + _SIDE_PX]


def _squares(codes: Image, card: SensorCard) -> Array | None:
    """Mean squared residual of each phase, shape (4,); None where too little of the picture says anything."""
    light = light_of(np.arange(256) / 255.0, card)[codes]
    rows = 0.5 * (light[:-2] + light[2:])
    above, beside = rows[:, 1:-1], 0.5 * (light[1:-1, :-2] + light[1:-1, 2:])
    means = {"above": above, "beside": beside, "cross": 0.5 * (above + beside)}
    means["corners"] = 0.5 * (rows[:, :-2] + rows[:, 2:])
    usable = minimum_filter(((codes > 2) & (codes < 253)).all(axis=-1), 3)[1:-1, 1:-1]
    if usable.sum() < _PIXELS or codes[1:-1, 1:-1][usable].std() < 1.0:
        return None
    inner = codes[1:-1, 1:-1].astype(float)

    def residual(way: str, colour: int) -> Array:
        off = inner[..., colour] - 255.0 * tone_of(means[way][..., colour], card)
        return np.minimum(np.abs(off), _CUT_CODES) ** 2

    ways = [("above", 0), ("beside", 0), ("corners", 0), ("above", 2), ("beside", 2), ("corners", 2), ("cross", 1)]
    squares = {way: residual(*way) for way in ways}
    v, u = np.indices(usable.shape) + 1
    result = []
    for du, dv in PATTERNS:
        row, column = (v + dv) % 2, (u + du) % 2
        places = {  # of the mosaic's own filter: what the other two colours were made of
            ("beside", 0): (row == 0) & (column == 1),
            ("above", 0): (row == 1) & (column == 0),
            ("corners", 0): (row == 1) & (column == 1),
            ("above", 2): (row == 0) & (column == 1),
            ("beside", 2): (row == 1) & (column == 0),
            ("corners", 2): (row == 0) & (column == 0),
            ("cross", 1): row == column,
        }
        result.append(np.mean([squares[way][place & usable].mean() for way, place in places.items()]))
    return np.array(result)


# -- an earlier JPEG ---------------------------------------------------------------------------------------------------

_BLOCKS = 4000  # with the most detail
_LEAST_STEP = 3.0  # codes are whole: finer steps leave no comb
_COMB = 0.02  # mean square of the coefficients' rest, in steps squared; 1/12 without a comb
_ALIKE = 10  # in quality, beyond which the steps of one are those of a finer JPEG
_COUNT = 300  # coefficients that must say so
_SAME_CODES = 0.4  # rms by which the picture differs from itself through the same JPEG once more


def jpeg_behind(pixels: Image) -> tuple[int, Subsampling] | None:
    """Quality of libjpeg and subsampling of a JPEG that a picture, shape (H, W, 3), was decoded from; None if of none.

    The blocks must begin at the picture's first pixel.
    """
    quality = comb_quality(pixels)
    if quality is None:
        return None
    samplings: tuple[Subsampling, ...] = ("4:2:0", "4:2:2", "4:4:4")
    off = {sampling: _changed_codes(pixels, quality, sampling) for sampling in samplings}
    best = min(off, key=lambda sampling: off[sampling])
    return (quality, best) if off[best] < _SAME_CODES else None


def _changed_codes(pixels: Image, quality: int, sampling: Subsampling) -> float:
    """Change of a picture by the same JPEG once more, rms in codes."""
    corner = _middle(pixels)[:512, :512]
    corner = np.ascontiguousarray(corner[: corner.shape[0] // 16 * 16, : corner.shape[1] // 16 * 16])
    again = through_jpeg(corner, replace(sensor_card("mjpeg"), jpeg_quality=quality, jpeg_subsampling=sampling))
    return float(np.sqrt(np.mean((again.astype(float) - corner) ** 2)))


def comb_quality(pixels: Image) -> int | None:
    """Quality of libjpeg on whose steps the luma's coefficients lie best, of the coarsest that will do and its like."""
    h, w = (size // 8 * 8 for size in pixels.shape[:2])
    luma = pixels[:h, :w].astype(float) @ np.array(LUMA)  # JPEG's Y
    blocks = luma.reshape(h // 8, 8, w // 8, 8).swapaxes(1, 2).reshape(-1, 8, 8)
    # a code that is cut has no coefficients of a JPEG
    lit = blocks[(blocks.min(axis=(1, 2)) > 8.0) & (blocks.max(axis=(1, 2)) < 247.0)]
    if len(lit) < 16:
        return None
    c = dctn(lit[np.argsort(lit.var(axis=(1, 2)))[-_BLOCKS:]], axes=(1, 2), norm="ortho").reshape(-1, 64)[:, 1:]
    rests: dict[int, float] = {}
    for quality in range(10, 100):
        step = quantisation(quality)[0].ravel()[1:]
        in_steps = c / step
        used = (np.abs(in_steps) > 0.5) & (step >= _LEAST_STEP)
        if used.sum() < _COUNT:
            continue
        rest = float(np.mean((in_steps - np.rint(in_steps))[used] ** 2))
        if rest < _COMB and quality <= min(rests, default=quality) + _ALIKE:
            rests[quality] = rest
    return min(rests, key=lambda quality: rests[quality]) if rests else None


# -- likelihood of spots -----------------------------------------------------------------------------------------------

_LEAST_LOG = -12.0  # of one output's chance: one that is impossible is an outlier
_SHARED = 0.5  # of the evidence: outputs of one window are not independent
_PRIOR = {True: 0.7, False: 0.1}  # chance that a camera is read out from red, and of each other phase
_LEFT_OUT = 5e-3  # chance of a phase below which it is not followed: sigma does not feel it
_MOST_SURPRISE = 6.0  # standard deviations; drawn pairs have 1 or less


def phase_weights(pair: Pair) -> tuple[dict[Phase, float], float]:
    """Chances of the phases of a processed pair by its spots' outputs, the largest first, and the best one's surprise.

    Phases below 0.005 are left out. The surprise is how many standard deviations the outputs are less likely than those
    of the model itself.
    """
    detection = detect(pair)
    logs = {phase: math.log(_PRIOR[phase == (0, 0)]) for phase in PATTERNS}
    surprises = dict.fromkeys(PATTERNS, 0.0)
    for position, spot in (("down", detection.down), ("up", detection.up)):
        if spot is None:
            continue
        told = {phase: _spot_chances(pair, position, spot.uv_px, phase) for phase in PATTERNS}
        for phase, one in told.items():
            if one is not None and all(told.values()):
                logs[phase] += _SHARED * one[0]
                surprises[phase] = max(surprises[phase], one[1])
    chances = {phase: math.exp(value - max(logs.values())) for phase, value in logs.items()}
    whole = sum(chances.values())
    kept = {phase: chance / whole for phase, chance in chances.items() if chance / whole > _LEFT_OUT}
    ordered = dict(sorted(kept.items(), key=lambda item: -item[1]))
    return ordered, surprises[next(iter(ordered))]


def _spot_chances(pair: Pair, position: str, uv_px: tuple[float, float], phase: Phase) -> tuple[float, float] | None:
    """Logarithm of the chance of a spot's outputs at their best place, and their surprise; None without a fit."""
    card = replace(pair.card, mosaic_phase=phase)
    outputs = spot_outputs(replace(pair, card=card), position, np.array(uv_px), None)
    if isinstance(outputs, SpotData):
        return None
    window, start, _ = outputs
    theta = fit_window(window, start[None]).theta
    if not np.isfinite(theta).all():
        return None
    logs, mean, variance = _log_chances(window, theta)
    return float(logs.sum()), float((mean - logs).sum() / np.sqrt(max(variance.sum(), 1.0) / _SHARED))


_REACH = 6  # steps on either side that an output's chances are counted over


def _log_chances(window: CoefficientWindow, theta: Array) -> tuple[Array, Array, Array]:
    """Logarithm of each output's chance, a Gaussian within one step; its mean and variance under the model."""
    inputs, step = window.inputs(theta), window.model.step
    sigma = np.sqrt(np.einsum("rn,rn->n", inputs.factor, inputs.factor) + inputs.own)
    around = np.arange(-_REACH, _REACH + 1)[:, None] * np.maximum(step, np.rint(0.7 * sigma / step) * step)
    middle = np.rint(inputs.mean / step) * step
    logs = _log_chance(window.z, inputs.mean, sigma, step)
    every = _log_chance(middle + around, inputs.mean, sigma, step)
    weight = np.exp(every)
    weight /= weight.sum(axis=0)
    mean = np.sum(weight * every, axis=0)
    return logs, mean, np.sum(weight * (every - mean) ** 2, axis=0)


def _log_chance(z: Array, mean: Array, sigma: Array, step: Array) -> Array:
    low, high = ((z + side * step - mean) / sigma for side in (-0.5, 0.5))
    low, high = np.where(low > 0.0, -high, low), np.where(low > 0.0, -low, high)  # the tail whose logarithm is exact
    larger, smaller = log_ndtr(high), log_ndtr(low)
    # a step far narrower than its noise leaves the logarithm of 0
    return np.maximum(larger + np.log1p(-np.exp(np.minimum(smaller - larger, -1e-12))), _LEAST_LOG)


# -- all of it ---------------------------------------------------------------------------------------------------------

_UNKNOWN_PX = 0.05  # what another interpolation than the bilinear one adds to a place, standard deviation
_LOST_PX = 0.25  # what unknown scaling or smoothing adds
_SEEN_RELIT = 0.02  # relative change of DN, black included, that makes neighbours alike
_OTHER_THING = ", or a thing of the room was taken for the spot: give pictures with the laser off, too"
_OWN_FILE = "give the camera's own file, or its frames with a sensor file"


@dataclass(frozen=True)
class ChainTest:
    """Outcome of the tests.

    Attributes
    ----------
    photos : PairPhotos
        As they are to be taken: a decoded JPEG has its tables.
    phases : chances of the phases, the largest first
    added_px : float
        Standard deviation to add to each coordinate of a spot.
    note, doubt : str
        Sentences; empty if there is none.
    by_spots : bool
        The doubt is of the spots alone, and a beam that is torn gives it, too.
    of_light : bool
        The doubt is of the room's light, not of the chain.
    """

    photos: PairPhotos
    phases: Mapping[Phase, float]
    added_px: float = 0.0
    note: str = ""
    doubt: str = ""
    by_spots: bool = False
    of_light: bool = False


def chain_test(photos: PairPhotos, choice: Callable[[Photo], SensorCard], pair_of: PairOf) -> ChainTest:
    """Try the chain that the kind of file stands for.

    Parameters
    ----------
    photos : PairPhotos
    choice : callable
        Card of a picture.
    pair_of : callable
        Pair of pictures and a card.

    Raises
    ------
    ImageError
        If DN have another mosaic than the card's, or pictures were stored in different ways; in one sentence.
    """
    first = photos.down.on[0]
    if first.kind == "raw":
        return _of_raw(photos, choice(first), pair_of)
    if first.kind == "rgb":
        found = _one_jpeg(photos.all, choice(first))
        if found is None:
            return _of_codes(photos, choice(first))
        quality, sampling = found
        decoded = _as_jpeg(photos, quality, sampling)
        note = f"JPEG: the pixels are a decoded JPEG's of quality {quality}, {sampling}, and are fitted as such"
        return _of_outputs(decoded, choice(decoded.down.on[0]), pair_of, note)
    return _of_outputs(photos, choice(first), pair_of)


def _one_jpeg(photos: Sequence[Photo], card: SensorCard) -> tuple[int, Subsampling] | None:
    """JPEG that all pictures were decoded from; None if of none, or not of all for sure."""
    behind = [jpeg_behind(photo.pixels) for photo in photos]
    jpeg = next((found for found in behind if found is not None), None)
    as_made: list[Photo] = []
    changed: list[tuple[Photo, str]] = []
    unknown = False
    for photo, found in zip(photos, behind, strict=True):
        # a dark picture has no comb, but stays as it is in its own JPEG
        if jpeg is not None and (found == jpeg or _changed_codes(photo.pixels, *jpeg) < _SAME_CODES):
            changed.append((photo, f"is a decoded JPEG of quality {jpeg[0]}, {jpeg[1]}"))
            continue
        unknown = True
        residuals = interpolation([photo.pixels], card).residual_codes.values()
        if found is not None:
            raise _stored(photo, f"is a decoded JPEG of quality {found[0]}, {found[1]}", changed[0])
        if residuals and min(residuals) > _CHANGED:
            changed.append((photo, "was scaled, filtered or compressed since it was interpolated"))
        elif residuals and min(residuals) < _ROUNDED:
            as_made.append(photo)
    if as_made and changed and is_plain(card):
        raise _stored(as_made[0], "is as it was interpolated from its mosaic", changed[0])
    return None if unknown else jpeg


def _stored(photo: Photo, kind: str, other: tuple[Photo, str]) -> ImageError:
    return ImageError(
        f"pictures were stored or processed in different ways: {photo.path} {kind}, {other[0].path} {other[1]}; give "
        "all of them as the camera stores them"
    )


def _as_jpeg(photos: PairPhotos, quality: int, sampling: Subsampling) -> PairPhotos:
    tables = quantisation(quality)

    def of(group: Sequence[Photo]) -> tuple[Photo, ...]:
        return tuple(replace(photo, kind="jpeg", tables=tables, subsampling=sampling) for photo in group)

    down, up = (PositionPhotos(of(position.on), of(position.off)) for position in (photos.down, photos.up))
    return PairPhotos(down, up)


def _of_raw(photos: PairPhotos, card: SensorCard, pair_of: PairOf) -> ChainTest:
    images = pair_of(photos, card).images
    told = raw_phase(images)
    path = photos.down.on[0].path
    if told == "mono" and card.mosaic != "mono":
        raise ImageError(
            f"{path} has no colour filters: the spot is as bright on all four places of a mosaic; give a sensor file "
            'with preset = "mono-raw", --sensor'
        )
    if isinstance(told, tuple) and card.mosaic == "mono":
        raise ImageError(
            f"{path} has colour filters, {PATTERNS[told]}: the spot is bright on one of four places; the sensor file "
            "says mono-raw"
        )
    phase = told if isinstance(told, tuple) else (0, 0)
    note = _phase_note({phase: 1.0})
    if (likeness := neighbour_likeness(images)) > MOST_LIKENESS:
        # the room is left in laser on less laser off, too, where its light changed
        relit = next(relit_positions(pair_of(photos, card), _SEEN_RELIT), None)
        if relit is not None:
            return ChainTest(photos, {phase: 1.0}, _LOST_PX, note, relit_note(photos, *relit), of_light=True)
        doubt = (
            f"the noise of neighbouring pixels is alike (correlation {likeness:.2f}): the DN were smoothed, sharpened, "
            f"scaled or compressed, and sigma does not hold; {_OWN_FILE}"
        )
        return ChainTest(photos, {phase: 1.0}, _LOST_PX, note, doubt)
    return ChainTest(photos, {phase: 1.0}, note=note)


def _of_codes(photos: PairPhotos, card: SensorCard) -> ChainTest:
    images = [photo.pixels for photo in photos.all]
    tested = interpolation(images, card)
    phase = tested.phase
    if not tested.exact and (less := stored_with_less_note(images)):
        return ChainTest(
            photos, dict.fromkeys(PATTERNS, 0.25), _LOST_PX, doubt=f"{less}; sigma does not hold; {_OWN_FILE}"
        )
    if phase is not None:
        exact = tested.exact or not is_plain(card)
        least = min(tested.residual_codes.values())
        note = (
            ""
            if exact
            else (
                f"processing: not that of the preset, which leaves {least:.2f} codes unexplained; "
                f"{_UNKNOWN_PX:g} px are added to the spots' sigma"
            )
        )
        notes = "; ".join(text for text in (_phase_note({phase: 1.0}), note) if text)
        return ChainTest(photos, {phase: 1.0}, 0.0 if exact else _UNKNOWN_PX, notes)
    chances = dict.fromkeys(PATTERNS, 0.25)  # for the note alone: no phase was tested
    if not tested.residual_codes:
        return ChainTest(photos, {phase: _PRIOR[phase == (0, 0)] for phase in PATTERNS}, note=_phase_note(chances))
    doubt = (
        "the pixels do not show the mosaic that they were interpolated from: they were scaled, smoothed or compressed "
        f"since, and sigma does not hold; {_OWN_FILE}"
    )
    return ChainTest(photos, chances, _LOST_PX, doubt=doubt)


def _of_outputs(photos: PairPhotos, card: SensorCard, pair_of: PairOf, note: str = "") -> ChainTest:
    chances, surprise = phase_weights(pair_of(photos, card))
    doubts, by_spots = [], False
    quality = comb_quality(photos.down.on[0].pixels) if card.output == "mjpeg" else None
    if quality is not None and quality < card.jpeg_quality - 1:
        doubts.append(f"the JPEG holds another one, of quality {quality}, and sigma does not hold; {_OWN_FILE}")
    elif surprise > _MOST_SURPRISE:
        by_spots = True
        other = "" if photos.down.off and photos.up.off else _OTHER_THING
        doubts.append(
            f"the spots' codes are not such as the assumed processing gives, by {surprise:.0f} sigma: they were "
            f"scaled, sharpened or smoothed before{other}; {_OWN_FILE}"
        )
    added = _LOST_PX if doubts else 0.0
    notes = "; ".join(text for text in (note, _phase_note(chances)) if text)
    return ChainTest(photos, chances, added, notes, "; ".join(doubts), by_spots)


def _phase_note(chances: Mapping[Phase, float]) -> str:
    """Sentence on a mosaic that does not begin with red, or whose beginning is not sure; "" for one that does."""
    if set(chances) == {(0, 0)}:
        return ""
    if len(chances) == 1:
        return (
            f"mosaic: {PATTERNS[next(iter(chances))]}, as the pictures show; the sensor is read out mirrored or turned"
        )
    told = ", ".join(f"{PATTERNS[phase]} {100.0 * chance:.0f} %" for phase, chance in chances.items())
    return f"mosaic: {told}; the spots' sigma holds all of them"


def is_plain(card: SensorCard) -> bool:
    """Tell whether a card's chain keeps what was interpolated as it is: no sharpening, denoising or mixing."""
    return not (card.sharpen_amount or card.denoise_luma or card.denoise_chroma) and card.colour_matrix == UNIT_MATRIX
