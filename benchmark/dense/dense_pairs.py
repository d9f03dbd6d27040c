"""Dense pairs of a data set, laser off, as a method sees them; exact truth of each pixel, its geometric check, texture.

The images are the laser-off frames of the spot pairs: the same exposures, the same draws of the noise, byte for byte.
Samples that differ in the spot alone show the same two views; one of them is taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs, dataset_pairs
from phibench.benchmark.pair_sets.wanted_pairs import samples_of_calibration
from phibench.calibration.rig.calibration_file import Calibration
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import PairDraw
from phibench.datasets.frames.frame_source import Frame, FrameSource
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import Dataset
from phibench.datasets.store.schema import ManifestRow
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.drawn_pairs import DrawnPairs
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.rig_parameters import stroke_of
from phibench.estimator.interface import Image
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig, View

if TYPE_CHECKING:
    from phibench.datasets.read import Correspondence

DENSE_TASK_VERSION = 1
"""Version of the task: what a dense method is given, what it must answer and what is counted."""
_CERTIFIED = 997  # every so many pixels the estimator's projection looks at a counterpart
_CERTIFICATE_PX = 1e-6
FURTHER_DRAW = 10**6
"""Draw of the noise, after a pair's own, for its texture: no method sees it."""


class CertificateError(RuntimeError):
    """The renderer's counterparts and the estimator's projection differ: a fault of the library."""


@dataclass(frozen=True)
class DenseTruth:
    """Exact answer for every pixel of a pair, with what a score sorts by.

    Attributes
    ----------
    number, sample_id, draw, preset
        As `PairTruth`.
    room : str
        Kind of the room.
    stroke_m : float
        True h.
    true_rig, given_rig : Rig
        The rig that was rendered, and the one in the pair.
    found : Correspondence
        Of the down image's pixels.
    texture : array, shape (H, W)
        Ratio of the image's squared gradient to the squared noise, in a window: `texture_ratio`.
    """

    number: int
    sample_id: str
    draw: int
    preset: str
    room: str
    stroke_m: float
    true_rig: Rig
    given_rig: Rig
    given_stroke_m: float
    found: Correspondence
    texture: Array

    @property
    def depth_m(self) -> Array:
        """D, shape (H, W); NaN where a pixel shows no surface."""
        return self.found.depth_m

    @property
    def scored(self) -> BoolArray:
        """Mask of the pixels that count: both images show their room point."""
        return self.found.seen

    @cached_property
    def elevation_rad(self) -> Array:
        """Elevation of the room points above the sphere centre at the down position, shape (H, W)."""
        down = self.true_rig.at(0.0).sphere_centre_m
        return np.asarray(np.arctan2(self.found.point_world_m[..., 2] - down[2], self.depth_m))


