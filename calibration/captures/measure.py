"""Measurement of D from a person's own pictures: their Bayer phase and processing, spots, rig, D with sigma, doubts.

The rig is that of the rig file with the corrections of a calibration file. Without one, the mirror's outline in these
very pictures corrects it, as far as an outline can, and the covariance is that of a rig measured by a ruler. Blur and
filters at the laser's line are those of the calibration's spots, or are fitted to these spots (`spot_shape`).

Several frames of a position are one pair of their means (`Pair.of_frames`). The fits weigh what the frames share: the
fixed pattern, the room, the steps of JPEG. The outline is that of the mean of raw frames, and of the first JPEG.

The test: both spots are images of one point. Four coordinates stand against three unknowns, so that the gap of the two
rays over its standard deviation, rig included, is chi^2 of one degree of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from phibench.calibration.captures.measurement_doubts import (
    DOUBTFUL_P,
    SeenSpot,
    apart_note,
    calibration_note,
    contradiction_note,
    moved_off_notes,
    other_size_note,
    rays_gap_note,
    too_far_note,
    unlike_spot_notes,
)
from phibench.calibration.captures.pair_mistakes import exchanged_colours_error, missing_spot_error, no_distance_error
from phibench.calibration.captures.pair_photos import (
    LARGEST_SIGMA,
    PairPhotos,
    PositionPhotos,
    frames_note,
    pair_of_photos,
    require_fitting,
)
from phibench.calibration.captures.picture_files import Photo, SensorChoice, sensor_choice
from phibench.calibration.captures.raw_frames import PATTERNS
from phibench.calibration.captures.rig_file import MeasuredRig, read_rig_file
from phibench.calibration.captures.spot_shape import (
    OUTLINE_SIGMA_PX,
    PRIOR_SIGMA,
    SHAPE,
    SpotPicture,
    SpotShape,
    fit_shape,
    seen_through,
    spot_pictures,
)
from phibench.calibration.captures.tested_chain import ChainTest, chain_test
from phibench.calibration.captures.turned_pictures import require_alike
from phibench.calibration.outline.outline import find_outline
from phibench.calibration.outline.outline_result import Outline, outlines_as_one
from phibench.calibration.rig.bundle import calibrate
from phibench.calibration.rig.calibration_file import Calibration, read_calibration
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.frames.sensor_file import SensorFile, read_sensor_file
from phibench.datasets.recipe.tables import MAX_STROKE_M, MIN_STROKE_M
from phibench.estimator.geometry.least_squares_depth import GeneralDepth, depth_general
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas, stroke_of
from phibench.estimator.geometry.status import Status, describe
from phibench.estimator.interface import Answer, Image, Pair, Spot
from phibench.estimator.methods.joint_fit import with_posteriors
from phibench.estimator.methods.registry import method_for
from phibench.estimator.methods.spot_search import SharedPair, joint_or_separate
from phibench.estimator.spots.detect import detect
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig


@dataclass(frozen=True)
class MeasureSetting:
    """Setting of a measurement: what is known beside the pictures.

    Attributes
    ----------
    known : MeasuredRig
    calibration : Calibration or None
    sensor : SensorFile or None
    stroke_sigma_m : float
        Of a single stroke, besides what the calibration says of all strokes.
    """

    known: MeasuredRig
    calibration: Calibration | None = None
    sensor: SensorFile | None = None
    stroke_sigma_m: float = 0.0


def read_setting(
    rig: Path, calibration: Path | None = None, sensor: Path | None = None, stroke_sigma_m: float = 0.0
) -> MeasureSetting:
    """Known numbers, read from their files.

    Raises
    ------
    DatasetError
        If a file will not do, or the calibration began with another rig than the rig file's; in one sentence.
    """
    known = read_rig_file(rig)
    held = None if calibration is None else read_calibration(calibration, known.rig)
    if not 0.0 <= stroke_sigma_m <= MAX_STROKE_M:
        raise DatasetError(f"the stroke's standard deviation is {stroke_sigma_m:g} m: must be 0 or above")
    return MeasureSetting(known, held, None if sensor is None else read_sensor_file(sensor), stroke_sigma_m)


@dataclass(frozen=True)
class Measurement:
    """Result for one pair.

    Attributes
    ----------
    depth : GeneralDepth
        Scalars: D, sigma, its parts, chi^2 and its probability.
    down, up : SeenSpot
    rig : Rig
        The corrected one.
    stroke_m : float
        The corrected one.
    outlines : tuple of Outline
        Of these pictures, found with the nominal rig; none where none was found.
    nominal : Rig
        As in the rig file.
    pair : Pair
        With the corrected rig and stroke.
    sensor : SensorChoice
    notes : tuple of str
        Sentences for the person: sensor, rig, frames, doubts.
    doubts : tuple of str
        Those of them on why D may be wrong by far more than its sigma says; none of a sound pair.
    """

    depth: GeneralDepth
    down: SeenSpot
    up: SeenSpot
    rig: Rig
    stroke_m: float
    outlines: tuple[Outline, ...] = field(repr=False)
    nominal: Rig = field(repr=False)
    pair: Pair = field(repr=False)
    sensor: SensorChoice
    notes: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def depth_m(self) -> float:
        """D."""
        return float(self.depth.depth_m)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of D, of all that is known to be uncertain."""
        return float(self.depth.sigma_m)


