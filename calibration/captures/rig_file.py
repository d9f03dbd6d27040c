"""Reader of the rig file, a small TOML file of what a person has measured of a rig; refuses foreign calibrations.

A rig file has the tables `[rig]`, `[rig.holder]` and `[laser]` of a recipe, with the same keys, so that they can be
pasted. `[rig]` takes one key more, `fov_deg`, for a camera whose data sheet names no focal length. What is left out is
that of the default rig, a C310 under a sphere of 60 mm. Without `[laser]` the size of the spot is not used.

A calibration of another program that is given in its place is told what to copy from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field

from phibench.calibration.captures.foreign_calibration import foreign_calibration, foreign_container
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.recipe.distributions import Table
from phibench.datasets.recipe.recipe_scene import build_rig, idle_holder_keys
from phibench.datasets.recipe.tables import LaserTable, RigTable
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig
from phibench.scenes.room import RIGS
from phibench.scenes.validation import Fault, SceneError, structural_faults, without_unit

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
    if faults := structural_faults(RigFile, raw):
        raise file.fault("; ".join(str(_advised(fault)) for fault in faults))
    document = RigFile.model_validate(raw)
    table = document.rig
    if idle := idle_holder_keys("rig.holder", sorted(table.holder.model_fields_set), (table.holder.kind,)):
        raise file.fault(str(idle[0]))
    if fault := _focal_fault(table):
        raise file.fault(fault)
    try:
        rig = build_rig(_with_focal_length(table))
    except SceneError as error:
        raise file.fault(f"describes no rig: {error}") from error
    return MeasuredRig(rig, None if document.laser is None else _beam(document.laser))


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


def _advised(fault: Fault) -> Fault:
    """Fault of an unknown key with what to do, where its meaning is known."""
    if not fault.unknown:
        return fault
    table, _, key = fault.path.rpartition(".")
    stem = without_unit(key)
    advice = _ADVICE.get(stem, "") if table == "rig" else ""
    if table == "rig" and key.lower().endswith("_mm") and stem in ("f", "fx", "fy", "focal", "focal_length"):
        advice = "the focal length is given in pixels: write millimetres over the pixel pitch as fx_px"
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


def _tables(file: InputFile) -> dict[str, Any]:
    """Tables of the file; a calibration of another program is told what to copy from it."""
    data = file.read()
    if fault := foreign_container(data):
        raise file.fault(fault)
    text = file.text(data, "utf-8-sig")
    try:
        return file.toml_of(text)
    except DatasetError:
        if fault := foreign_calibration(text):
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


def _beam(laser: LaserTable) -> Beam:
    if laser.diameter_m is not None:
        return Beam(laser.diameter_m, 0.0)
    return Beam(laser.diameter_base_m, laser.diameter_growth_m_per_m)


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