class DensePairSet(Protocol):
    """Dense pairs that can be scored, whatever they lie in."""

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders with the truth, which methods must not read."""

    def __len__(self) -> int: ...

    def pair(self, number: int) -> DensePair:
        """Images as a method sees them."""

    def truth(self, number: int) -> DenseTruth:
        """Exact answer for every pixel."""

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""


class DensePairs:
    """Dense pairs of a data set by number, with their truth.

    Parameters
    ----------
    pair_draws : tuple of PairDraw
        Numbered from 0.
    count : int
        Frames of each image.
    calibration : Calibration, optional
        Whose rig and stroke the pairs have, in place of the nominal ones.
    between : bool
        Pairs have the up images of shorter strokes, too, from the same place, rig and room.
    """

    def __init__(
        self,
        dataset: Dataset,
        pair_draws: tuple[PairDraw, ...],
        count: int = 1,
        calibration: Calibration | None = None,
        between: bool = False,
    ) -> None:
        self._drawn, self._count, self._calibration = DrawnPairs(dataset, pair_draws), count, calibration
        self._between = between
        self._rows = {row.sample_id: row for row in dataset.rows}

    def __len__(self) -> int:
        return len(self._drawn)

    def __iter__(self) -> Iterator[tuple[DensePair, DenseTruth]]:
        """Pairs with their truths, by number."""
        return ((self.pair(number), self.truth(number)) for number in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without layers: another process opens the data set itself."""
        from phibench.datasets.read import open_dataset

        return _reopened, (
            open_dataset,
            self.dataset.folder,
            self.pair_draws,
            self._count,
            self._calibration,
            self._between,
        )

    @property
    def dataset(self) -> Dataset:
        """Data set that the pairs come from."""
        return self._drawn.dataset

    @property
    def pair_draws(self) -> tuple[PairDraw, ...]:
        """Sample and noise realisation of every pair, by number; methods must not see it."""
        return self._drawn.pair_draws

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the data set, with the truth."""
        return self._drawn.folders

    def pair(self, number: int) -> DensePair:
        """Images (down, up) with the laser off, as a method sees them; the arrays are read-only."""
        with self._drawn.named(number):
            pair_draw, sample, source = self._drawn.drawn_from(number)
            frames = {
                position: [_frame(source, position, pair_draw.draw, k) for k in range(self._count)]
                for position in ("down", "up")
            }
            rig, stroke_m = self._given(sample.nominal_rig, sample.row.nominal_stroke_m)
            card = card_of(source.sides["down"].chain.sensor)
            pair = DensePair.of_frames(number, frames, rig=rig, stroke_m=stroke_m, card=card)
            return self._with_between(pair) if self._between else pair

    def lower(self, number: int) -> dict[float, int]:
        """Pairs of shorter strokes with the same down view, by nominal stroke, from low to high."""
        own = self.pair_draws[number]
        row = self._rows[own.sample_id]
        found: dict[float, int] = {}
        for other, draw in enumerate(self.pair_draws):
            there = self._rows[draw.sample_id]
            same = (draw.preset, draw.draw) == (own.preset, own.draw) and _place(there) == _place(row)
            if same and there.nominal_stroke_m < row.nominal_stroke_m:
                found.setdefault(there.nominal_stroke_m, other)
        return dict(sorted(found.items()))

    def _with_between(self, pair: DensePair) -> DensePair:
        images, heights_m = [], []
        for stroke_m, number in self.lower(pair.number).items():
            pair_draw, sample, source = self._drawn.drawn_from(number)
            if card_of(source.sides["up"].chain.sensor) == pair.card:  # the same exposure and processing
                images.append(_frame(source, "up", pair_draw.draw, 0))
                heights_m.append(self._given(sample.nominal_rig, stroke_m)[1])
        return with_between(pair, images, tuple(heights_m))

    def frames(self, number: int) -> dict[str, Frame]:
        """First frame of each image of a pair, with the camera's JPEG file."""
        with self._drawn.named(number):
            pair_draw, _, source = self._drawn.drawn_from(number)
            return {position: source.frame(position, pair_draw.draw, False) for position in ("down", "up")}

    def truth(self, number: int) -> DenseTruth:
        """Exact answer for every pixel.

        Raises
        ------
        DatasetError
            If layers or room cannot be read.
        CertificateError
            If the estimator's projection puts a counterpart elsewhere.
        """
        with self._drawn.named(number):
            pair_draw, sample, source = self._drawn.drawn_from(number)
            found = sample.correspondence("down")
            certify(found, sample.view("up"))
            rig, stroke_m = self._given(sample.nominal_rig, sample.row.nominal_stroke_m)
            return DenseTruth(
                number=number,
                sample_id=pair_draw.sample_id,
                draw=pair_draw.draw,
                preset=pair_draw.preset,
                room=_room_kind(self.dataset, sample.row.room),
                stroke_m=sample.row.stroke_m,
                true_rig=sample.rig,
                given_rig=rig,
                given_stroke_m=stroke_m,
                found=found,
                texture=_texture(source, pair_draw.draw),
            )

    def _given(self, rig: Rig, stroke_m: float) -> tuple[Rig, float]:
        if self._calibration is None:
            return rig, stroke_m
        return self._calibration.rig, float(stroke_of(np.array(stroke_m), self._calibration.values))

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        spots = DatasetPairs(self.dataset, self.pair_draws).document()
        kept = {name: value for name, value in spots.items() if name not in ("hinted", "boxes_px", "track")}
        calibrated = {} if self._calibration is None else {"calibration": self._calibration.sha256}
        between = {"between": True} if self._between else {}
        return {**kept, "task_version": DENSE_TASK_VERSION, "frames": self._count, **calibrated, **between}


