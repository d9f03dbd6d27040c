"""Frames set, read and written: camera frames with their truth; and the truth file of sealed sets.

frames_set.json   where the frames come from: data set, preset, draws, task version
pairs.jsonl       per pair: files, what a user knows, and the truth with its bounds
frames/           images: PNG of 8 or 16 bits, or the camera's JPEG
SHA256SUMS        of everything above

Its pairs are those of `ScoredDataset.pairs` in one preset, with the same numbers and bytes. Nothing is drawn anew: no
other exposure, boxes or sensor. `phibench export --to frames` writes one.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from phibench.benchmark.pair_sets.dataset_pairs import (
    LOCALISE_BOX_PX,
    LOCALISE_MARGIN_PX,
    TASK_VERSION,
    DatasetPairs,
    Track,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile, Name
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.exposures.search_boxes import search_box
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.files import sha256
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.pair_files import (
    FRAMES_SET,
    MOST_PAIRS,
    PAIRS,
    FramesRow,
    PairFiles,
    PublicBox,
    SpotTruthRow,
    TruthRow,
    public_fields,
)
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import CHECKSUMS, Document
from phibench.estimator.interface import Box, Pair
from phibench.estimator.pair_set import Distraction, ImageTruth, PairTruth
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

# Truth file of a sealed set: the exact answers of its pairs, with a secret number.
#
# It is canonical JSON: same truth and salt, same bytes. NaN is written as null. Version 1 had other names for the
# nominal rig and stroke.


Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

_MATRICES = ("bound_px2", "raw_bound_px2")
_RIGS = ("true_rig", "nominal_rig")
_NOT_SEALED = (
    "calibration_covariance",
    "depth_sigma_m",
)  # of a score's calibration, and of real pairs: never of a seal


class SealedTruth(Document):
    """The truth's file."""

    format: Literal["phibench truth 1", "phibench truth 2"]
    public_sha256: Digest
    salt: Digest
    truths: Annotated[tuple[TruthRow, ...], Field(strict=False, max_length=MOST_PAIRS)]


def truth_text(truths: Sequence[PairTruth], salt: str, public_sha256: str) -> str:
    """Text of the truth's file: sorted keys, no blanks, doubles that read back to the same bits."""
    document = {
        "format": "phibench truth 2",
        "public_sha256": public_sha256,
        "salt": salt,
        "truths": [truth_document(truth) for truth in truths],
    }
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False) + "\n"


def read_truth_file(path: Path, expected_sha256: str) -> list[PairTruth]:
    """Truths of a file whose bytes must have a hash.

    Raises
    ------
    DatasetError
        If the file is missing, its bytes are others, or it holds what is no truth.
    """
    file = InputFile(path, "give the truth's file")
    data = file.read()
    digest = hashlib.sha256(data).hexdigest()
    if digest != expected_sha256:
        raise DatasetError(
            f"{path} is not the truth that was sealed: its SHA-256 begins with {digest[:12]}, the seal says "
            f"{expected_sha256[:12]}; give the file that `phibench seal make` wrote for this set"
        )
    truths = []
    for place, row in enumerate(file.document(SealedTruth, data).truths):
        try:
            truths.append(truth_of(row))
        except DatasetError as error:
            raise file.fault(f"is damaged: truths.{place}: {error}") from error
    return truths


def truth_document(truth: PairTruth) -> dict[str, Any]:
    """A pair's truth as JSON can hold it."""
    bare = replace(truth, down=_without_arrays(truth.down), up=_without_arrays(truth.up))
    document = {name: getattr(bare, name) for name in PairTruth.__dataclass_fields__ if name not in _NOT_SEALED}
    document |= {name: to_json(document[name]) for name in _RIGS}
    for position in ("down", "up"):
        spot = getattr(truth, position)
        matrices = {name: _lists(getattr(spot, name)) for name in _MATRICES}
        document[position] = {**asdict(getattr(bare, position)), **matrices}
    nulled: dict[str, Any] = _null_for_nan(document)
    return nulled


def truth_of(row: TruthRow) -> PairTruth:
    """A pair's truth of its document.

    Raises
    ------
    DatasetError
        If one of its rigs is none.
    """
    rigs = {name: from_json(Rig, getattr(row, name)) for name in _RIGS}
    return PairTruth(**{**dict(row), **rigs, "down": _spot(row.down), "up": _spot(row.up)})


def _spot(row: SpotTruthRow) -> ImageTruth:
    matrices = {name: _array(getattr(row, name)) for name in _MATRICES}
    distractions = tuple(Distraction(**dict(distraction)) for distraction in row.distractions)
    return ImageTruth(**{**dict(row), **matrices, "phi_rad": dict(row.phi_rad), "distractions": distractions})


def _without_arrays(spot: ImageTruth) -> ImageTruth:
    return replace(spot, bound_px2=None, raw_bound_px2=None)


def _lists(matrix: Array | None) -> list[list[float]] | None:
    return None if matrix is None else [[float(x) for x in row] for row in matrix]


