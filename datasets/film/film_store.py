"""Files of films: names, `film.json`, `film.parquet`, spot windows, key views; writing, reading and checking of them.

film.json                  the data set: recipe, code, what each film holds and its proof; written last
recipe.toml
croissant.json
films/<film>/film.parquet  truth, a row per frame
films/<film>/spots.npz     the spot in each frame, electrons per second over the exposure
films/<film>/lights.parquet  truth of other lights, a row per light and frame; light00.npz, ... their images
films/<film>/views/k0_0.150000.exr  key views of the room: part of the poses, and place there
films/<film>/done.json     what the film was made from, region, proof, hashes
films/<film>/journal.txt   key views that are whole, while the film is made and after; no part of the data
SHA256SUMS
journal.txt, log.jsonl     films that are whole, and the diary of the runs; no part of the data
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import polars
from numpy.typing import NDArray
from pydantic import ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile, first_fault
from phibench.datasets.store.checksums import differing_files, read_checksums
from phibench.datasets.store.files import write_bytes, write_text
from phibench.datasets.store.layers import read_exr, write_exr
from phibench.datasets.store.schema import CROISSANT, Document, TruthFile, TruthFolder, described
from phibench.render.film.film_truth import RATES, InstantTruth
from phibench.render.film.moving_rows import RowsImage
from phibench.render.optics.spot_layer import SpotLight
from phibench.render.sensor.light import Region
from phibench.scenes.camera import FILTERS, LARGEST_SIDE_PX
from phibench.scenes.frames import Array

INFO, RECIPE, CHECKSUMS = TruthFolder.FILMS.value, "recipe.toml", "SHA256SUMS"
FILM, SPOTS = TruthFile.FILM.value, TruthFile.SPOTS.value
LIGHTS, LIGHT_IMAGES = TruthFile.LIGHTS.value, "light{:02d}.npz"
SCHEMA_VERSION = 4
_Model = TypeVar("_Model", bound=Document)
_AGAIN = "run `phibench film make` again"
_ARRAYS = {"origin_px": ("<i8", 2), "shape_px": ("<i8", 2), "images_per_s": ("<f4", 1)}


class FilmInfo(Document):
    """Origin and content of a film: `done.json`."""

    film: str = described("-", "id of the film, that of its pair")
    key: str = described("-", "SHA-256 over all that the film depends on")
    frames: int = described("-", "number of frames")
    u0_px: int = described("px", "first column that is rendered")
    v0_px: int = described("px", "first row that is rendered")
    width_px: int = described("px", "columns that are rendered")
    height_px: int = described("px", "rows that are rendered")
    window_px: int | None = described("px", "side of the window around the spot; null for whole images")
    keys_m: tuple[float, ...] = described(
        "m",
        "places of the key views: offset of the carriage; on a leg of the drive the way of the faster track, or the "
        "angle of the flippers, rad",
    )
    key_counts: tuple[int, ...] = described(
        "-", "how many of them belong to each part of the poses: moves of the carriage, and legs of the drive, in order"
    )
    pixel_ratio: float | None = described("1", "held-out view: rms error of a pixel near the spot, over its noise")
    position_ratio: float | None = described("1", "held-out view: error of the spot's position, over its bound")
    sha256: dict[FileName, str] = described("-", "hash of each file, relative to the film's folder")

    @property
    def region(self) -> Region:
        """Part of the image that is rendered."""
        return Region(self.u0_px, self.v0_px, self.u0_px + self.width_px, self.v0_px + self.height_px)

    @property
    def keys(self) -> list[Array]:
        """Places of the key views of each part."""
        ends = np.cumsum(self.key_counts)[:-1]
        return np.split(np.array(self.keys_m), ends)


class SetInfo(Document):
    """A data set of films: `film.json`."""

    schema_version: int = described("-", "version of this layout")
    name: str = described("-", "name of the data set")
    seed: int = described("-", "root of all random streams")
    code_sha256: str = described("-", "hash of the code that makes data")
    films: tuple[str, ...] = described("-", "ids of the films")


def view_name(part: int, place: float) -> str:
    """Name of a key view's file in the folder of its film."""
    return f"views/k{part}_{place + 0.0:.6f}.exr"


