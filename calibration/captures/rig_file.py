"""Reader of the rig file, a TOML file of measured numbers; errors explain wrong keys, wrong units and other files.

A rig file has the tables `[rig]`, `[rig.holder]` and `[laser]` of a recipe, with the same keys, so that they can be
pasted. `[rig]` takes one key more, `fov_deg`, for a camera whose data sheet names no focal length. What is left out is
that of the default rig, a C310 under a sphere of 60 mm. Without `[laser]` the size of the spot is not used.

A calibration of another program that is given in its place is told what to copy from it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field

from phibench.calibration.captures.foreign_calibration import foreign_calibration_fault, foreign_container_fault
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.recipe.distributions import Table
from phibench.datasets.recipe.mirror_tables import HolderTable, MirrorTable
from phibench.datasets.recipe.recipe_scene import beam_of, build_rig, idle_holder_faults
from phibench.datasets.recipe.tables import LaserTable, RigTable
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig
from phibench.scenes.room import RIGS
from phibench.scenes.validation import Fault, SceneError, printable_line, structural_faults, without_unit

_REMEDY = "docs/measure.md has an example of a rig file"


class MeasuredRigTable(RigTable):
    """`[rig]` of a rig file."""

    fov_deg: float | None = Field(
        default=None, ge=5.0, le=150.0, description="horizontal field of view, degrees; instead of fx_px"
    )


class RigFile(Table):
    """A rig file."""

    rig: MeasuredRigTable = Field(default=MeasuredRigTable(), description="camera, mirror and stroke axis")
    laser: LaserTable | None = Field(default=None, description="the laser; its diameter is used")


@dataclass(frozen=True)
class MeasuredRig:
    """Rig of a file.

    Attributes
    ----------
    rig : Rig
        Nominal: what the person has measured.
    beam : Beam or None
        Diameter of the laser's spot by the distance, where the file says it.
    """

    rig: Rig
    beam: Beam | None


def read_rig_file(path: Path) -> MeasuredRig:
    """Rig of a file.

    Raises
    ------
    DatasetError
        If the file cannot be read, has an unknown key or a value that is not allowed, or the rig cannot exist; in one
        sentence.
    """
    file = InputFile(path, _REMEDY, limit_bytes=SETTINGS_BYTES)
    raw = _tables(file)
    if fault := _other_file(raw):
        raise file.fault(fault)
    if loose := [key for key in raw if key in MeasuredRigTable.model_fields]:
        if isinstance(raw[loose[0]], dict):
            raise file.fault(f"has the table [{loose[0]}], which belongs to [rig]: write [rig.{loose[0]}]")
        raise file.fault(f"has {loose[0]} outside its table: begin the file with a line [rig]")
    unusual = {fault.path: fault for fault in unusual_numbers(raw)}
    faults = [_advised(fault, raw) for fault in structural_faults(RigFile, raw) if fault.path not in unusual]
    if faults := [*unusual.values(), *faults]:
        raise file.fault("; ".join(map(str, faults)))
    document = RigFile.model_validate(raw)
    table = document.rig
    if idle := idle_holder_faults("rig.holder", sorted(table.holder.model_fields_set), (table.holder.kind,)):
        raise file.fault(str(idle[0]))
    if fault := _focal_fault(table):
        raise file.fault(fault)
    try:
        rig = build_rig(_with_focal_length(table))
    except SceneError as error:
        raise file.fault(f"describes no rig: {error}") from error
    return MeasuredRig(rig, None if document.laser is None else beam_of(document.laser))


def _other_file(raw: dict[str, Any]) -> str:
    """Fault of a file of ours that is no rig file; "" for all others."""
    if raw.keys() & {"format", "bits", "exposure_s"}:
        return "describes frames, not a rig: `phibench sensor fit` takes their folder"
    if raw.keys() & {"adc_bits", "gain_dn_per_e", "black_level_dn", "read_noise_e", "full_well_e"}:
        return "is a sensor file: give it with --sensor, and the numbers of camera and mirror with --rig"
    if raw.keys() & {"recipe", "samples", "rooms", "targets", "sampling"}:
        return "is a recipe: copy its tables [rig], [rig.mirror], [rig.holder] and [laser] into a file of their own"
    if (preset := raw.get("preset")) is not None and preset not in RIGS:
        names = ", ".join(RIGS)
        return f"begins with a preset that is no rig's: give a sensor file with --sensor; presets of [rig] are {names}"
    return ""


_LENS = "write k1, k2, p1, p2 and k3, of OpenCV's model, each in a line of its own"
_SIZE = "write width_px and height_px"
_PLACE = "write cx_px and cy_px"
_SPHERE = "the radius of a sphere, half its diameter, is radius_m of [rig], in metres"
_FIELD = "fov_deg is the horizontal field of view: of the diagonal one, or the vertical one, write fx_px instead"
_TAPE = "D is no part of the rig: it is measured, and that of a tape stands in pairs.csv"
_STROKE = "the stroke is no part of the rig: give it with --stroke-m, or in pairs.csv"
_ADVICE = {
    **dict.fromkeys(("resolution", "image_size", "size", "shape"), _SIZE),
    **dict.fromkeys(("principal_point", "centre", "center", "c"), _PLACE),
    **dict.fromkeys(("distortion", "dist_coeffs", "distortion_coeffs", "distortion_coefficients", "d"), _LENS),
    **dict.fromkeys(("camera_matrix", "k"), "write fx_px, fy_px, cx_px and cy_px"),
    **{f"{of}{what}": _SPHERE for of in ("mirror_", "sphere_", "ball_", "r_") for what in ("radius", "diameter")},
    **dict.fromkeys(("diameter", "r"), _SPHERE),
    **dict.fromkeys(("stroke", "stroke_length", "h"), _STROKE),
    **dict.fromkeys(("vfov", "fov_v", "fov_y", "fovy", "vertical_fov", "dfov", "fov_d", "diagonal_fov"), _FIELD),
    **dict.fromkeys(("depth", "depth_sigma", "tape"), _TAPE),
    **dict.fromkeys(("laser", "beam"), "the laser has a table of its own: begin it with a line [laser]"),
}
"""What to do with unknown keys of [rig], without their units, that no key resembles, or one of another meaning."""
_UNITS = {
    "_mm": {"_m": "metres", "_um": "micrometres"}, "_cm": {"_m": "metres"}, "_m": {"_um": "micrometres"},
    "_deg": {"_rad": "radians"},
}  # fmt: skip


_OTHER_TABLES: dict[str, tuple[str, type[Table]]] = {
    "holder": ("rig.holder", HolderTable),
    "mirror": ("rig.mirror", MirrorTable),
    "laser": ("laser", LaserTable),
}


def _advised(fault: Fault, raw: dict[str, Any]) -> Fault:
    """Fault of an unknown key, or of a number that is a text, with what to do where the meaning is known."""
    table, _, key = fault.path.rpartition(".")
    if not fault.unknown:
        given = _table_of(raw, table).get(key)
        if isinstance(given, str) and _NUMBER.match(given) and "give a" in fault.text:
            advice = "a number has no quotes, no unit and a decimal point"
            return replace(fault, text=f"{fault.text}; {printable_line(given, 40)!r} is a text: {advice}")
        if isinstance(given, list) and given and isinstance(given[0], dict):
            return replace(fault, text=f"a list of tables; write [{fault.path}] with one bracket, once")
        return fault
    stem = without_unit(key)
    advice = _ADVICE.get(stem, "") if table == "rig" else ""
    if table == "rig" and key.lower().endswith("_mm") and stem in ("f", "fx", "fy", "focal", "focal_length"):
        advice = "the focal length is given in pixels: write millimetres over the pixel pitch as fx_px"
    if table == "rig":
        advice = advice or _of_another_table(key)
    for unit, names in _UNITS.items():
        for other, name in names.items():
            if (
                table == "rig"
                and key.endswith(unit)
                and key.removesuffix(unit) + other in MeasuredRigTable.model_fields
            ):
                advice = f"write {key.removesuffix(unit) + other}, in {name}"
    if table == "rig.mirror" and stem in ("radius", "diameter", "r"):
        advice = f"{_SPHERE}, and needs no [rig.mirror]"
    if not table and stem in ("camera", "sphere", "lens", "intrinsics"):
        advice = "camera and mirror are described in the table [rig]"
    if not table and stem == "sensor":
        advice = "the sensor has a file of its own: give it with --sensor"
    return replace(fault, text=f"unknown key; {advice}") if advice else fault


# -- numbers in another unit -----------------------------------------------------------------------------------------

_NUMBER = re.compile(r"\s*[-+\u2212]?[\d.,]*\d")
_LENGTHS = {"mm": 1e-3, "cm": 1e-2}
_OTHERS: dict[str, tuple[str, dict[str, float]]] = {
    "_m": ("metres", _LENGTHS),
    "_um": ("micrometres", {"nm": 1e-3, "mm": 1e3, "m": 1e6}),
    "_rad": ("radians", {"degrees": math.pi / 180.0, "mrad": 1e-3}),
    "_deg": ("degrees", {"radians": 180.0 / math.pi}),
}
"""Unit at the end of a key: its name, and others that people write there, in it."""
_SMALL_RAD, _SMALL_M = (-0.2, 0.2), (-0.03, 0.03)  # a rig is upright to ten degrees, its mirror centred to some mm
_USUAL = {
    "rig": {
        "radius_m": (0.002, 0.5), "z_c_m": (0.01, 3.0), "camera_height_m": (0.34, 10.0), "pixel_pitch_um": (0.3, 100.0),
        "fx_px": (50.0, 50_000.0), "fy_px": (50.0, 50_000.0), "fov_deg": (5.0, 150.0), "focus_distance_m": (0.01, 20.0),
        **dict.fromkeys(("tilt_x_rad", "tilt_y_rad", "stroke_tilt_x_rad", "stroke_tilt_y_rad"), _SMALL_RAD),
        **dict.fromkeys(("decentre_x_m", "decentre_y_m"), _SMALL_M),
    },
    "rig.mirror": {
        "rim_radius_m": (0.002, 0.5), "vertex_radius_m": (1e-4, 2.0), "half_angle_deg": (3.0, 87.0),
        **dict.fromkeys(("tilt_x_rad", "tilt_y_rad"), _SMALL_RAD),
    },
    "rig.holder": dict.fromkeys(("radius_m", "circle_m", "plate_m", "rise_m", "wall_m"), (1e-4, 0.5)),
    "laser": {"diameter_m": (1e-4, 0.1), "diameter_base_m": (0.0, 0.1), "diameter_growth_m_per_m": (0.0, 0.1)},
}  # fmt: skip
"""Least and most of each number of a rig that fits on a table; what lies beyond is of another unit."""


def unusual_numbers(raw: dict[str, Any]) -> list[Fault]:
    """Faults of numbers that no usual rig has but another unit explains: value, usual range, and what to write."""
    faults = []
    for table, ranges in _USUAL.items():
        given = _table_of(raw, table)
        for key, (low, high) in ranges.items():
            value = given.get(key)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or low <= value <= high:
                continue
            if text := _in_other_units(key, float(value), (low, high), _pitch_um(raw)):
                faults.append(Fault(f"{table}.{key}", text))
    return faults


def _in_other_units(key: str, value: float, usual: tuple[float, float], pitch_um: float) -> str:
    """Words on a number that is usual if it has another unit; "" where none makes it usual."""
    low, high = usual
    name, others = next((unit for end, unit in _OTHERS.items() if key.endswith(end)), _OTHERS["_m"])
    end = ""
    if key.endswith("_px"):
        name, others, end = "pixels", {"mm": 1e3 / pitch_um, "m": 1e6 / pitch_um}, f", at pixels of {pitch_um:g} um"
    meant = {unit: value * factor for unit, factor in others.items() if low <= value * factor <= high}
    if not meant:
        return ""
    advice = " or ".join(f"{converted:.6g} if it is {value:g} {unit}" for unit, converted in meant.items())
    return f"{value:g} is unusual, {low:g} to {high:g} {name} are usual; write {advice}{end}"


def _of_another_table(key: str) -> str:
    """Advice on a key of [rig] that is one of another table, also with that table's name before it."""
    for name, (path, model) in _OTHER_TABLES.items():
        inner = key.removeprefix(f"{name}_")
        if inner in model.model_fields:
            return f"{inner} belongs to the table [{path}]: begin that with a line of its own, below those of [rig]"
    return ""


