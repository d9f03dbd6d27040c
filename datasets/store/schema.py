"""Schema of a data set's files: base class `Document`, models of metadata, file names, and which files hold the truth.

FORMAT.md describes them; a test compares. A certificate records that two independent computations agree: closed form
and ray tracer, on position and flux of a spot.

A number that does not exist (a spot without a reflection point) is NaN in Python and null in JSON. File names are
relative to the folder of the data set, with forward slashes.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, field_validator, model_validator

from phibench.datasets.common.input_files import FILE_NAME, FileName, Name, NoFileName, Text
from phibench.datasets.rooms.room_sources import ONLY_ROOM

SCHEMA_VERSION = 8
READABLE_VERSIONS = (4, 5, 6, 7, 8)
"""Version 5 gave mirrors a form, `mirror.form` in `rigs.jsonl`; in version 4 every mirror is a perfect sphere.
Version 6 gave samples rooms of their own, `rooms.jsonl`; before, `dataset.json` held the only one, shape by shape.
Version 7 gave spots the centre of their light, `light`; before, there is the axis of the beam alone.
Version 8 made ambient layers halves, with `sd.*` in place of `var.*`, and left the angles out of truth layers."""
Position = Literal["down", "up"]


def _nan_from_null(value: object) -> object:
    return math.nan if value is None else value


def _null_from_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


Number = Annotated[float, BeforeValidator(_nan_from_null), PlainSerializer(_null_from_nan, when_used="json")]
"""A double that may be NaN: null in JSON."""

_ID = r"[A-Za-z0-9][A-Za-z0-9_.-]*"
"""Ids of poses, samples and rooms: no separator, and no dot in front, so that no file leaves its folder."""
RoomId = Annotated[Name, Field(pattern=f"^{_ID}$")]

Vector2 = Annotated[tuple[Number, Number], Field(strict=False)]
Vector3 = Annotated[tuple[Number, Number, Number], Field(strict=False)]


class Document(BaseModel):
    """A frozen document without unknown keys; values of the wrong type are refused."""

    # validators are built at their first use: a command uses few of the models that it imports
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", defer_build=True)


def described(unit: str, text: str, **default: Any) -> Any:
    """Field of a document with its unit ("-": none, "1": a pure number) and its meaning.

    `default` is for fields that older versions do not have.
    """
    return Field(description=text, json_schema_extra={"unit": unit}, **default)


# Documents.


class CertificateRow(Document):
    """Differences of two independent answers for one spot in one view, and the tolerances they were held to."""

    chief_difference_px: float = described("px", "chief ray: closed form against ray tracer")
    chief_tolerance_px: float = described("px", "largest allowed chief_difference_px")
    centroid_difference_px: float = described("px", "centroid of the spot layer against rays over aperture and spot")
    centroid_tolerance_px: float = described("px", "largest allowed centroid_difference_px")
    flux_difference: float = described("1", "relative difference of the spot's electrons per second, same two")
    flux_tolerance: float = described("1", "largest allowed flux_difference")
    place_difference_m: Number = described(
        "m", "place of the light on the surfaces, same two; null before version 7", default=math.nan
    )
    place_tolerance_m: Number = described(
        "m", "largest allowed place_difference_m; null before version 7", default=math.nan
    )
    passed: bool = described("-", "all differences are within their tolerances; false is never shipped")


class NoiseRow(Document):
    """Errors of phi_ray of one spot in one raw Bayer frame, preset `webcam`, 1/60 s (`render/room/noise_budget.py`)."""

    phi_sensor_rad: Number = described("rad", "standard deviation from photons and read noise, known shape and blur")
    phi_render_rad: Number = described("rad", "what the ambient layer's own noise adds, within the budget of `quality`")


class LightRow(Document):
    """Centre of a spot's light that reaches the image: what a perfect method finds."""

    u_px: Number = described("px", "centre of the light in the image, to the right")
    v_px: Number = described("px", "centre of the light in the image, downwards")
    phi_ray_rad: Number = described("rad", "theta / 2 of the ray through (u_px, v_px) and the lens centre")
    phi_normal_rad: Number = described("rad", "polar angle of the mirror normal where that ray meets it")
    phi_incidence_rad: Number = described("rad", "angle of incidence there")
    azimuth_rad: Number = described("rad", "azimuth of that normal")
    place_world_m: Vector3 = described("m", "place of the light on the surfaces, weighted by power")