def with_between(
    pair: DensePair, images: Sequence[Image], heights_m: tuple[float, ...], rows_m: tuple[float, ...] = ()
) -> DensePair:
    """The pair with images at heights between, if there are any; the array is read-only."""
    if not images:
        return pair
    stack = np.stack(images)
    stack.flags.writeable = False
    return replace(pair, between=stack, between_m=heights_m, between_row_m=rows_m)


def dense_pairs(
    dataset: Any,
    preset: str | None = None,
    draws: int | None = None,
    pairs: int | None = None,
    frames: int = 1,
    calibration: Calibration | None = None,
    between: bool = False,
) -> DensePairs:
    """Dense pairs of a data set, in the order of its spot pairs.

    Parameters
    ----------
    dataset : Dataset
    preset : str, optional
        Sensor preset; those of the recipe's `[frames]` if not given.
    draws : int, optional
        Draws of the noise per sample and preset; the recipe's if not given.
    pairs : int, optional
        Only the first so many.
    frames : int
        Frames of each image.
    calibration : Calibration, optional
        The pairs are those of its rig, and have its rig and stroke.
    between : bool
        As for `DensePairs`.

    Raises
    ------
    DatasetError
        If the data set has no truth of pixels, no preset is named, or a number is out of its range.
    """
    if not isinstance(dataset, Dataset):
        folder = getattr(dataset, "folder", dataset)
        raise DatasetError(
            f"{folder} has no truth of pixels: it holds frames or pictures alone. Give the data set with layers that "
            "`phibench dataset make` wrote"
        )
    if frames < 1:
        raise DatasetError(f"frames = {frames}: must be 1 or above")
    chosen = dataset if calibration is None else samples_of_calibration(dataset, calibration)
    for sample in chosen:
        require_curve(sample.nominal_rig, sample.row.nominal_stroke_m, sample.row.sample_id)
    draws_of_spots = dataset_pairs(chosen, preset, draws).pair_draws
    numbered = [replace(draw, number=k) for k, draw in enumerate(_distinct(chosen, draws_of_spots))]
    if pairs is not None and pairs < 1:
        raise DatasetError(f"pairs = {pairs}: must be 1 or above")
    if between and frames > 1:
        raise DatasetError("images between come one of each height: take frames = 1 with them")
    result = DensePairs(chosen, tuple(numbered[:pairs]), frames, calibration, between)
    if between and not any(map(result.lower, range(len(result)))):
        raise DatasetError(
            f"{chosen.folder}: no two pairs have the same rig, room and down view and another stroke, so that there "
            "are no images between; make a data set with several strokes_m in one of its [[experiments]]"
        )
    return result


_ASKED_M = 2.0  # a distance in every room
_RINGS, _TURNS = (0.2, 0.4, 0.6, 0.8), 8


def require_curve(rig: Rig, stroke_m: float, name: str) -> None:
    """Refuse a rig whose up image shows no point that the down image shows.

    Raises
    ------
    DatasetError
        In one sentence.
    """
    outline = rig.outline_px(_TURNS)
    middle = outline.mean(axis=0)
    pixels = np.concatenate([middle + share * (outline - middle) for share in _RINGS])
    pixels = pixels[rig.camera.contains(pixels)]
    up = up_image(rig, stroke_m, pixels, np.full(len(pixels), 1.0 / _ASKED_M)).uv_px
    if not rig.camera.contains(up).any():  # False for NaN
        raise DatasetError(
            f"sample '{name}': no pixel of the down image has an epipolar curve in the up image, h = {stroke_m:g} m, "
            f"mirror {rig.mirror.shape}: dense depth needs a mirror that shows the same points from both positions"
        )