@dataclass(frozen=True)
class FilmFolder:
    """Folder of one film below that of its data set."""

    path: Path

    @classmethod
    def of(cls, out: Path, film_id: str) -> FilmFolder:
        """Folder of a film."""
        return cls(out / "films" / film_id)

    def view(self, part: int, place: float) -> Path:
        """File of a key view, named by its part of the poses and its place there."""
        return self.path / view_name(part, place)

    @property
    def done(self) -> Path:
        """File that says that the film is complete."""
        return self.path / "done.json"

    def info(self) -> FilmInfo:
        """Content of `done.json`.

        Raises
        ------
        DatasetError
            If it is missing or damaged.
        """
        if not self.done.is_file():
            raise DatasetError(f"{self.path} is not finished; {_AGAIN}")
        return read_document(self.done, FilmInfo)


def read_document(path: Path, model: type[_Model]) -> _Model:
    """Read a JSON document and check it."""
    raw = InputFile(path, _AGAIN).json()
    try:
        return model.model_validate_json(json.dumps(raw))
    except ValidationError as error:
        raise DatasetError(f"{path} is damaged: {first_fault(error)}; {_AGAIN}") from error


def write_document(path: Path, document: Document) -> None:
    """Write a JSON document."""
    write_text(path, document_text(document))


