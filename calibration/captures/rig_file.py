"""Rig file: what a person has measured of a real rig, as a small TOML file.

A rig file has the tables `[rig]`, `[rig.holder]` and `[laser]` of a recipe, with the same keys, so that they can be
pasted. `[rig]` takes one key more, `fov_deg`, for a camera whose data sheet names no focal length. What is left out is
that of the default rig, a C310 under a sphere of 60 mm. Without `[laser]` the size of the spot is not used.

A calibration of another program that is given in its place is told what to copy from it: OpenCV (YAML, XML, JSON), ROS
(camera_info, file or message), Kalibr (camchain), CamOdoCal, Basalt and OCamCalib. They are looked at as text, without
a parser of their formats. Pixels are counted alike: 0 is the middle of the first. [rig] has a pinhole with k1, k2, p1,
p2, k3 of OpenCV ("plumb_bob", "radtan"). Models of Mei, Scaramuzza and the like describe mirror and camera in one.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from phibench.datasets.errors import DatasetError
from phibench.datasets.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.recipe.build import build_rig, idle_holder_keys
from phibench.datasets.recipe.distributions import Table
from phibench.datasets.recipe.tables import LaserTable, RigTable
from phibench.scenes.catalog import RIGS
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError, structural_faults

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
    if faults := structural_faults(RigFile, raw):
        raise file.fault("; ".join(str(fault) for fault in faults))
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


def _tables(file: InputFile) -> dict[str, Any]:
    """Tables of the file; a calibration of another program is told what to copy from it."""
    data = file.read()
    if data.startswith(b"MATLAB"):
        raise file.fault(foreign_calibration("MATLAB 5.0"))
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


# -- calibrations of other programs -----------------------------------------------------------------------------------

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MANY = 4096  # characters after a key in which its numbers stand

_MATRIX = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "cameraMatrix1", "mtx", "K", "M1", "k")
_DISTORTION = (
    *(
        "distortion_coefficients",
        "distortion_coeffs",
        "dist_coeffs",
        "distcoeffs",
        "distortion",
        "dist",
        "D",
        "D1",
        "d",
    ),
)
_WIDTH, _HEIGHT = ("image_width", "width", "imageWidth"), ("image_height", "height", "imageHeight")
_IN_ONE = {
    "ocamcalib": "OCamCalib's polynomial",
    "omni": "the model 'omni' of Mei",
    "mei": "the model of Mei",
    "xi": "Mei's model with xi",
    "scaramuzza": "Scaramuzza's polynomial",
    "ds": "the double sphere model",
    "eucm": "the extended unified model",
    "ucm": "the unified model",
}
_KEYS = ("k1", "k2", "p1", "p2", "k3")
_BEYOND = ("k4", "k5", "k6")
_PINHOLE_ONLY = "radtan", "plumb_bob", "plumb bob", "none", "pinhole", "brown", "rational_polynomial", ""


@dataclass(frozen=True)
class _Found:
    """Size (w, h), (fx, fy, cx, cy) and distortion coefficients of a file; and models by their names."""

    program: str
    size: tuple[float, ...] = ()
    focal: tuple[float, ...] = ()
    distortion: tuple[float, ...] = ()
    model: str = ""
    in_one: str = ""
    cameras: int = 1


def foreign_calibration(text: str) -> str:
    """Fault of a rig file that is a calibration of another program: what to do with it; "" if it is none."""
    found = _ocamcalib(text) or _kalibr(text) or _basalt(text) or _matrix_file(text)
    if found is None:
        return ""
    start = f"is a calibration of {found.program}, not a rig file"
    if found.in_one:
        return (
            f"{start}, and holds mirror and camera in one ({found.in_one}), which cannot be split; calibrate the "
            "camera without the mirror, as a pinhole with a chessboard, write its fx_px, fy_px, cx_px, cy_px, k1, k2, "
            "p1, p2 and k3 into [rig] of a TOML file, and radius_m and z_c_m of the mirror by a ruler"
        )
    if not found.focal:
        return f"{start}, and has no focal length; write fx_px, fy_px, cx_px and cy_px into [rig] of a TOML file"
    keys = _rig_keys(found)
    several = f" (of its first camera of {found.cameras})" if found.cameras > 1 else ""
    beyond = _beyond(found)
    return (
        f"{start}; write a TOML file with [rig]{several} and {', '.join(keys)}, one key a line, and add radius_m and "
        f"z_c_m of the mirror, which no calibration of a camera knows{beyond}"
    )


def _rig_keys(found: _Found) -> list[str]:
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    keys = [f"{name} = {value:g}" for name, value in zip(("width_px", "height_px"), found.size, strict=False)]
    keys += [f"{name} = {value:.8g}" for name, value in zip(names, found.focal, strict=False)]
    if found.model.lower() in _PINHOLE_ONLY:
        keys += [f"{key} = {x:.8g}" for key, x in zip(_KEYS, found.distortion, strict=False) if x != 0.0]
    return keys


def _beyond(found: _Found) -> str:
    """Say what of the file's distortion [rig] cannot hold."""
    if found.model.lower() not in _PINHOLE_ONLY:
        return f"; its distortion '{found.model}' has no keys in [rig]: calibrate with k1, k2, p1, p2, k3 ('radtan')"
    lost = [name for name, x in zip(_BEYOND, found.distortion[5:8], strict=False) if x != 0.0]
    return f"; its {', '.join(lost)} have no keys in [rig]: calibrate without the rational model" if lost else ""