class SpotRow(Document):
    """The exact answer for one spot in one view, and where its layers are."""

    pose: str = described("-", "id of the mirror pose")
    offset_m: float = described("m", "carriage offset along the stroke axis")
    u_px: Number = described("px", "image of the spot's centre through the lens centre, to the right")
    v_px: Number = described("px", "image of the spot's centre through the lens centre, downwards")
    phi_ray_rad: Number = described("rad", "theta / 2, theta between the mirror-to-spot ray and straight down")
    phi_normal_rad: Number = described("rad", "polar angle of the outward mirror normal from straight down")
    phi_incidence_rad: Number = described("rad", "angle of incidence on the mirror")
    azimuth_rad: Number = described("rad", "azimuth of the outward mirror normal, from world x towards world y")
    reflection_point_world_m: Vector3 = described("m", "where the chief ray meets the mirror")
    camera_centre_world_m: Vector3 = described("m", "lens centre")
    sphere_centre_world_m: Vector3 = described("m", "sphere centre")
    path_spot_mirror_m: Number = described("m", "spot centre to reflection point, along the ray")
    path_mirror_camera_m: Number = described("m", "reflection point to lens centre")
    visible: bool = described("-", "whether the chief ray reaches the sensor")
    cause: str = described("-", "why not; 'none' if visible")
    coma_shift_px: Vector2 = described("px", "energy centroid of the spot minus (u_px, v_px)")
    light: LightRow | None = described(
        "-", "centre of the light; null where none reaches the image, and before version 7", default=None
    )
    electrons_per_s: Vector3 = described("1/s", "electrons per second of the whole spot behind R, G, B")
    view_ambient_file: FileName = described("-", "ambient layer of the view")
    view_truth_file: FileName = described("-", "truth layer of the view")
    spot_file: NoFileName = described("-", "spot layer; null where no light of the spot reaches the image")
    certificate: CertificateRow | None = described("-", "null where the spot is not visible")
    noise: NoiseRow | None = described("-", "null where the spot is not visible")

    @model_validator(mode="after")
    def _complete_if_visible(self) -> SpotRow:
        """A visible spot has every number, a layer and a passed certificate."""
        if not self.visible:
            return self
        if missing := [name for name, value in self if name not in ("noise", "light") and not _is_finite(value)]:
            raise ValueError(f"the spot is visible but has no {', '.join(missing)}")
        if self.light is not None and not all(_is_finite(value) for _, value in self.light):
            raise ValueError("the spot is visible but its light has no centre")
        if self.certificate is None or not self.certificate.passed:
            raise ValueError("the spot is visible but its certificate is missing or not passed")
        return self

    @property
    def centre(self) -> LightRow:
        """Place that a perfect method finds: the centre of the light; the beam's axis where there is none."""
        if self.light is not None and self.visible:
            return self.light
        angles = {name: getattr(self, name) for name in _ANGLES}
        return LightRow(u_px=self.u_px, v_px=self.v_px, **angles, place_world_m=(math.nan, math.nan, math.nan))

    def at_centre(self, name: str) -> Any:
        """Value of a field, of places and angles that of `centre`."""
        return getattr(self.centre if name in LightRow.model_fields else self, name)


_ANGLES = ("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad")