Told = Callable[[str], None]
"""Given each stage in words."""
_LOOKING = "no pair of spots: looking for the mistake"
_OTHER_UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2))
_USUAL_STROKE_M = 0.1  # of a rig of this kind, at least: less would be another unit


def measure(
    photos: PairPhotos, stroke_m: float, setting: MeasureSetting, told: Told = lambda stage: None
) -> Measurement:
    """Measure D.

    Parameters
    ----------
    photos : PairPhotos
    stroke_m : float
        As the person read it.
    setting : MeasureSetting
    told : callable
        Given each stage in words, before it begins: all together take some seconds.

    Raises
    ------
    DatasetError
        If a picture does not fit to the rig or the sensor, no spot is found, the positions are swapped, or the stroke
        contradicts the pictures; in one sentence.
    """
    if not MIN_STROKE_M <= stroke_m <= MAX_STROKE_M:
        meant = ((name, stroke_m * unit) for name, unit in _OTHER_UNITS if stroke_m * unit >= _USUAL_STROKE_M)
        advice = next((f"; if these are {name}, write {value:g}" for name, value in meant), "")
        allowed = f"allowed is {MIN_STROKE_M:g} to {MAX_STROKE_M:g} m, metres"
        raise DatasetError(f"a stroke of {stroke_m:g} m: {allowed}{advice}")
    if (sigma := setting.stroke_sigma_m) > LARGEST_SIGMA * stroke_m:
        raise DatasetError(
            f"a stroke of {stroke_m:g} m with a standard deviation of {sigma:g} m: allowed is a quarter of the stroke; "
            f"{sigma:g} mm are {1e-3 * sigma:g} m"
        )
    require_fitting(photos, setting.known.rig, setting.sensor)
    require_alike(photos.pictures_to_compare, setting.known.rig)
    told("trying what the files stand for")
    test = chain_of(photos, stroke_m, setting)
    if photos.down.on[0].kind == "raw" and (corner := next(iter(test.phases))) != (0, 0):
        inner, cut = _without(corner, photos, setting)
        return _shifted(measure(inner, stroke_m, cut, told), corner, photos, setting, test.note)
    return _measured(test, stroke_m, setting, told)


def chain_of(photos: PairPhotos, stroke_m: float, setting: MeasureSetting) -> ChainTest:
    """Chain of a pair's pictures, tried: see `chain_test`."""
    return chain_test(
        photos,
        lambda photo: sensor_choice(photo, setting.sensor).card,
        lambda group, card: pair_of_photos(group, stroke_m, setting.known, card),
    )


