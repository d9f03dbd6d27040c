"""Data set of real image pairs (`ImportedSet`): imported from a folder, opened; its pairs with measured D for scoring.

imported.json   rig, sensor, laser, and whether the sensor was assumed
pairs.jsonl     per pair: sample, frame, files, stroke, and the D of a tape with its standard deviation
frames/         pictures: the camera's own JPEG, or PNG of 8 or 16 bits with the same pixels
SHA256SUMS      of everything above

A sample is a row of `pairs.csv`; its frames are its draws of the noise. The truth of a pair is the tape's D alone:
where the spots are in the images, nobody has measured. So there are no errors of positions and of phi, and no bounds.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from phibench.calibration.captures.measure import MeasureSetting, chain_of, read_setting
from phibench.calibration.captures.pair_list import ListedPair, photos_of, read_pair_list
from phibench.calibration.captures.pair_photos import require_fitting
from phibench.calibration.captures.picture_files import Photo, SensorChoice, sensor_choice
from phibench.calibration.captures.raw_frames import PATTERNS
from phibench.calibration.captures.tested_chain import ChainTest
from phibench.datasets.common.camera_pictures import read_camera_picture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, FileName, InputFile, Name, path_below
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.checksums import checksums_text, read_checksums, writing_to
from phibench.datasets.store.files import read_rows, sha256, write_bytes, write_text
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import CHECKSUMS, Document, TruthFolder
from phibench.datasets.store.temporary_folders import OwnedFolder, folder_for_work
from phibench.estimator.interface import Image, Pair
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

INFO, ROWS, FRAMES = TruthFolder.IMPORTED.value, "pairs.jsonl", "frames"
FORMAT: Literal["phibench imported set 1"] = "phibench imported set 1"
RIG_FILE, SENSOR_FILE = "rig.toml", "sensor.toml"
_REMEDY = "import the pictures again, `phibench import FOLDER --out DATASET`"
_IMAGES = ("down", "up", "down_off", "up_off")


class ImportedInfo(Document):
    """`imported.json`."""

    format: Literal["phibench imported set 1"] = FORMAT
    name: Name
    pairs: Annotated[int, Field(ge=1)]
    rig: dict[str, Any]
    card: dict[str, Any]
    beam: dict[str, Any] | None
    assumed: bool
    sensor: str
    phibench: Name | None


class ImportedRow(Document):
    """One line of `pairs.jsonl`."""

    number: Annotated[int, Field(ge=0)]
    sample_id: Name
    draw: Annotated[int, Field(ge=0)]
    files: dict[str, FileName]
    stroke_m: Annotated[float, Field(gt=0.0, le=1000.0)]
    depth_m: Annotated[float, Field(gt=0.0, le=1000.0)] | None
    depth_sigma_m: Annotated[float, Field(gt=0.0, le=1000.0)] | None


# -- importing -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Imported:
    """Result of an import: the folder, its pairs, those of them with a D, and a sentence on the sensor."""

    folder: Path
    pairs: int
    with_depth: int
    sensor: str


def import_pairs(folder: Path, out: Path, rig: Path | None = None, sensor: Path | None = None) -> Imported:
    """Make a data set of a folder of pairs.

    Parameters
    ----------
    folder : Path
        With `pairs.csv` and the pictures.
    out : Path
        New or empty folder.
    rig, sensor : Path, optional
        Rig file and sensor file; `rig.toml`, and `sensor.toml` if it is there, of the folder by default.

    Raises
    ------
    DatasetError
        If a picture or a row will not do; then nothing is left behind.
    """
    setting = read_setting(rig or folder / RIG_FILE, None, sensor or _there(folder / SENSOR_FILE))
    listed = read_pair_list(folder)
    for name in {name for row in listed for names in row.files.values() for name in names}:
        path_below(folder, name)  # what a link leads to elsewhere would be given away with the set
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; give a new one, --out")
    with writing_to(out), folder_for_work(out.parent), OwnedFolder("import", out.parent) as work:
        return _import(folder, listed, setting, work, out)


def _there(path: Path) -> Path | None:
    return path if path.is_file() else None


def _import(folder: Path, listed: Sequence[ListedPair], setting: MeasureSetting, work: Path, out: Path) -> Imported:
    rows: list[ImportedRow] = []
    first: Photo | None = None
    test: ChainTest | None = None
    for row in listed:
        photos = photos_of(folder, row, setting)
        first = first or photos.down.on[0]
        test = test or chain_of(photos, row.stroke_m, setting)  # of a set: that of its first pair
        require_fitting(photos, setting.known.rig, setting.sensor)
        for photo in photos.all:
            _require_like(first, photo)
        groups = {"down": photos.down.on, "up": photos.up.on, "down_off": photos.down.off, "up_off": photos.up.off}
        for draw in range(len(photos.down.on)):
            files = {
                name: _stored(work, f"{row.name}-{draw}-{name}", group[draw % len(group)])
                for name, group in groups.items()
                if group
            }
            rows.append(
                ImportedRow(
                    number=len(rows),
                    sample_id=row.name,
                    draw=draw,
                    files=files,
                    stroke_m=row.stroke_m,
                    depth_m=row.depth_m,
                    depth_sigma_m=row.depth_sigma_m,
                )
            )
    if test is None:
        raise DatasetError(f"{folder} holds no pair")
    chosen = _chosen(test, setting)
    info = ImportedInfo(
        name=out.name[:64] or "imported",
        pairs=len(rows),
        rig=to_json(setting.known.rig),
        card=to_json(chosen.card),
        beam=None if setting.known.beam is None else to_json(setting.known.beam),
        assumed=chosen.assumed,
        sensor=chosen.note,
        phibench=version("phibench"),
    )
    write_text(work / INFO, json.dumps(info.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")
    write_text(work / ROWS, "".join(json.dumps(row.model_dump(mode="json"), allow_nan=False) + "\n" for row in rows))
    hashes = {path.relative_to(work).as_posix(): sha256(path) for path in work.rglob("*") if path.is_file()}
    write_text(work / CHECKSUMS, checksums_text(hashes))
    work.chmod(0o755)  # a temporary folder is its owner's alone
    if out.exists():
        out.rmdir()
    work.replace(out)
    return Imported(out, len(rows), sum(row.depth_m is not None for row in rows), chosen.note)


def _chosen(test: ChainTest, setting: MeasureSetting) -> SensorChoice:
    """Sensor of a set, with what the pictures say of its chain.

    Raises
    ------
    DatasetError
        If its DN do not begin with red: fits of DN take RGGB.
    """
    first, phase = test.photos.down.on[0], next(iter(test.phases))
    if first.kind == "raw" and phase != (0, 0):
        raise DatasetError(
            f"{first.path} begins with {PATTERNS[phase]}: a set of DN begins with red; cut {phase[0]} columns and "
            f"{phase[1]} rows off at the left and top of all pictures, and as many at the other side, and change "
            "width_px, height_px, cx_px and cy_px of the rig file"
        )
    choice = sensor_choice(first, setting.sensor)
    note = "; ".join(text for text in (choice.note, test.note, test.doubt) if text)
    return replace(choice, card=replace(choice.card, mosaic_phase=phase), note=note)


def _require_like(first: Photo, photo: Photo) -> None:
    """One card holds for all pictures of a set."""
    same = first.kind == photo.kind and first.subsampling == photo.subsampling
    if not same or [table.tolist() for table in first.tables] != [table.tolist() for table in photo.tables]:
        raise DatasetError(
            f"{first.path} and {photo.path} are of different kinds or JPEG tables: a set has one camera with one "
            "setting; import them into two sets"
        )


def _stored(work: Path, stem: str, photo: Photo) -> str:
    """Name of the file that a picture was written to: a JPEG as it is, anything else as PNG."""
    name = f"{FRAMES}/{stem}.{'jpg' if photo.kind == 'jpeg' else 'png'}"
    if not (work / name).exists():
        data = InputFile(photo.path, _REMEDY).read() if photo.kind == "jpeg" else png_bytes(photo.pixels)
        write_bytes(work / name, data)
    return name


# -- reading ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImportedSet:
    """Imported set, opened.

    Attributes
    ----------
    folder : Path
    info : ImportedInfo
    rows : tuple of ImportedRow
    rig : Rig
        Nominal.
    card : SensorCard
    beam : Beam or None
    hashes : dict of str to str
    """

    folder: Path
    info: ImportedInfo
    rows: tuple[ImportedRow, ...]
    rig: Rig
    card: SensorCard
    beam: Beam | None
    hashes: dict[str, str]

    @property
    def preset(self) -> str:
        """Name of the kind of its pictures, as scores sort by."""
        return f"{self.card.mosaic}-raw" if self.card.output == "raw" else self.card.output

    def pair(self, row: ImportedRow) -> Pair:
        """Pair of a row; the arrays are read-only.

        Raises
        ------
        DatasetError
            If a file is missing or was changed.
        """
        images = {name: self._image(row.files[name]) if name in row.files else None for name in _IMAGES}
        down, up = images["down"], images["up"]
        if down is None or up is None:
            raise DatasetError(f"{self.folder / ROWS} is damaged: pair {row.number} lacks a position; {_REMEDY}")
        return Pair(
            row.number,
            down,
            up,
            self.rig,
            row.stroke_m,
            self.card,
            images["down_off"],
            images["up_off"],
            beam=self.beam,
        )

    def _image(self, name: str) -> Image:
        file = InputFile(self.folder / name, _REMEDY)
        data = file.read()
        if self.hashes.get(name) != hashlib.sha256(data).hexdigest():
            raise file.fault("was changed, its SHA-256 is not the listed one")
        image = read_camera_picture(file, data).pixels
        if image.ndim != (2 if self.card.output == "raw" else 3):
            raise file.fault("is a picture of another kind than the set's")
        if image.shape[:2] != (self.rig.camera.height_px, self.rig.camera.width_px):
            raise file.fault("has another size than the set's camera")
        return image


def open_imported(folder: str | Path) -> ImportedSet:
    """Open an imported set; its documents are checked against their hashes, pictures when they are read.

    Raises
    ------
    DatasetError
        If it is none, or damaged; in one sentence.
    """
    folder = Path(folder)
    file = InputFile(folder / INFO, _REMEDY, limit_bytes=SETTINGS_BYTES)
    hashes = read_checksums(folder)
    for name in (INFO, ROWS):
        if hashes.get(name) != hashlib.sha256(InputFile(folder / name, _REMEDY).read()).hexdigest():
            raise DatasetError(f"{folder / name} was changed, its SHA-256 is not the listed one; {_REMEDY}")
    info, rows = file.document(ImportedInfo), read_rows(folder / ROWS, ImportedRow)
    if [row.number for row in rows] != list(range(info.pairs)):
        raise DatasetError(f"{folder / ROWS} does not hold the pairs 0 to {info.pairs - 1}; {_REMEDY}")
    beam = None if info.beam is None else from_json(Beam, info.beam)
    return ImportedSet(
        folder, info, tuple(rows), from_json(Rig, info.rig), from_json(SensorCard, info.card), beam, hashes
    )


# -- scoring ---------------------------------------------------------------------------------------------------------

_NOWHERE = ImageTruth(
    uv_px=(np.nan, np.nan),
    phi_rad={"ray": np.nan, "normal": np.nan, "incidence": np.nan},
    azimuth_rad=np.nan,
    visible=True,
    cause="none",
    electrons=np.nan,
    peak_e=np.nan,
    snr=np.nan,
    saturated=False,
    bound_px2=None,
    raw_bound_px2=None,
)
"""Truth of a spot that is seen, at a place that nobody has measured."""


class ImportedPairs:
    """Pairs of an imported set whose D was measured, with it as their truth: a `PairSet`.

    Parameters
    ----------
    imported : ImportedSet
    rows : those of it that are taken; all must have a D
    """

    def __init__(self, imported: ImportedSet, rows: Sequence[ImportedRow], task_version: int) -> None:
        self._set, self._rows, self._task_version = imported, tuple(rows), task_version

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folder of the set, with the tape's D."""
        return (self._set.folder,)

    def pair(self, number: int) -> Pair:
        """Images of a pair, with what a user knows of the rig."""
        return replace(self._set.pair(self._row(number)), number=number)

    def truth(self, number: int) -> PairTruth:
        """D of the tape with its standard deviation; no positions, no bounds."""
        row = self._row(number)
        if row.depth_m is None or row.depth_sigma_m is None:
            raise DatasetError(f"pair {number} of {self._set.folder} has no measured D")
        return PairTruth(
            number=number,
            sample_id=row.sample_id,
            draw=row.draw,
            preset=self._set.preset,
            jpeg_quality=self._set.card.jpeg_quality if self._set.card.output == "mjpeg" else None,
            hinted=False,
            depth_m=row.depth_m,
            stroke_m=row.stroke_m,
            true_rig=self._set.rig,
            nominal_rig=self._set.rig,
            down=_NOWHERE,
            up=_NOWHERE,
            depth_sigma_m=row.depth_sigma_m,
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return {
            "name": self._set.info.name,
            "task_version": self._task_version,
            "sealed": False,
            "imported": True,
            "sensor_assumed": self._set.info.assumed,
            "pairs": len(self),
            "samples": len({row.sample_id for row in self._rows}),
            "presets": [self._set.preset],
            "hinted": 0,
            "boxes_px": None,
            "dataset_sha256": sha256(self._set.folder / CHECKSUMS),
            "provenance": provenance(),
        }

    def _row(self, number: int) -> ImportedRow:
        if not 0 <= number < len(self._rows):
            raise DatasetError(f"pair {number}: there are {len(self._rows)}, numbered from 0; ask for one of them")
        return self._rows[number]


def imported_pairs(
    imported: ImportedSet, task_version: int, draws: int | None = None, pairs: int | None = None
) -> ImportedPairs:
    """Pairs of a set to be scored: those with a D, at most `draws` frames of each sample, the first `pairs` of them.

    Raises
    ------
    DatasetError
        If no pair has a D.
    """
    rows = [row for row in imported.rows if row.depth_m is not None and (draws is None or row.draw < draws)][:pairs]
    if not rows:
        raise DatasetError(
            f"no pair of {imported.folder} has a measured D: put depth_m and depth_sigma_m into pairs.csv"
        )
    return ImportedPairs(imported, rows, task_version)
