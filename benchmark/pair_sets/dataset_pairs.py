"""Pairs of a data set with their exact answers and Cramer-Rao bounds, and the tracks in which they are shown.

The bound of a spot counts room, dark current and distractors as background: one unknown level per filter. Pixels are
(u, v), integers at pixel centres; covariances are px^2, shape (2, 2), of (u, v).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.exposures.expected_electrons import ExpectedRegion, expected_of_light
from phibench.datasets.exposures.pair_draws import CachedSample, FrameCounts, PairDraw, pair_draws
from phibench.datasets.exposures.search_boxes import search_boxes
from phibench.datasets.frames.frame_source import FrameSource, PositionLight
from phibench.datasets.frames.sensor_card import SensorCard, card_of
from phibench.datasets.frames.sensor_file import SensorFile
from phibench.datasets.read import Dataset, open_dataset
from phibench.datasets.store import schema
from phibench.datasets.store.files import sha256
from phibench.datasets.store.pair_files import LEAST_BOX_PX
from phibench.datasets.store.provenance import provenance
from phibench.estimator.drawn_pairs import DrawnPairs
from phibench.estimator.interface import Pair
from phibench.estimator.limits.position_bound import SpotLimit, processed_snr, raw_snr, spot_limit
from phibench.estimator.limits.processed_bound import chain_limit, on_off_limit, processed_on_off_limit
from phibench.estimator.pair_set import Distraction, ImageTruth, PairTruth
from phibench.estimator.spots.gaussian_spot import SpotBlur
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

TASK_VERSION = 6
"""Version of the task: what a method is given, what it must answer and what is counted. A change of any raises it.

6: every preset exposes by itself, unless the recipe's `[frames]` says otherwise; positions, phi, D and boxes refer to
   the centre of the light, no longer to the beam's axis; signal to noise is one definition for all presets.
5: spots may be hidden in one image, and a D of such a pair is false.
4: a missed pair counts as the best constant depth would; a sealed set shows each sample once.
"""

Track = Literal["localise", "find", "depth"]
TRACKS: tuple[Track, ...] = get_args(Track)
LOCALISE_BOX_PX, LOCALISE_MARGIN_PX = 64, 16
"""Side of the boxes of `localise`, and how far the spot's centre is from their edges at least."""

_OF_THE_SPOT = 0.01  # of its brightest pixel: dimmer pixels are not the spot's
_FLUX = 2  # place of the flux among the unknowns of a Fisher matrix


def tracks_of(pair_set: Mapping[str, Any]) -> tuple[Track, ...]:
    """Tracks that a pair set belongs to, by its document: whole frames are those of `find` and of `depth`."""
    if pair_set.get("track") == "localise":
        return ("localise",)
    whole = pair_set.get("hinted", 1) == 0 and pair_set.get("boxes_px") is None
    return ("find", "depth") if whole else ()