def _measured(test: ChainTest, stroke_m: float, setting: MeasureSetting, told: Told) -> Measurement:
    """Measurement with the phases of a test, which are in sigma where they are several."""
    photos, chosen = test.photos, sensor_choice(test.photos.down.on[0], setting.sensor)
    parts: list[tuple[_Fitted, float]] = []
    faults: list[DatasetError] = []
    for phase, chance in test.phases.items():
        stages = told if len(test.phases) == 1 else _told_of(PATTERNS[phase], told)
        try:
            card = replace(chosen.card, mosaic_phase=phase)
            # the outline hardly knows of the phase: that of the first is every other's
            seen = parts[0][0].limb if parts else None
            parts.append((_fitted(photos, stroke_m, setting, card, stages, seen), chance))
        except DatasetError as error:
            faults.append(error)
    if not parts:
        raise faults[0]
    found = parts[0][0]
    down, up = (
        _mixed([(measured.spots[name], chance) for measured, chance in parts], test.added_px) for name in POSITIONS
    )
    depth = depth_general(
        found.rig,
        found.stroke_m,
        down.uv_px,
        up.uv_px,
        down.covariance_px2,
        up.covariance_px2,
        found.covariance,
        setting.stroke_sigma_m,
    )
    if int(depth.status) != Status.OK:
        told(_LOOKING)
        raise no_distance_error(found.pair, photos, describe(int(depth.status)))
    if test.doubt and (fault := exchanged_colours_error(found.pair, photos)):
        raise fault
    gap, is_one = rays_gap_note(depth), float(depth.p_value) >= DOUBTFUL_P
    # through another chain a sound spot has another shape, too: the laser is not to blame
    torn = [] if test.doubt and not test.by_spots else unlike_spot_notes(found.pair, photos, {"down": down, "up": up})
    faults_of_spots = *torn, *moved_off_notes(found.pair, photos), _foreign(test)
    faults_of_spots += (found.doubt, apart_note(found.limb[0]), too_far_note(depth))
    notes = chosen.note, test.note, *found.notes, frames_note(photos), gap, *faults_of_spots
    doubts = "" if is_one else gap, *faults_of_spots
    said, doubted = (tuple(text for text in texts if text) for texts in (notes, doubts))
    rig, limb, nominal = found.rig, found.limb[0], setting.known.rig
    return Measurement(depth, down, up, rig, found.stroke_m, limb, nominal, found.pair, chosen, said, doubted)


def _told_of(pattern: str, told: Told) -> Told:
    return lambda stage: told(f"{stage}, as {pattern}")


_Limb = tuple[tuple[Outline, ...], str]
"""Outlines, and why there are none."""


@dataclass(frozen=True)
class _Fitted:
    """Spots and rig under one chain: both positions, covariance of `PARAMETERS`, and sentences."""

    pair: Pair
    spots: dict[str, SeenSpot]
    rig: Rig
    covariance: Array
    stroke_m: float
    limb: _Limb
    notes: tuple[str, ...]
    doubt: str


def _fitted(
    photos: PairPhotos,
    stroke_m: float,
    setting: MeasureSetting,
    card: SensorCard,
    told: Told,
    limb: _Limb | None = None,
) -> _Fitted:
    """Fit both spots; outlines are looked for, or are those of `limb`, with why there are none."""
    pair = pair_of_photos(photos, stroke_m, setting.known, card)
    if limb is None:
        told("looking for the mirror's outline")
        limb = _outlines(pair, setting.calibration is not None)
    outlines, missing = limb
    rig, covariance, values, note, doubt = _corrected(setting, outlines, missing)
    if not outlines:
        doubt = other_size_note(rig, _picture(pair, "down"), card)
    stroke = float(stroke_of(np.array(stroke_m), values))
    told("fitting the spots")
    seen = replace(pair, rig=with_blur_of(rig, outlines), stroke_m=stroke)
    images = seen_images(seen)
    shape = _shape(setting, seen, images, outlines)
    rig = shape.rig(rig)
    ready = replace(pair, rig=rig, stroke_m=stroke)
    shared = SharedPair.of(ready)
    answer = method_for(card)(shared)
    if any(spot.uv_px is None or spot.covariance_px2 is None for spot in (answer.down, answer.up)):
        told(_LOOKING)
        raise missing_spot_error(ready, photos, answer, apart_note(outlines) or doubt)
    spots = seen_spots(joint_or_separate(shared, answer, with_posteriors(shared, answer)))
    wide = {name: widened_by_shape(spots[name], images.get(name), shape) for name in POSITIONS}
    return _Fitted(ready, wide, rig, covariance, stroke, limb, (note, _shape_note(shape, setting)), doubt)


