"""Dense set: dense pairs in files, written and read, with their truth for `dense score`, or sealed without it.

dense_set.json   where the pairs come from
pairs.jsonl      per pair: files, rig, stroke and sensor, and what the truth needs
frames/          both images, the laser off: PNG of 8 or 16 bits, or the camera's JPEG
truth/           D, cause, gloss and texture of every pixel of the down image (OpenEXR)
SHA256SUMS       of everything above

D is kept as float32, texture to 0.4 %. Points and places in the up image follow from D by the true rig. So the truth
agrees with itself in float64, and with that of the data set to 6e-8 of D. A sealed dense set has neither `truth/` nor
the keys of the truth. Its `dense_seal.json` has the SHA-256 of the truth's list of files, with a secret number.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from phibench.benchmark.dense.dense_pairs import DENSE_TASK_VERSION, DensePairs, DenseTruth, dense_pairs
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.pair_sets.frames_set import Digest, pair_of_files
from phibench.benchmark.sealed.sealed_set import public_sha256, seal_id, single_pairs
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, FileName, InputFile, Name
from phibench.datasets.exposures.pair_draws import PairDraw
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.read import Dataset
from phibench.datasets.store.checksums import filling, with_checksums, write_documents
from phibench.datasets.store.files import sha256, write_bytes, write_secret
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.layers import read_exr, write_exr
from phibench.datasets.store.pair_files import FRAMES, MOST_PAIRS, PAIRS, PairFiles, PublicPair
from phibench.datasets.store.schema import CHECKSUMS, SEALED_TRUTH, Document, TruthFolder
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.geometry.epipolar_line import range_at
from phibench.estimator.geometry.reflection import image_of, room_rays
from phibench.render.optics.correspondence import Correspondence
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

DENSE_SET = TruthFolder.DENSE_SET.value
DENSE_SEAL, DENSE_TRUTH = "dense_seal.json", f"dense{SEALED_TRUTH}"
PLANES = ("depth_m", "cause", "glossy", "texture")
_KIND = "dense set"
PRESET = "mjpeg"  # PNG files keep the noise, and have ten times the size
_AGAIN = "fetch the set again"
_Count = Annotated[int, Field(ge=1, le=MOST_PAIRS)]
_Metres = Annotated[float, Field(gt=0.0, le=1000.0)]


class DenseSetInfo(Document):
    """`dense_set.json`."""

    format: Literal["phibench dense set 1"] = "phibench dense set 1"
    task_version: Annotated[int, Field(ge=1, le=1000)]
    pairs: _Count
    source: dict[str, Any]


class DenseTruthRow(Document):
    """Truth of a pair, in its line."""

    sample_id: Name
    draw: Annotated[int, Field(ge=0, lt=MOST_PAIRS)]
    preset: Name
    room: Name
    stroke_m: _Metres
    true_rig: dict[str, Any]
    object_names: Annotated[tuple[Name, ...], Field(strict=False, max_length=100_000)]
    planes: FileName


class DenseRow(PublicPair):
    """One line of a dense set: a pair with its truth."""

    truth: DenseTruthRow


class DenseSeal(Document):
    """`dense_seal.json`: hashes of what a method may see, and of the truth's file."""

    format: Literal["phibench sealed dense set 1"] = "phibench sealed dense set 1"
    task_version: Annotated[int, Field(ge=1, le=1000)]
    pairs: _Count
    public_sha256: Digest
    truth_sha256: Digest

    @property
    def id(self) -> str:
        """Id that follows from both hashes, as that of a `Seal`."""
        return seal_id(self.public_sha256, self.truth_sha256)