def _reopened(opened: Any, folder: Path, *others: Any) -> DensePairs:
    return DensePairs(opened(folder), *others)


def _place(row: ManifestRow) -> tuple[str, ...]:
    """Down view of a sample, by its rigs and room."""
    return row.rig, row.nominal_rig, row.room, row.down.view_truth_file


def _distinct(dataset: Dataset, draws: Sequence[PairDraw]) -> list[PairDraw]:
    """Draws without those whose two views another sample has, too: the first of the manifest stands for them."""
    first: dict[tuple[Any, ...], str] = {}
    owner = {}
    for row in dataset.rows:
        views = (*_place(row), row.nominal_stroke_m, row.up.view_truth_file)
        owner[row.sample_id] = first.setdefault(views, row.sample_id)
    return [draw for draw in draws if owner[draw.sample_id] == draw.sample_id]


def _frame(source: FrameSource, position: str, draw: int, repeat: int) -> Image:
    image = np.array(source.frame(position, draw, False, repeat).image)
    image.flags.writeable = False
    return image


def _room_kind(dataset: Dataset, room: str) -> str:
    source = dataset.rooms.info(room).source
    kind = str(source.get("kind", "named"))
    return str(source.get("name", kind)) if kind == "named" else kind


# Certificate and texture.


def certify(found: Correspondence, other: View) -> float:
    """Largest distance between some counterparts and the estimator's own projection of their points, pixels.

    Raises
    ------
    CertificateError
        If it is above 1e-6 px.
    """
    seen = np.flatnonzero(found.seen)[::_CERTIFIED]
    if not len(seen):
        return 0.0
    place = image_of(other, found.point_world_m.reshape(-1, 3)[seen]).uv_px
    off = np.abs(place - found.uv_px.reshape(-1, 2)[seen]).max()
    if not off <= _CERTIFICATE_PX:
        raise CertificateError(f"counterparts and the estimator's projection differ by {off:.2g} px")
    return float(off)


_WINDOW_PX = 9
_LEAST_NOISE = 1e-6  # codes squared: a saturated surface has none


def texture_ratio(one: Image, other: Image) -> Array:
    """Squared gradient of the image without noise over the squared noise of a pixel, in windows of 9 x 9 px.

    Parameters
    ----------
    one, other : arrays, shape (H, W) or (H, W, C)
        Two draws of the noise of one image. Noise of both is independent: the product of their gradients has the
        gradient's square as expectation, and their difference twice the noise's variance.
    """
    from scipy.ndimage import uniform_filter

    a, b = (_grey(image) for image in (one, other))
    gradients = [np.gradient(image) for image in (a, b)]
    signal = sum(uniform_filter(x * y, _WINDOW_PX) for x, y in zip(*gradients, strict=True))
    noise = uniform_filter(0.5 * (a - b) ** 2, _WINDOW_PX)
    return np.asarray(np.maximum(signal, 0.0) / np.maximum(noise, _LEAST_NOISE), float)


def _grey(image: Image) -> Array:
    """Mean of the channels; of a mosaic mean of each 2 x 2 cell, at every pixel; of YUYV its Y'."""
    values = np.asarray(image, np.float32)
    if values.ndim == 3:
        return np.asarray(values[..., 0] if values.shape[2] == 2 else values.mean(axis=2))
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(values, 2))


def _texture(source: FrameSource, draw: int) -> Array:
    return texture_ratio(*(source.frame("down", k, False).image for k in (draw, draw + FURTHER_DRAW)))