def _array(rows: tuple[tuple[float, float], tuple[float, float]] | None) -> Array | None:
    return None if rows is None else np.array(rows)


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_null_for_nan(item) for item in value]
    return value


FORMAT: Literal["phibench frames set 1"] = "phibench frames set 1"
_Count = Annotated[int, Field(ge=1, le=MOST_PAIRS)]


class FramesInfo(Document):
    """`frames_set.json`."""

    format: Literal["phibench frames set 1"] = FORMAT
    name: Name
    task_version: Annotated[int, Field(ge=1, le=1000)]
    preset: Name
    draws: _Count
    pairs: _Count
    samples: _Count
    seed: Annotated[int, Field(ge=0)]
    recipe_sha256: Name
    dataset_sha256: Name | None


class FramesSet(ShortForm):
    """Pairs of a frames set by number, with their truth.

    Parameters
    ----------
    folder : Path
    numbers : sequence of int, optional
        Of the pairs in the files; all by default. They are numbered from 0 here.
    hints : bool
        Show the boxes of pairs that have some.
    track : str
        "localise" shows boxes of its own, any other none; "" shows what the pairs have.

    Raises
    ------
    DatasetError
        If it is no frames set, of another task version, incomplete, or changed; in one sentence.
    """

    def __init__(
        self, folder: str | Path, numbers: Sequence[int] | None = None, hints: bool = True, track: str = ""
    ) -> None:
        self.folder = Path(folder)
        self.info = _read_info(self.folder)
        self._files = PairFiles(self.folder, FramesRow, self.info.pairs, (FRAMES_SET,))
        self._numbers = tuple(range(self.info.pairs) if numbers is None else numbers)
        self._hints, self._track = hints and not track, track

    def _shown(self) -> dict[str, Any]:
        return {"folder": self.folder, "data set": self.info.name, "pairs": len(self), "preset": self.preset}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without rows: another process opens the set itself."""
        return FramesSet, (self.folder, self._numbers, self._hints, self._track)

    @property
    def preset(self) -> str:
        """Sensor preset of the frames."""
        return self.info.preset

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the set, with the truth."""
        return (self.folder,)

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[tuple[Pair, PairTruth]]:
        """Pairs with their truths, by number."""
        return ((self.pair(number), self.truth(number)) for number in range(len(self)))

    def pair(self, number: int) -> Pair:
        """Images of a pair, with what a user knows of the rig."""
        read = replace(pair_of_files(self._files, self._place(number)), number=number)
        if self._track == "localise":
            down, up = self._boxes(self.truth(number))
            return replace(read, box_down=down, box_up=up)
        return read if self._hints else replace(read, box_down=None, box_up=None)

    def _boxes(self, truth: PairTruth) -> tuple[Box, Box]:
        """Boxes of the track `localise`: those that the data set behind the frames has for this sample."""
        names, camera = (self.info.name, self.info.seed, truth.sample_id), truth.true_rig.camera
        regions = []
        for position, spot in (("down", truth.down), ("up", truth.up)):
            size = camera.width_px, camera.height_px
            has_place = all(-0.5 <= x <= n - 0.5 for x, n in zip(spot.axis_px, size, strict=True))
            light = spot.uv_px if has_place else None
            regions.append(search_box(names, position, light, camera, LOCALISE_BOX_PX, LOCALISE_MARGIN_PX))
        down, up = (Box(r.u0_px, r.v0_px, r.u1_px - r.u0_px, r.v1_px - r.v0_px) for r in regions)
        return down, up

    def of_track(self, track: Track) -> FramesSet:
        """The same pairs as a track shows them."""
        return FramesSet(self.folder, self._numbers, True, track)

    def truth(self, number: int) -> PairTruth:
        """Exact answer for a pair, with its bounds.

        Raises
        ------
        DatasetError
            If the line of the pair holds no rig.
        """
        place = self._place(number)
        try:
            read = truth_of(self._files.row(place).truth)
        except DatasetError as error:
            raise DatasetError(f"{self.folder / PAIRS} line {place + 1}: {error}; download the set again") from error
        localised = self._track == "localise"
        box_px2 = float(LOCALISE_BOX_PX**2) if localised else read.box_px2
        return replace(read, number=number, hinted=localised or (read.hinted and self._hints), box_px2=box_px2)

    def number_of(self, sample_id: str, draw: int = 0, preset: str | None = None) -> int:
        """Number of the pair of a sample in a draw of the noise, as scores name it.

        Raises
        ------
        DatasetError
            If there is none.
        """
        wanted = (sample_id, draw, preset or self.preset)
        rows = (self._files.row(place).truth for place in self._numbers)
        numbers = [k for k, row in enumerate(rows) if (row.sample_id, row.draw, row.preset) == wanted]
        if not numbers:
            raise DatasetError(f"sample '{sample_id}', draw {draw}, preset {wanted[2]}: there is no such pair")
        return numbers[0]

    def pairs(
        self, preset: str | None = None, draws: int | None = None, *, pairs: int | None = None, hints: bool = True
    ) -> FramesSet:
        """A part of the set: the first draws of each sample, the first pairs, or pairs without their boxes.

        Raises
        ------
        DatasetError
            If the set has another preset, or fewer draws.
        """
        if preset not in (None, self.preset):
            raise DatasetError(
                f"{self.folder} holds frames of '{self.preset}', none of '{preset}': leave the preset out, or take "
                "the set of that preset"
            )
        if draws is not None and not 1 <= draws <= self.info.draws:
            raise DatasetError(f"draws = {draws}: {self.folder} holds 1 to {self.info.draws} of each sample")
        if pairs is not None and pairs < 1:
            raise DatasetError(f"pairs = {pairs}: must be 1 or above")
        most = self.info.draws if draws is None else draws
        numbers = [place for place in self._numbers if self._files.row(place).truth.draw < most]
        return FramesSet(self.folder, numbers[:pairs], hints)

    def check(self) -> None:
        """Read every file once.

        Raises
        ------
        DatasetError
            If a file is missing, changed, or not of the set.
        """
        self._files.check()

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        rows = [self._files.row(place).truth for place in self._numbers]
        return {
            "name": self.info.name,
            "task_version": self.info.task_version,
            "sealed": False,
            "pairs": len(self),
            "samples": len({row.sample_id for row in rows}),
            "presets": [self.preset],
            "hinted": len(rows) if self._track == "localise" else sum(row.hinted for row in rows) if self._hints else 0,
            "boxes_px": LOCALISE_BOX_PX if self._track == "localise" else None,
            "track": self._track,
            "seed": self.info.seed,
            "recipe_sha256": self.info.recipe_sha256,
            "dataset_sha256": self.info.dataset_sha256,
            "frames_set_sha256": sha256(self.folder / CHECKSUMS),
            "provenance": provenance(),
        }

    def _place(self, number: int) -> int:
        if not 0 <= number < len(self):
            raise DatasetError(f"pair {number}: there are {len(self)}, numbered from 0; ask for one of them")
        return self._numbers[number]