class DenseSet:
    """Dense pairs of a dense set by number, with their truth.

    Parameters
    ----------
    folder : Path
    pairs : int, optional
        Only the first so many.

    Raises
    ------
    DatasetError
        If it is no dense set, of another task version, incomplete or changed; in one sentence.
    """

    def __init__(self, folder: str | Path, pairs: int | None = None) -> None:
        self.folder = Path(folder)
        if (self.folder / DENSE_SEAL).is_file():
            raise DatasetError(
                f"{folder} is sealed and holds no truth: answer it with `phibench seal submit`, and who has the truth "
                "scores the answers"
            )
        file = InputFile(self.folder / DENSE_SET, _AGAIN, limit_bytes=SETTINGS_BYTES)
        self.info = file.document(DenseSetInfo)
        if self.info.task_version != DENSE_TASK_VERSION:
            raise file.fault(f"is of version {self.info.task_version} of the task, and this phibench scores another")
        if pairs is not None and pairs < 1:
            raise DatasetError(f"pairs = {pairs}: must be 1 or above")
        self._files = PairFiles(self.folder, DenseRow, self.info.pairs, (DENSE_SET,))
        self._count = self.info.pairs if pairs is None else min(pairs, self.info.pairs)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[tuple[DensePair, DenseTruth]]:
        """Pairs with their truths, by number."""
        return ((self.pair(number), self.truth(number)) for number in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without lines: another process opens the set itself."""
        return DenseSet, (self.folder, self._count)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the set, with the truth."""
        return (self.folder,)

    def pair(self, number: int) -> DensePair:
        """Images (down, up) with the laser off, as a method sees them; the arrays are read-only."""
        return dense_pair_of_files(self._files, self._place(number))

    def truth(self, number: int) -> DenseTruth:
        """Exact answer for every pixel.

        Raises
        ------
        DatasetError
            If planes or line of the pair are damaged.
        """
        row = self._files.row(self._place(number))
        truth, path = row.truth, self.folder / row.truth.planes
        self._files.read(truth.planes)
        true_rig, given_rig = from_json(Rig, truth.true_rig), from_json(Rig, row.rig)
        planes = read_exr(path).planes
        shape = true_rig.camera.height_px, true_rig.camera.width_px
        if set(planes) != set(PLANES) or planes["depth_m"].shape != shape:
            raise DatasetError(f"{path} does not hold the planes of this pair; {_AGAIN}")
        return DenseTruth(
            number=number,
            sample_id=truth.sample_id,
            draw=truth.draw,
            preset=truth.preset,
            room=truth.room,
            stroke_m=truth.stroke_m,
            true_rig=true_rig,
            given_rig=given_rig,
            given_stroke_m=row.stroke_m,
            found=counterparts(true_rig, truth.stroke_m, planes, truth.object_names),
            texture=planes["texture"].astype(float),
        )

    @property
    def rows(self) -> list[DenseRow]:
        """Lines of the pairs."""
        return self._files.rows

    def bytes_of(self, name: str) -> bytes:
        """Bytes of a file of the set, which are checked."""
        return self._files.read(name)

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self.info.source | {"pairs": len(self), "dense_set_sha256": sha256(self.folder / CHECKSUMS)}

    def _place(self, number: int) -> int:
        if not 0 <= number < len(self):
            raise DatasetError(f"pair {number}: there are {len(self)}, numbered from 0; ask for one of them")
        return number


def dense_pair_of_files(files: PairFiles[Any], number: int) -> DensePair:
    """Images of a pair in files; errors as of `pair_of_files`."""
    read = pair_of_files(files, number)
    frames = {"down": [read.down], "up": [read.up]}
    return DensePair.of_frames(number, frames, rig=read.rig, stroke_m=read.stroke_m, card=read.card)


def counterparts(rig: Rig, stroke_m: float, planes: dict[str, Any], names: Sequence[str]) -> Correspondence:
    """Points and places in the up image from the planes of a truth, by the estimator's geometry."""
    depth, cause = planes["depth_m"].astype(float), planes["cause"].astype(np.int16)
    points, uv = np.full((*depth.shape, 3), np.nan), np.full((*depth.shape, 2), np.nan)
    view, known = rig.at(0.0), np.isfinite(depth)
    v, u = np.nonzero(known)
    rays = room_rays(view, np.stack([u, v], axis=-1).astype(float))
    reach = range_at(rays.origin_world_m - view.sphere_centre_m, rays.direction_world, depth[known])
    points[known] = rays.origin_world_m + reach[:, None] * rays.direction_world
    seen = cause == 0
    uv[seen] = image_of(rig.at(stroke_m), points[seen]).uv_px
    return Correspondence(uv, cause, points, depth, planes["glossy"] > 0.5, tuple(names))


# Written.


def first_pairs(dataset: Dataset, samples: int) -> DensePairs:
    """Dense pairs of the first samples of a data set, in their drawn order.

    Raises
    ------
    DatasetError
        If its recipe has no rooms, or the data set no layers.
    """
    require_rooms(dataset)
    names = {row.sample_id for row in dataset.rows[:samples]}
    return _numbered(dataset, [draw for draw in dense_pairs(dataset, PRESET, 1).pair_draws if draw.sample_id in names])


def pairs_of_sealed(dataset: Dataset, most: int) -> DensePairs:
    """Dense pairs of those pairs that `seal` shows in the preset: frames that are published already, and no other.

    Raises
    ------
    DatasetError
        As `first_pairs`, or if the sealed set has no frames of the preset.
    """
    require_rooms(dataset)
    chosen = [draw for draw in single_pairs(dataset_pairs(dataset)).pair_draws if draw.preset == PRESET]
    if not chosen or not chosen[0].laser_off:
        raise DatasetError(f"{dataset.folder}: its [frames] give no {PRESET} frames with the laser off; take others")
    return _numbered(dataset, chosen[:most])


def require_rooms(dataset: Dataset) -> None:
    """Refuse a data set whose samples share the recipe's only room: a dense set is about rooms.

    Raises
    ------
    DatasetError
        In one sentence.
    """
    if dataset.recipe.rooms is None:
        raise DatasetError(f"{dataset.folder} has no rooms of its own: a dense set needs a recipe with [rooms]")


def _numbered(dataset: Dataset, draws: Sequence[PairDraw]) -> DensePairs:
    return DensePairs(dataset, tuple(replace(draw, number=number) for number, draw in enumerate(draws)))


def write_dense_set(pairs: DensePairs, out: Path) -> Path:
    """Write dense pairs, each of one frame of an image, as a dense set; one that is whole is kept.

    Raises
    ------
    DatasetError
        If the folder holds something else, or a pair cannot be read; in one sentence.
    """
    with filling(out, lambda: _check_folder(out)):
        if (out / CHECKSUMS).is_file():
            return out
        rows, hashes = [], dict[str, str]()
        for number in range(len(pairs)):
            row, files = _written(pairs, number, out)
            rows.append(json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n")
            hashes |= {path.relative_to(out).as_posix(): sha256(path) for path in files}
        info = DenseSetInfo(task_version=DENSE_TASK_VERSION, pairs=len(pairs), source=pairs.document())
        text = json.dumps(info.model_dump(mode="json"), indent=1) + "\n"
        write_documents(out, with_checksums({PAIRS: "".join(rows).encode(), DENSE_SET: text.encode()}, hashes))
    return out


def _written(pairs: DensePairs, number: int, out: Path) -> tuple[DenseRow, list[Path]]:
    pair, truth = pairs.pair(number), pairs.truth(number)
    files, written = {}, []
    for position, frame in pairs.frames(number).items():
        end, data = ("png", png_bytes(frame.image)) if frame.jpeg is None else ("jpg", frame.jpeg)
        files[position] = f"{FRAMES}/{number:06d}-{position}.{end}"
        written.append(write_bytes(out / files[position], data))
    planes = f"truth/{number:06d}.exr"
    found = truth.found
    parts: tuple[Any, ...] = (found.depth_m, found.cause, found.glossy, _of_few_digits(truth.texture))
    header = {"kind": _KIND, "sample_id": truth.sample_id}
    named = {name: np.asarray(part, float) for name, part in zip(PLANES, parts, strict=True)}
    written.append(write_exr(out / planes, named, header))
    kept = {name: getattr(truth, name) for name in ("sample_id", "draw", "preset", "room", "stroke_m")}
    told = DenseTruthRow(
        **kept, true_rig=to_json(truth.true_rig), object_names=tuple(found.object_names), planes=planes
    )
    rig, card = to_json(pair.rig), to_json(pair.card)
    known = {"number": number, "files": files, "stroke_m": pair.stroke_m, "rig": rig, "card": card}
    return DenseRow(**known, box_down=None, box_up=None, truth=told), written


def _of_few_digits(texture: Array) -> Array:
    """Texture to 0.4 %, in a fraction of the bytes: strata are by factors of it."""
    mantissa, exponent = np.frexp(np.minimum(texture, 1e30))
    return np.ldexp(np.round(mantissa * 256.0) / 256.0, exponent)


def _check_folder(out: Path) -> None:
    held = [path.name for path in out.iterdir() if not path.name.startswith(".")] if out.is_dir() else []
    if set(held) - {FRAMES, "truth", PAIRS, DENSE_SET, CHECKSUMS, DENSE_TRUTH}:
        raise DatasetError(f"{out} holds something else: give a new folder")


def seal_dense_set(folder: Path, out: Path) -> Path:
    """Write the public form of a dense set: images, rig, stroke and sensor; the truth's hash is in the seal.

    The truth's file, `dense.truth.json`, is written into the dense set.

    Raises
    ------
    DatasetError
        If the folder is no dense set, or the public one holds something else; in one sentence.
    """
    read = DenseSet(folder)
    rows = [PublicPair(**{name: value for name, value in dict(row).items() if name != "truth"}) for row in read.rows]
    with filling(out, lambda: _check_public(out)):
        hashes = {}
        for name in (name for row in rows for name in row.files.values()):
            hashes[name] = sha256(write_bytes(out / name, read.bytes_of(name)))
        lines = "".join(json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n" for row in rows).encode()
        content = public_sha256(hashes | {PAIRS: hashlib.sha256(lines).hexdigest()})
        # a secret is the one number that must not come from a named stream
        truth = {"salt": secrets.token_hex(32), "sums_sha256": sha256(folder / CHECKSUMS)}
        text = json.dumps(truth, sort_keys=True) + "\n"
        seal = DenseSeal(
            task_version=DENSE_TASK_VERSION,
            pairs=len(rows),
            public_sha256=content,
            truth_sha256=hashlib.sha256(text.encode()).hexdigest(),
        )
        write_secret(folder / DENSE_TRUTH, text)  # first: no seal without its truth
        told = json.dumps(seal.model_dump(mode="json"), indent=1) + "\n"
        write_documents(out, with_checksums({PAIRS: lines, DENSE_SEAL: told.encode()}, hashes))
    return out


def _check_public(out: Path) -> None:
    held = [path.name for path in out.iterdir() if not path.name.startswith(".")] if out.is_dir() else []
    if set(held) - {FRAMES, PAIRS, DENSE_SEAL, CHECKSUMS}:
        raise DatasetError(f"{out} holds something else: give a new folder")