def document_text(document: Document) -> str:
    """JSON of a document."""
    return json.dumps(document.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


# Key views.


def write_view(path: Path, planes: NDArray[np.float32], region: Region, header: dict[str, Any]) -> None:
    """Write a key view, shape (3, h, w), electrons per second."""
    named = dict(zip(FILTERS, planes, strict=True))
    write_exr(path, named, {"kind": "film_view", "unit": "electrons/s", **header}, (region.u0_px, region.v0_px))


def read_view(path: Path, region: Region) -> NDArray[np.float32]:
    """Read a key view, shape (3, h, w).

    Raises
    ------
    DatasetError
        If it cannot be read or is of other pixels.
    """
    try:
        file = read_exr(path)
    except DatasetError as error:
        raise DatasetError(f"{error}; {_AGAIN}") from error
    missing = [name for name in FILTERS if name not in file.planes]
    if missing or file.header.get("kind") != "film_view":
        raise DatasetError(f"{path} is no key view of a film; {_AGAIN}")
    planes = np.stack([file.planes[name] for name in FILTERS])
    if file.origin_px != (region.u0_px, region.v0_px) or planes.shape[1:] != region.shape:
        raise DatasetError(f"{path} holds other pixels than its film; {_AGAIN}")
    return planes


# Spots.


def write_spots(path: Path, images: Sequence[RowsImage]) -> None:
    """Write the spot's images of all frames: origins, shapes, and the values one after the other."""
    stacks = [
        np.stack([image.electrons_per_s, image.du_electrons_per_s_px, image.dv_electrons_per_s_px]).astype("<f4")
        for image in images
    ]
    arrays: dict[str, Any] = {
        "origin_px": np.array([(image.u0_px, image.v0_px) for image in images], "<i8").reshape(-1, 2),
        "shape_px": np.array([stack.shape[2:] for stack in stacks], "<i8").reshape(-1, 2),
        "images_per_s": np.concatenate([stack.ravel() for stack in stacks] or [np.zeros(0, "<f4")]),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def read_spots(path: Path, frames: int) -> list[RowsImage]:
    """Read the spot's images.

    Raises
    ------
    DatasetError
        If the file cannot be read, or does not hold so many frames.
    """
    arrays = InputFile(path, _AGAIN).arrays(_ARRAYS)
    origins, shapes, values = (arrays[name] for name in _ARRAYS)
    if shapes.shape[1:] != (2,) or (shapes < 0).any() or (shapes > LARGEST_SIDE_PX).any():
        raise DatasetError(f"{path} is damaged: its images have no size; {_AGAIN}")
    sizes = 9 * np.prod(shapes, axis=1)  # three planes, and their derivatives by u and v
    if origins.shape != (frames, 2) or shapes.shape != (frames, 2) or sizes.sum() != len(values):
        raise DatasetError(f"{path} is damaged: it does not hold {frames} images; {_AGAIN}")
    ends = np.cumsum(sizes)
    result = []
    for (u0, v0), shape, size, end in zip(origins, shapes, sizes, ends, strict=True):
        stack = values[end - size : end].reshape(3, 3, *shape).astype(float)
        result.append(RowsImage(int(u0), int(v0), *stack))
    return result


# The table.


@dataclass(frozen=True)
class FrameTruth:
    """Truth of one frame: at its time, and at that of the spot's own row; readings of encoders at the frame's time.

    `light` is the centre of the light at the time of the row, None where none reaches the lens; `light_depth_m`, its D.
    """

    frame: int
    encoder_m: float
    encoder_sigma_m: float
    tracks_m: tuple[float, ...]
    at_frame: InstantTruth
    at_row: InstantTruth
    light: SpotLight | None
    light_depth_m: float
    electrons_per_s: tuple[float, ...]

    def record(self) -> dict[str, Any]:
        """Row of `film.parquet`: columns of the frame's time, and with `row_` those of the spot's row."""
        head = {
            "frame": self.frame,
            "encoder_m": self.encoder_m,
            "encoder_sigma_m": self.encoder_sigma_m,
            "tracks_m": list(self.tracks_m),
            "electrons_per_s": list(self.electrons_per_s),
        }
        both = (("", self.at_frame), ("row_", self.at_row))
        columns = {prefix + name: value for prefix, instant in both for name, value in _columns(instant).items()}
        return head | _light_columns(self.light) | {"row_light_depth_m": self.light_depth_m} | columns


def _light_columns(light: SpotLight | None) -> dict[str, Any]:
    """Columns `row_light_`, with NaN where there is no light."""
    names = [field.name for field in fields(SpotLight)]
    values = {name: getattr(light, name, (math.nan,) * 3 if name.endswith("_m") else math.nan) for name in names}
    return {f"row_light_{name}": list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def _columns(one: InstantTruth) -> dict[str, Any]:
    flat = {name: value for name, value in asdict(one).items() if name not in ("spot", "rates")}
    spot, rates = asdict(one.spot), {f"{name}_per_s": one.rates[name] for name in RATES}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in {**flat, **spot, **rates}.items()}


def light_record(name: str, row: FrameTruth) -> dict[str, Any]:
    """Row of `lights.parquet`: that of `film.parquet` without the encoders."""
    told = ("encoder_m", "encoder_sigma_m", "tracks_m")
    return {"light": name} | {key: value for key, value in row.record().items() if key not in told}


def write_table(path: Path, rows: Sequence[FrameTruth]) -> None:
    """Write `film.parquet`."""
    write_records(path, [row.record() for row in rows])


def write_records(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """Write a Parquet file of rows."""
    buffer = io.BytesIO()
    table = polars.DataFrame(records, infer_schema_length=None)
    table.write_parquet(buffer, compression="zstd", statistics=False)
    write_bytes(path, buffer.getvalue())


def read_table(path: Path, frames: int) -> polars.DataFrame:
    """Read `film.parquet`.

    Raises
    ------
    DatasetError
        If it cannot be read or has another number of rows.
    """
    table = InputFile(path, _AGAIN).table()
    if len(table) != frames or "row_light_u_px" not in table.columns:
        raise DatasetError(f"{path} does not hold {frames} frames; {_AGAIN}")
    return table


def finite_or_none(value: float) -> float | None:
    """Number for JSON; None for NaN."""
    return value if math.isfinite(value) else None


# Checksums.


def film_files(out: Path, films: Sequence[str]) -> list[str]:
    """Names of all files of a data set of films, relative to its folder, sorted."""
    names = [INFO, RECIPE, *([CROISSANT] if (out / CROISSANT).exists() else [])]  # films of version 0.2 have none
    for film in films:
        folder = FilmFolder.of(out, film)
        names += [f"films/{film}/{name}" for name in (*folder.info().sha256, "done.json")]
    return sorted(names)


def verify_films(out: Path) -> list[str]:
    """Faults of a data set of films, one sentence each; none for a sound one.

    Raises
    ------
    DatasetError
        If it is not finished.
    """
    if not (out / INFO).is_file():
        raise DatasetError(f"{out} holds no films: it has no {INFO}; make them with `phibench film make`")
    if not (out / CHECKSUMS).is_file():
        raise DatasetError(f"{out} has no {CHECKSUMS}: it was not finished; {_AGAIN}")
    listed, info = read_checksums(out), read_document(out / INFO, SetInfo)
    faults = [f"{name} is not listed in {CHECKSUMS}" for name in film_files(out, info.films) if name not in listed]
    return faults + differing_files(out, listed)