class ManifestRow(Document):
    """One stroke pair: one line of `manifest.jsonl`."""

    sample_id: str = described(
        "-", "<experiment>-<target>-h<stroke>, with -<rig> if rigs are drawn; or random-<number>"
    )
    experiment: str = described("-", "name of the experiment in the recipe, or 'random'")
    target: str = described("-", "name of the target in the recipe, or of what carries the spot")
    rig: str = described("-", "id of the true rig, in `rigs.jsonl`")
    nominal_rig: str = described("-", "id of the nominal rig, which estimators are given, in `rigs.jsonl`")
    room: RoomId = described("-", "id of the room, in `rooms.jsonl`", default=ONLY_ROOM)
    depth_m: float = described(
        "m", "D: horizontal distance of the spot from the vertical through the sphere centre, down"
    )
    light_depth_m: Number = described(
        "m",
        "D of the light on the surfaces, mean of both views; null where none is seen, and before version 7",
        default=math.nan,
    )
    stroke_m: float = described("m", "stroke (baseline) h, the true one")
    nominal_stroke_m: float = described("m", "nominal stroke, which estimators are given")
    spot_world_m: Vector3 = described("m", "centre of the laser spot")
    spot_normal_world: Vector3 = described("1", "unit normal of the wall at the spot")
    spot_beam_world: Vector3 | None = Field(
        default=None,
        description="unit vector along the laser's beam; null for a disc in the wall's plane, and in older data sets",
        json_schema_extra={"unit": "1"},
    )
    spot_diameter_m: float = described("m", "diameter of the spot: 4 sigma if gaussian, of the disc if uniform")
    down: SpotRow = described("-", "stroke position 1, offset 0")
    up: SpotRow = described("-", "stroke position 2, offset stroke_m")
    tries: int = described("-", "which draw was the first possible one; 1 is the sequence's own; 0 if nothing is drawn")
    drawn: dict[str, float | str] = described("-", "what was drawn, by parameter; empty if nothing is")

    def position(self, name: str) -> SpotRow:
        """Truth of the stroke position "down" or "up"."""
        return {"down": self.down, "up": self.up}[name]

    @property
    def centre_depth_m(self) -> float:
        """D that a perfect method finds: that of the light; that of the beam's axis where there is none."""
        return self.light_depth_m if math.isfinite(self.light_depth_m) else self.depth_m


class PoseInfo(Document):
    """One mirror pose in `dataset.json`."""

    pose: str = described("-", "id")
    rig: str = described("-", "id of the rig")
    room: RoomId = described("-", "id of the room", default=ONLY_ROOM)
    offset_m: float = described("m", "carriage offset along the stroke axis")
    ambient_seed: int = described("-", "32-bit seed of the ambient layer")
    files: dict[str, FileName] = described("-", "ambient, truth, preview")

    @field_validator("files")
    @classmethod
    def _all_three(cls, files: dict[str, str]) -> dict[str, str]:
        if set(files) != {"ambient", "truth", "preview"}:
            raise ValueError("the files ambient, truth and preview are needed, and no other")
        return files


class LeftOutInfo(Document):
    """One sample that was refused and left out, in `dataset.json`."""

    sample_id: Name = described("-", "id that the sample has in the recipe")
    cause: Text = described("-", "why it cannot be made: no possible draw, its certificate, or the noise of its views")


class RigInfo(Document):
    """One rig: one line of `rigs.jsonl`."""

    rig: Name = described("-", "id: `rig` is that of the recipe's `[rig]`, others are called after their first sample")
    resolved: dict[str, Any] = described("-", "the rig, field by field")


class RoomInfo(Document):
    """One room: one line of `rooms.jsonl`."""

    room: RoomId = described("-", "id: `room` where all samples share one")
    source: dict[str, Any] = described("-", "what the room is made from, field by field")
    digest: str = described("-", "SHA-256 of all that the room is")
    lit: bool = described("-", "whether any lamp or screen is on")
    object_names: Annotated[tuple[str, ...], Field(strict=False)] = described(
        "-", "name by object_id of the truth layers"
    )