class DatasetPairs(DrawnPairs, ShortForm):
    """Pairs of a data set by number, with their truth; the layers of the last sample are kept.

    Parameters
    ----------
    pair_draws : tuple of PairDraw
        Numbered from 0.
    boxes_px : int, optional
        Side of the boxes of all pairs, if they are not the recipe's.
    sensor : SensorFile, optional
        Of the pairs, for the record.
    count_frames : bool
        Bounds count frames on and off of single ones, too.
    track : str
        Track that boxes were chosen for; "" if none was.
    """

    def __init__(
        self,
        dataset: Dataset,
        pair_draws: tuple[PairDraw, ...],
        boxes_px: int | None = None,
        sensor: SensorFile | None = None,
        count_frames: bool = False,
        track: str = "",
    ) -> None:
        super().__init__(dataset, pair_draws)
        self._boxes_px, self._sensor, self._count_frames, self._track = boxes_px, sensor, count_frames, track

    def _shown(self) -> dict[str, Any]:
        return {
            "data set": self.dataset.folder,
            "pairs": len(self),
            "presets": ", ".join(dict.fromkeys(draw.preset for draw in self.pair_draws)),
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without rows and layers: another process opens the data set itself."""
        others = self._boxes_px, self._sensor, self._count_frames, self._track
        return _reopened, (self.dataset.folder, self.pair_draws, *others)

    def of_track(self, track: Track) -> DatasetPairs:
        """The same pairs as a track shows them: in boxes of its own, or as whole frames."""
        boxes: dict[str, Any] = {}
        size = LOCALISE_BOX_PX, LOCALISE_MARGIN_PX
        if track == "localise":
            samples = {draw.sample_id: self.dataset[draw.sample_id] for draw in self.pair_draws}
            boxes = {name: search_boxes(sample, *size) for name, sample in samples.items()}
        draws = tuple(replace(draw, boxes=boxes.get(draw.sample_id)) for draw in self.pair_draws)
        return DatasetPairs(self.dataset, draws, size[0] if boxes else None, self._sensor, self._count_frames, track)

    def truth(self, number: int) -> PairTruth:
        """The exact answer, with the bounds of the image and of the raw pixels behind it."""
        with self.named(number):
            return self._truth(number)

    def _truth(self, number: int) -> PairTruth:
        pair_draw, sample, source = self.drawn_from(number)
        sensor = source.sides["down"].chain.sensor
        return PairTruth(
            number=number,
            sample_id=pair_draw.sample_id,
            draw=pair_draw.draw,
            preset=pair_draw.preset,
            jpeg_quality=source.jpeg_quality,
            hinted=pair_draw.boxes is not None,
            depth_m=sample.row.centre_depth_m,
            stroke_m=sample.row.stroke_m,
            true_rig=sample.rig,
            nominal_rig=sample.nominal_rig,
            down=_spot_truth(sample, source, "down", self._counts(pair_draw)),
            up=_spot_truth(sample, source, "up", self._counts(pair_draw)),
            nominal_stroke_m=sample.row.nominal_stroke_m,
            exposure_s=sensor.exposure_s,
            analogue_gain=sensor.analogue_gain,
            laser_level=source.request.laser_level,
            lamp_level=source.request.lamp_level,
            axis_depth_m=sample.row.depth_m,
            box_px2=_box_px2(pair_draw),
        )

    def number_of(self, sample_id: str, draw: int = 0, preset: str | None = None) -> int:
        """Number of the pair of a sample in a draw of the noise, as scores name it.

        Raises
        ------
        DatasetError
            If there is none, or several for want of a preset.
        """
        numbers = [each for each in self.pair_draws if (each.sample_id, each.draw) == (sample_id, draw)]
        numbers = [each for each in numbers if preset in (None, each.preset)]
        if len(numbers) != 1:
            presets = sorted({each.preset for each in numbers})
            say = f"it is there in {', '.join(presets)}: give one" if numbers else "there is no such pair"
            raise DatasetError(f"sample '{sample_id}', draw {draw}, preset {preset or 'any'}: {say}")
        return numbers[0].number

    def __iter__(self) -> Iterator[tuple[Pair, PairTruth]]:
        """Pairs with their truths, by number."""
        return ((self.pair(number), self.truth(number)) for number in range(len(self)))

    def _counts(self, pair_draw: PairDraw) -> FrameCounts | None:
        """Frames that the bound counts; None for a single frame with the laser on."""
        counted = pair_draw.laser_off and (self._count_frames or pair_draw.frames != (1, 1))
        return FrameCounts(*pair_draw.frames) if counted else None

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        info, listed = self.dataset.info, self.dataset.folder / schema.CHECKSUMS
        return {
            "name": info.name,
            "task_version": TASK_VERSION,
            "sealed": False,
            "pairs": len(self),
            "samples": len({draw.sample_id for draw in self.pair_draws}),
            "presets": sorted({draw.preset for draw in self.pair_draws}),
            "hinted": sum(draw.boxes is not None for draw in self.pair_draws),
            "boxes_px": self._boxes_px,
            "track": self._track,
            "seed": self.dataset.recipe.dataset.seed,
            "recipe_sha256": info.recipe_sha256,
            "dataset_sha256": sha256(listed) if listed.is_file() else None,
            "provenance": provenance(),
            **self._otherwise(),
        }

    def _otherwise(self) -> dict[str, Any]:
        """Frames and numbers of the sensor that are not the recipe's: scores of others are not comparable."""
        changed: dict[str, Any] = {}
        if (counts := sorted({draw.frames for draw in self.pair_draws})) != [(1, 1)] or self._count_frames:
            changed["frames"] = [list(count) for count in counts]
        if self._sensor is not None:
            text = json.dumps([self._sensor.preset, dict(self._sensor.numbers)], sort_keys=True)
            changed["sensor_sha256"] = hashlib.sha256(text.encode()).hexdigest()
        return changed


def _box_px2(pair_draw: PairDraw) -> float:
    sizes = (math.prod(region.shape) for region in pair_draw.boxes or ())
    return float(min(sizes, default=LEAST_BOX_PX**2))


def _reopened(folder: Path, *others: Any) -> DatasetPairs:
    return DatasetPairs(open_dataset(folder), *others)


def dataset_pairs(
    dataset: Dataset,
    preset: str | None = None,
    draws: int | None = None,
    pairs: int | None = None,
    hints: bool = True,
    boxes_px: int | None = None,
    sensor: SensorFile | None = None,
    frames: FrameCounts | None = None,
) -> DatasetPairs:
    """Pairs of a data set in random order.

    Parameters
    ----------
    preset : str, optional
        Sensor preset; those of the recipe's `[frames]` if not given.
    draws : int, optional
        Draws of the noise per sample and preset; the recipe's if not given.
    pairs : int, optional
        Only the first so many.
    hints : bool
        Show the boxes of pairs that have some.
    boxes_px : int, optional
        Side of a box for every pair, instead of those of the recipe's `[frames]`.
    sensor : SensorFile, optional
        Numbers of a measured camera, which go before the recipe's and the preset's.
    frames : FrameCounts, optional
        Frames of each position with the laser on and off, in place of one and the recipe's; bounds are then those of
        `processed_bound`.

    Raises
    ------
    DatasetError
        If neither recipe nor caller names a preset, or a number is out of its range.
    """
    chosen = pair_draws(dataset, preset, draws, sensor)
    if pairs is not None and pairs < 1:
        raise DatasetError(f"pairs = {pairs}: must be 1 or above")
    if frames is not None:
        chosen = tuple(replace(draw, laser_off=True, frames=(frames.on, frames.off)) for draw in chosen)
    if boxes_px is not None:
        chosen = _with_boxes(dataset, chosen, boxes_px, hints)
    elif not hints:
        chosen = tuple(replace(draw, boxes=None) for draw in chosen)
    return DatasetPairs(dataset, chosen[:pairs], boxes_px, sensor, count_frames=frames is not None)


def _with_boxes(dataset: Dataset, chosen: tuple[PairDraw, ...], side_px: int, hints: bool) -> tuple[PairDraw, ...]:
    if not hints:
        raise DatasetError("--boxes gives every pair a box, --no-hints takes all boxes away: give one of them")
    if side_px < LEAST_BOX_PX:
        raise DatasetError(f"boxes = {side_px} px: must be {LEAST_BOX_PX} or above, such as 64")
    boxes = {sample.row.sample_id: search_boxes(sample, side_px) for sample in dataset}
    return tuple(replace(draw, boxes=boxes[draw.sample_id]) for draw in chosen)


def _spot_truth(sample: CachedSample, source: FrameSource, position: str, frames: FrameCounts | None) -> ImageTruth:
    row, side = sample.row.position(position), source.sides[position]
    centre = row.centre
    uv_px = (centre.u_px, centre.v_px)
    beam = Beam(sample.row.spot_diameter_m, 0.0)
    spot = SpotInImage(uv_px, row.electrons_per_s, row.visible, sample.row.centre_depth_m, beam)
    bounds = spot_bounds(side, sample.rig, spot, frames=frames)
    return ImageTruth(
        uv_px=uv_px,
        phi_rad={"ray": centre.phi_ray_rad, "normal": centre.phi_normal_rad, "incidence": centre.phi_incidence_rad},
        azimuth_rad=centre.azimuth_rad,
        visible=row.visible,
        cause=row.cause,
        axis_px=(row.u_px, row.v_px),
        **vars(bounds),
        distractions=_distractions(sample, side, position),
    )


def _distractions(sample: CachedSample, side: PositionLight, position: str) -> tuple[Distraction, ...]:
    """Lights beside the spot that this image shows."""
    return tuple(
        Distraction(
            distractor.kind,
            (truth.u_px, truth.v_px),
            spot_electrons(distractor.layers[position].total_electrons_per_s, side),
        )
        for distractor in sample.distractors
        if (truth := distractor.truths[position]).visible
    )


# -- light and bounds of a spot ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpotBounds:
    """Light and bounds of one spot in one image; the attributes are those of `pair_set.ImageTruth`."""

    electrons: float
    peak_e: float
    snr: float
    saturated: bool
    bound_px2: Array | None
    raw_bound_px2: Array | None


@dataclass(frozen=True)
class SpotInImage:
    """A spot as one image has it.

    Attributes
    ----------
    uv_px : (u, v), true
    rates_per_s : 3 floats
        Electrons per second of the whole spot behind R, G, B at laser level 1.
    visible : bool
        Whether the spot is seen; there are no bounds of one that is not.
    depth_m, beam
        As for `spot_blur`: the spot's own size. Raw pixels' bound does not need it, it takes the light as it is.
    """

    uv_px: tuple[float, float]
    rates_per_s: tuple[float, ...]
    visible: bool
    depth_m: float | None = None
    beam: Beam | None = None


def spot_bounds(
    side: PositionLight, rig: Rig, spot: SpotInImage, pattern_known: bool = False, frames: FrameCounts | None = None
) -> SpotBounds:
    """Bounds of a spot in the image of a sensor and in the raw pixels behind it.

    Parameters
    ----------
    side : PositionLight
        Light and sensor; its region is not used.
    pattern_known : bool
        Whether the camera's PRNU and DSNU are calibrated; otherwise the bounds count them as noise.
    frames : FrameCounts, optional
        Frames with the laser on and off, from which alone the room is known; by default one frame with the laser on,
        and the room a level per filter.
    """
    sensor = side.chain.sensor
    raw = sensor.replace(output="raw")
    card = card_of(raw)
    region = expected_of_light(side.light, raw, rig.camera) if spot.visible else None
    raw_limit = None if region is None else _raw_limit(region, card, pattern_known, frames)
    limit, electrons, snr = raw_limit, spot_electrons(spot.rates_per_s, side), 0.0
    if region is not None and sensor.output in PROCESSED:
        blur = spot_blur(rig, spot.uv_px, spot.depth_m, spot.beam)

        def limit_of_part(part: float) -> SpotLimit:
            known = card_of(sensor), rig, spot.uv_px, blur, part * electrons
            return _processed_limit(region, *known, pattern_known, frames)

        limit = limit_of_part(1.0)
        snr = processed_snr(lambda part: _information(limit_of_part(part), electrons), _information(limit, electrons))
    elif region is not None:
        snr = raw_snr(region, card, frames, pattern_known)
    peak_e = 0.0 if region is None else _peak_e(region)
    return SpotBounds(
        electrons=electrons,
        peak_e=peak_e,
        snr=snr,
        saturated=peak_e > card.saturation_e,
        bound_px2=_bound(limit),
        raw_bound_px2=_bound(raw_limit),
    )


def spot_electrons(rates_per_s: tuple[float, ...] | Array, side: PositionLight) -> float:
    """Electrons of a whole spot: behind the red filter, or all of them where there are no filters."""
    sensor = side.chain.sensor
    weights = sensor.mono_weights if sensor.mosaic == "mono" else (1.0, 0.0, 0.0)
    return float(np.dot(rates_per_s, weights)) * sensor.exposure_s * side.light.laser_level


def _raw_limit(region: ExpectedRegion, card: SensorCard, pattern_known: bool, frames: FrameCounts | None) -> SpotLimit:
    if frames is None:
        return spot_limit(region, card, pattern_known=pattern_known)
    return on_off_limit(region, card, frames, pattern_known)


def _processed_limit(
    region: ExpectedRegion,
    card: SensorCard,
    rig: Rig,
    uv_px: tuple[float, float],
    blur: SpotBlur,
    electrons: float,
    pattern_known: bool,
    frames: FrameCounts | None,
) -> SpotLimit:
    """Limit of the 8-bit or JPEG image: the room as one level per filter, its mean under the spot; a Gaussian spot."""
    weight = region.spot_e + 1e-3 * region.spot_e.max()  # of a filter that sees nothing of the spot: the mean of all
    levels = [
        float(np.average(region.background_e[region.filters == c], weights=weight[region.filters == c]))
        for c in range(3)
    ]
    r, g, b = rig.camera.detector.laser_filter_response
    upright = SpotBlur(blur.sigma_px, blur.ratio)  # the mixed moment would change the bound by 3 % at most
    if frames is None:
        return chain_limit(card, uv_px, upright, electrons, levels, (r, g, b), pattern_known)
    card = replace(card, prnu=0.0) if pattern_known else card
    return processed_on_off_limit(card, uv_px, upright, electrons, levels, frames, (r, g, b))


def _bound(limit: SpotLimit | None) -> Array | None:
    return None if limit is None or not np.isfinite(limit.covariance_px2).all() else limit.covariance_px2


def _peak_e(region: ExpectedRegion) -> float:
    """Largest expected electrons of a pixel that belongs to the spot, room included."""
    return float(region.mean_e[region.spot_e >= _OF_THE_SPOT * region.spot_e.max()].max())


def _information(limit: SpotLimit, flux_e: float) -> float:
    """Information of an image about a spot's relative flux, place and room known."""
    return float(flux_e**2 * limit.fisher[_FLUX, _FLUX])