def _mixed(parts: Sequence[tuple[SeenSpot, float]], added_px: float) -> SeenSpot:
    """Spot of several hypotheses: mean and covariance of their mixture, and what the chain adds."""
    weight = np.array([chance for _, chance in parts])
    weight /= weight.sum()
    places = np.array([spot.uv_px for spot, _ in parts])
    mean = weight @ places
    within = np.einsum("k,kij->ij", weight, np.array([spot.covariance_px2 for spot, _ in parts]))
    between = np.einsum("k,ki,kj->ij", weight, places - mean, places - mean)
    return SeenSpot(mean, within + between + added_px**2 * np.eye(2), parts[0][0].unlike)


def _without(corner: tuple[int, int], photos: PairPhotos, setting: MeasureSetting) -> tuple[PairPhotos, MeasureSetting]:
    """Pictures of DN and setting without the first columns and rows, so that red comes first."""
    du, dv = corner

    def of(group: Sequence[Photo]) -> tuple[Photo, ...]:
        return tuple(replace(photo, pixels=_cut(photo.pixels, du, dv)) for photo in group)

    down, up = (PositionPhotos(of(position.on), of(position.off)) for position in (photos.down, photos.up))
    known = replace(setting.known, rig=_rig_at(setting.known.rig, -du, -dv))
    held = setting.calibration
    held = None if held is None else replace(held, rig=_rig_at(held.rig, -du, -dv))
    return PairPhotos(down, up), replace(setting, known=known, calibration=held)


def _cut(pixels: Image, du: int, dv: int) -> Image:
    """Pixels without the first `du` columns and `dv` rows, and without as many at the end as keep the size even."""
    inner = pixels[dv : pixels.shape[0] - dv, du : pixels.shape[1] - du].copy()
    inner.flags.writeable = False
    return inner


def _rig_at(rig: Rig, du: int, dv: int) -> Rig:
    """Rig whose picture begins `du` columns and `dv` rows further out, and ends as much."""
    camera = rig.camera
    width, height = camera.width_px + 2 * du, camera.height_px + 2 * dv
    cx, cy = camera.cx_px + du, camera.cy_px + dv
    return replace(rig, camera=replace(camera, width_px=width, height_px=height, cx_px=cx, cy_px=cy))


def _shifted(
    found: Measurement, corner: tuple[int, int], photos: PairPhotos, setting: MeasureSetting, note: str
) -> Measurement:
    """Measurement of cut pictures in the pixels of the whole ones."""
    down, up = (replace(spot, uv_px=spot.uv_px + np.array(corner)) for spot in (found.down, found.up))
    rig = _rig_at(found.rig, *corner)
    pair = replace(pair_of_photos(photos, found.stroke_m, setting.known, found.pair.card), rig=rig)
    notes = (found.notes[0], note, *found.notes[1:])
    return replace(found, down=down, up=up, rig=rig, nominal=setting.known.rig, pair=pair, notes=notes)


def _foreign(test: ChainTest) -> str:
    if test.of_light:
        return f"doubtful: {test.doubt}"
    return f"doubtful: the spots went through another chain than the file's: {test.doubt}" if test.doubt else ""


# -- rig -------------------------------------------------------------------------------------------------------------


def _outlines(pair: Pair, calibrated: bool) -> tuple[tuple[Outline, ...], str]:
    """Outlines of both positions, laser off where there is such a picture; and why there is none.

    With a calibration one is enough: it only tells whether the mirror is still there.
    """
    outlines, why = [], ""
    for position in POSITIONS[: 1 if calibrated else 2]:
        try:
            outlines.append(find_outline(_picture(pair, position), pair.rig, pair.card))
        except ImageError as error:
            why = str(error)
    return tuple(outlines), why