class DatasetInfo(Document):
    """`dataset.json`."""

    schema_version: int = described("-", "version of this format")
    name: str = described("-", "name of the data set")
    recipe: dict[str, Any] = described("-", "the recipe, defaults filled in")
    recipe_sha256: str = described("-", "SHA-256 of the recipe's values as canonical JSON")
    rigs: int = described("-", "number of rigs, the lines of `rigs.jsonl`")
    rooms: int = described("-", "number of rooms, the lines of `rooms.jsonl`", default=1)
    room: dict[str, Any] | None = described("-", "the only room, all shapes; before version 6", default=None)
    object_names: Annotated[tuple[str, ...], Field(strict=False)] = described(
        "-", "name by object_id of the truth layers; before version 6", default=()
    )
    poses: Annotated[tuple[PoseInfo, ...], Field(strict=False)] = described("-", "all mirror poses")
    samples: int = described("-", "number of rows of the manifest")
    shard: str | None = described("-", "which part of the recipe this is, such as 1/4; null for all of it")
    left_out: Annotated[tuple[LeftOutInfo, ...], Field(strict=False)] = described(
        "-", "samples of the recipe that were refused and left out; the key is missing where there are none", default=()
    )
    conventions: dict[str, str] = described("-", "frames, pixels, phi, units in one sentence each")
    provenance: dict[str, Any] = described("-", "versions, commit, code hash, variant, LLVM, threads")

    @property
    def causes(self) -> dict[str, str]:
        """Cause by id of the samples that were left out."""
        return {sample.sample_id: sample.cause for sample in self.left_out}


# Lines and columns.


def row_line(row: ManifestRow) -> str:
    """One line of `manifest.jsonl`; doubles are written so that reading gives the same bits."""
    return json.dumps(row.model_dump(mode="json"), allow_nan=False)