# -- formats ----------------------------------------------------------------------------------------------------------


def _numbers(text: str, at: int, count: int) -> tuple[float, ...]:
    """Numbers that follow a place of a text, after the head of a matrix: rows, cols, dt, type ids, brackets."""
    part = text[at : at + _MANY]
    head = re.search(r"data\s*[\"']?\s*:|<data>", part) if count > 2 else None
    if head is not None and "[" not in part[: head.start()]:  # of a matrix with a head; else of the next one
        part = part[head.end() :]
    list_ = re.match(rf"[\s:>\"'=\[\(,\-]*?((?:[\[\(,\s\-]*{_NUMBER}[\]\),]*\s*)+)", part)
    if list_ is None:
        return ()
    return tuple(float(x) for x in re.findall(_NUMBER, re.sub(r"(?m)^\s*-\s+", " ", list_[1])))[:count]


def _key(text: str, names: tuple[str, ...]) -> int | None:
    """Place after the first of some keys, of YAML, JSON or XML, as they are written or in other cases."""
    for name in names:
        flags = "" if len(name) <= 2 else "(?i)"
        found = re.search(rf"{flags}(?:^|[\s{{,\"'<]){re.escape(name)}[\"']?\s*(?::|=|>|\stype_id=[^>]*>)", text)
        if found is not None:
            return found.end()
    return None


def _values(text: str, names: tuple[str, ...], count: int) -> tuple[float, ...]:
    at = _key(text, names)
    return () if at is None else _numbers(text, at, count)


def _word(text: str, names: tuple[str, ...]) -> str:
    at = _key(text, names)
    found = None if at is None else re.match(r"[\s\"']*([A-Za-z_][\w ]*)", text[at:])
    return "" if found is None else found[1].strip()


def _size(text: str) -> tuple[float, ...]:
    width, height = _values(text, _WIDTH, 1), _values(text, _HEIGHT, 1)
    return (*width, *height) if width and height else ()


def _ocamcalib(text: str) -> _Found | None:
    if re.search(r"(?i)polynomial coefficients for the (DIRECT|inverse) mapping", text) or text.startswith(
        "MATLAB 5.0"
    ):
        return _Found("OCamCalib", in_one=_IN_ONE["ocamcalib"])
    return None


def _kalibr(text: str) -> _Found | None:
    """Camchain of Kalibr: `cam0` with `camera_model`, `intrinsics`, `distortion_model`, `resolution`."""
    cameras = len(re.findall(r"(?m)^\s*cam\d+\s*:", text))
    if not cameras or _key(text, ("intrinsics",)) is None:
        return None
    model, numbers = _word(text, ("camera_model",)).lower(), _values(text, ("intrinsics",), 6)
    in_one = next((words for name, words in _IN_ONE.items() if model == name), "")
    found = _Found("Kalibr", _values(text, ("resolution",), 2), numbers[:4], cameras=cameras, in_one=in_one)
    coefficients = _values(text, ("distortion_coeffs",), 5)
    distortion = _word(text, ("distortion_model",))
    return _Found(found.program, found.size, found.focal, coefficients, distortion, found.in_one, found.cameras)


def _basalt(text: str) -> _Found | None:
    model = re.search(r'"camera_type"\s*:\s*"([\w-]+)"', text)
    if model is None:
        return None
    numbers = [re.search(rf'"{name}"\s*:\s*({_NUMBER})', text) for name in ("fx", "fy", "cx", "cy")]
    focal = tuple(float(x[1]) for x in numbers if x is not None)
    name = model[1].lower()
    kind = "" if name.startswith("pinhole") else model[1]
    return _Found("Basalt", (), focal if len(focal) == 4 else (), (), kind, _IN_ONE.get(name, ""))


def _matrix_file(text: str) -> _Found | None:
    """OpenCV's storage, ROS's camera_info, CamOdoCal, or a matrix and coefficients as somebody dumped them."""
    if model := _word(text, ("model_type",)):  # CamOdoCal
        in_one = _IN_ONE.get(model.lower(), "")
        keys = (("fx", "gamma1"), ("fy", "gamma2"), ("cx", "u0"), ("cy", "v0"))
        focal = tuple(x for key in keys for x in _values(text, key, 1))
        coefficients = tuple(x for key in ("k1", "k2", "p1", "p2") for x in _values(text, (key,), 1))
        kind = "" if model.lower() == "pinhole" else model
        return _Found("CamOdoCal", _size(text), focal if len(focal) == 4 else (), coefficients, kind, in_one)
    matrix = _values(text, _MATRIX, 9)
    opencv = "%YAML" in text[:100] or "opencv" in text[:4000].lower()
    if len(matrix) < 9 or matrix[1] or matrix[3] or matrix[8] != 1.0:
        return _Found("OpenCV") if opencv else None
    ros = not opencv and bool(_size(text))
    in_one = _IN_ONE["xi"] if _key(text, ("xi",)) is not None else ""
    focal = (matrix[0], matrix[4], matrix[2], matrix[5])
    model = _word(text, ("distortion_model",)) or ("fisheye" if "fisheye" in text.lower() else "")
    program = "ROS (camera_info)" if ros else "OpenCV" if opencv else "OpenCV or another program"
    return _Found(program, _size(text), focal, _values(text, _DISTORTION, 8), model, in_one)