def _table_of(raw: dict[str, Any], path: str) -> dict[str, Any]:
    """Table of a path such as "rig.mirror"; an empty one where there is none."""
    found: object = raw
    for key in filter(None, path.split(".")):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}


def _pitch_um(raw: dict[str, Any]) -> float:
    """Pixel pitch of the file where it is usual, else that of the default rig."""
    pitch = _table_of(raw, "rig").get("pixel_pitch_um")
    low, high = _USUAL["rig"]["pixel_pitch_um"]
    return float(pitch) if isinstance(pitch, (int, float)) and low <= pitch <= high else Rig().camera.pixel_pitch_um


def _tables(file: InputFile) -> dict[str, Any]:
    """Tables of the file; a calibration of another program is told what to copy from it."""
    data = file.read()
    if fault := foreign_container_fault(data):
        raise file.fault(fault)
    text = file.text(data, "utf-8-sig")
    try:
        return file.toml_of(text)
    except DatasetError:
        if fault := foreign_calibration_fault(text):
            raise file.fault(fault) from None
        raise


def _focal_fault(table: MeasuredRigTable) -> str:
    """Fault of the keys of the focal length; "" if there is none."""
    focal = table.fx_px is not None or table.fy_px is not None
    if focal and table.fov_deg is not None:
        return "rig.fov_deg: the focal length is given twice, in pixels, too; keep fx_px or fov_deg"
    camera = RIGS[table.preset]().camera
    other = table.width_px not in (None, camera.width_px) or table.height_px not in (None, camera.height_px)
    if other and not focal and table.fov_deg is None:
        return (
            f"rig.fx_px: missing; the focal length of {camera.width_px} x {camera.height_px} pixels does not hold for "
            "another size; add fx_px or fov_deg"
        )
    return ""


def _with_focal_length(table: MeasuredRigTable) -> RigTable:
    if table.fov_deg is None:
        return table
    width = RIGS[table.preset]().camera.width_px if table.width_px is None else table.width_px
    return table.model_copy(update={"fx_px": 0.5 * width / math.tan(math.radians(0.5 * table.fov_deg))})


def require_camera_size(rig: Rig, size_px: tuple[int, int], name: str) -> None:
    """Refuse pictures of another size than the rig's camera.

    Raises
    ------
    DatasetError
        In one sentence.
    """
    camera = rig.camera
    if size_px != (camera.width_px, camera.height_px):
        raise DatasetError(
            f"{name} has {size_px[0]} x {size_px[1]} pixels, the camera of the rig file {camera.width_px} x "
            f"{camera.height_px}; write width_px, height_px and the focal length of this picture into [rig]"
        )