def _picture(pair: Pair, position: str) -> Image:
    """Picture of the mirror, laser off where there is one: the mean of raw frames, the first of others."""
    name = f"{position}_off" if f"{position}_off" in pair.images else position
    return pair.images[name] if pair.card.output == "raw" else pair.stack(name)[0]


def _corrected(setting: MeasureSetting, outlines: Sequence[Outline], why: str) -> tuple[Rig, Array, Array, str, str]:
    """Corrected rig, covariance and values of `PARAMETERS`, a sentence, and a doubt."""
    nominal = setting.known.rig
    if setting.calibration is not None:
        held = setting.calibration
        return held.rig, held.covariance, held.values, *calibration_note(held, outlines)
    if not outlines:
        values, covariance = np.zeros(len(PARAMETERS)), np.diag(prior_sigmas() ** 2)
        note = f"rig: as in the rig file, with the errors of a ruler; no outline: {why}"
        return nominal, covariance, values, note, ""
    outline = outlines_as_one(outlines)
    bundle = calibrate(nominal, outline)
    kind = ", by its edge alone" if any(outline.by_edge for outline in outlines) else ""
    text = f"rig: corrected by the mirror's outline in these pictures{kind}; the rest has the errors of a ruler"
    return bundle.rig, bundle.covariance, bundle.values, text, contradiction_note(nominal, outline, bundle.chi2)


def with_blur_of(rig: Rig, outlines: Sequence[Outline]) -> Rig:
    """Rig with the blur that the outlines' light has; as it is where none could be fitted."""
    blurs = [outline.blur_px for outline in outlines if math.isfinite(outline.blur_px)]
    return replace(rig, camera=replace(rig.camera, blur_sigma_px=float(np.mean(blurs)))) if blurs else rig


# -- spots -----------------------------------------------------------------------------------------------------------


def seen_images(pair: Pair) -> dict[str, SpotPicture]:
    """Pictures of a pair, by position, in which `detect` sees the spot."""
    detection = detect(pair)
    return spot_pictures(pair, *(Spot(None if spot is None else spot.uv_px) for spot in (detection.down, detection.up)))


def _shape(
    setting: MeasureSetting, pair: Pair, images: dict[str, SpotPicture], outlines: Sequence[Outline]
) -> SpotShape:
    """Blur and filters: of the calibration's spots, or of these, about what outline and rig file say."""
    held = setting.calibration
    if held is not None and (document := held.made_from.get(SHAPE)) is not None:
        return SpotShape.of_document(document)
    return fit_shape(list(images.values()), shape_prior(pair.rig, outlines))


def shape_prior(rig: Rig, outlines: Sequence[Outline]) -> SpotShape:
    """Shape that a rig says, with the blur of outlines in it where their light could be fitted."""
    by_light = any(math.isfinite(outline.blur_px) for outline in outlines)
    return SpotShape.prior(rig, OUTLINE_SIGMA_PX if by_light else PRIOR_SIGMA[0])


def widened_by_shape(spot: SeenSpot, image: SpotPicture | None, shape: SpotShape) -> SeenSpot:
    """Spot with what the uncertainty of blur and filters adds to its place, and how far its light is none."""
    if image is None:
        return spot
    added, unlike = seen_through(image, shape)
    return replace(spot, covariance_px2=spot.covariance_px2 + added, unlike=unlike)


def _shape_note(shape: SpotShape, setting: MeasureSetting) -> str:
    (blur, green, blue), (blur_sigma, *_) = shape.values, shape.sigmas
    held = setting.calibration is not None and SHAPE in setting.calibration.made_from
    source = "of the calibration" if held else "of these spots" if shape.images else "of the rig file"
    return f"spots: blur {blur:.2f} +- {blur_sigma:.2f} px, filters 1 : {green:.2f} : {blue:.2f}, {source}"


def seen_spots(answer: Answer) -> dict[str, SeenSpot]:
    """Positions of an answer that has both, by position."""
    both = dict(zip(POSITIONS, (answer.down, answer.up), strict=True))
    return {name: SeenSpot(np.array(spot.uv_px), np.array(spot.covariance_px2)) for name, spot in both.items()}