def _read_info(folder: Path) -> FramesInfo:
    path = folder / FRAMES_SET
    if not path.is_file():
        raise DatasetError(
            f"{folder} is no frames set: it has no {FRAMES_SET}; `phibench export --to frames` writes one"
        )
    if not (folder / CHECKSUMS).is_file():
        raise DatasetError(f"{folder / CHECKSUMS} is missing: the set was not finished, or download it again")
    info = InputFile(path, "download the set again", limit_bytes=SETTINGS_BYTES).document(FramesInfo)
    if info.task_version != TASK_VERSION:
        raise DatasetError(
            f"{folder} is of task version {info.task_version}, this phibench scores version {TASK_VERSION}; fetch or "
            "export the set again"
        )
    return info


def frames_row(pair: Pair, truth: PairTruth, files: dict[str, str]) -> dict[str, Any]:
    """Line of a pair whose images lie in files, as JSON."""
    row = FramesRow(**public_fields(pair, files), truth=TruthRow.model_validate(truth_document(truth)))
    document: dict[str, Any] = row.model_dump(mode="json")
    return document


def frames_set_documents(
    pairs: DatasetPairs, preset: str, draws: int, rows: Sequence[dict[str, Any]]
) -> dict[str, bytes]:
    """Files `pairs.jsonl` and `frames_set.json`, which stand beside the images."""
    known = pairs.document()
    info = FramesInfo(
        name=known["name"],
        task_version=TASK_VERSION,
        preset=preset,
        draws=draws,
        pairs=len(rows),
        samples=known["samples"],
        seed=known["seed"],
        recipe_sha256=known["recipe_sha256"],
        dataset_sha256=known["dataset_sha256"],
    )
    ordered = sorted(rows, key=lambda row: int(row["number"]))
    lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in ordered)
    about = json.dumps(info.model_dump(mode="json"), indent=1) + "\n"
    return {PAIRS: lines.encode(), FRAMES_SET: about.encode()}


def pair_of_files(files: PairFiles[Any], number: int) -> Pair:
    """Images of a pair in files, with what a user knows of the rig.

    Raises
    ------
    DatasetError
        If a file or the line of the pair will not do; in one sentence.
    """
    row = files.row(number)
    try:
        rig = from_json(Rig, row.rig)
        images = {name: files.image(file, rig.camera) for name, file in row.files.items()}
        return Pair(
            number,
            images["down"],
            images["up"],
            rig=rig,
            stroke_m=row.stroke_m,
            card=from_json(SensorCard, row.card),
            down_off=images.get("down_off"),
            up_off=images.get("up_off"),
            box_down=_box(row.box_down),
            box_up=_box(row.box_up),
            beam=None if row.beam is None else from_json(Beam, row.beam),
        )
    except DatasetError as error:
        if str(error).startswith(str(files.folder)):
            raise
        raise DatasetError(f"{files.folder / PAIRS} line {number + 1}: {error}; download the set again") from error


def _box(box: PublicBox | None) -> Box | None:
    return None if box is None else Box(box.u0_px, box.v0_px, box.width_px, box.height_px)