def flat(document: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Key and value of every leaf of a row, keys joined by dots: the columns of `manifest.parquet`."""
    for key, value in document.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def drawn_columns(rows: Iterable[ManifestRow]) -> dict[str, type]:
    """Dotted names and types of the columns for what was drawn, in the order of their first appearance."""
    return {f"drawn.{name}": type(value) for row in rows for name, value in row.drawn.items()}


def columns(model: type[BaseModel] = ManifestRow, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and field of every leaf of a document, in order, but for `drawn`, whose keys depend on the recipe."""
    for name, field in model.model_fields.items():
        if name == "drawn":
            continue
        inner = next((kind for kind in _kinds(field.annotation) if _is_document(kind)), None)
        if inner is None:
            yield prefix + name, field
        else:
            yield from columns(inner, f"{prefix}{name}.")


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """An annotation or the options of a union."""
    return (annotation, *getattr(annotation, "__args__", ()))


def _is_document(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Document)


def _is_finite(value: object) -> bool:
    if isinstance(value, tuple):
        return all(_is_finite(item) for item in value)
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


# File names.


class TruthFolder(StrEnum):
    """Files that say what a folder is, of folders that tell the truth; isolation hides such a folder from methods.

    Whoever writes such a folder has the name from here, so that it is hidden as soon as it can be written.
    """

    DATASET = "dataset.json"
    FILMS = "film.json"
    EXPORT = "export.json"
    FRAMES_SET = "frames_set.json"
    BAKED_ROOMS = "rooms.json"
    IMPORTED = "imported.json"
    DENSE_EXPORT = "dense.jsonl"
    DENSE_SET = "dense_set.json"
    UNFINISHED = ".phibench-working"
    LOCKED = ".phibench-lock"


class TruthFile(StrEnum):
    """Files that tell the truth wherever they lie, each by itself; isolation hides them from methods."""

    MANIFEST = "manifest.jsonl"
    TABLE = "manifest.parquet"
    RIGS = "rigs.jsonl"
    ROOMS = "rooms.jsonl"
    JOURNAL = "journal.txt"
    SENSITIVITIES = "sensitivities.parquet"
    FRAMES = "frames.jsonl"
    FRAMES_TABLE = "frames.parquet"
    PAIRS_TABLE = "pairs.parquet"
    SHARDS = "export.jsonl"  # of exports before journals
    FILM = "film.parquet"
    SPOTS = "spots.npz"
    LIGHTS = "lights.parquet"
    MEASURED = "pairs.csv"


SEALED_TRUTH = ".truth.json"
"""Ending of the names of files with the truth of a sealed set."""
RECORDS_SO_FAR = ".so-far.parquet"
"""Ending of the names of files with the records of a score that could not be finished."""
INFO = TruthFolder.DATASET.value
MANIFEST = TruthFile.MANIFEST.value
TABLE = TruthFile.TABLE.value
RECIPE = "recipe.toml"
RIGS = TruthFile.RIGS.value
ROOMS = TruthFile.ROOMS.value
ROOM_FILES = "rooms"
CHECKSUMS = "SHA256SUMS"
CROISSANT = "croissant.json"
RUN = "run.json"
LOG = "log.jsonl"
JOURNAL = TruthFile.JOURNAL.value
LOCK = TruthFolder.LOCKED.value
WORKING = TruthFolder.UNFINISHED.value
DRAWS = ".phibench-draws"
CONTACT_SHEET = "contact_sheet.png"
SENSITIVITIES = TruthFile.SENSITIVITIES.value
NOT_DATA = (CHECKSUMS, RUN, LOG, JOURNAL, LOCK, WORKING, DRAWS, CONTACT_SHEET, SENSITIVITIES)
"""Files that SHA256SUMS does not list: itself, the diaries of the run, locks, and what is computed from it all."""

_WRITES = {
    "bake": r"lightmaps/{}\.npz|lightmap\.npz",
    "view": r"views/{}/(ambient|truth)\.exr|views/{}/preview\.png",
    "spot": r"spots/{}-(down|up)\.exr",
    "sample": r"previews/{}\.png",
}
"""Files of each kind of task of a data set, as patterns with a place for its id."""
_TASK_FILE = re.compile("|".join(pattern.replace("{}", _ID) for pattern in _WRITES.values()))
_WRITES_ALONE = {
    "film": r"films/{}/.+",
    "key": r"views/{}\.exr",
    "room": r"{}\.npz",
    "shard": r"{}(/[^/]+)?",
    "archive": r"{}",
}
"""The same of films, of the key views in a film's folder, of baked rooms, of exports and of releases."""


def room_file(name: str) -> str:
    """Copy of a file that the recipe names for a room."""
    return f"{ROOM_FILES}/{name}"


def light_map_file(room_id: str) -> str:
    """Light map of a room."""
    return "lightmap.npz" if room_id == ONLY_ROOM else f"lightmaps/{room_id}.npz"


def view_file(pose_id: str, name: str) -> str:
    """File of a mirror pose; `name` is "ambient", "truth" or "preview"."""
    return f"views/{pose_id}/{name}.{'png' if name == 'preview' else 'exr'}"


def spot_file(sample_id: str, position: str) -> str:
    """Spot layer of a sample at a stroke position."""
    return f"spots/{sample_id}-{position}.exr"


def preview_file(sample_id: str) -> str:
    """Picture of a sample: down and up side by side, laser on."""
    return f"previews/{sample_id}.png"


def may_write(task: str, files: Iterable[str]) -> bool:
    """True if a name is that of a task, and if all of these files are such as the task may write."""
    kind, _, name = task.partition(" ")
    pattern = (_WRITES | _WRITES_ALONE).get(kind)
    if pattern is None or not re.fullmatch(_ID if kind in _WRITES else FILE_NAME, name):
        return False
    if kind == "bake":
        return set(files) <= {light_map_file(name)}
    return all(re.fullmatch(pattern.replace("{}", re.escape(name)), file) for file in files)


def is_task_file(name: str) -> bool:
    """True for names of files that tasks write: the light map, a view's, a spot's or a preview's."""
    return _TASK_FILE.fullmatch(name) is not None
