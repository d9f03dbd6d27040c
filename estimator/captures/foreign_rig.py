"""Camera calibrations of other programs that are given as a rig file: which numbers to copy, or why there are none.

Known are OpenCV (YAML, XML, JSON), ROS (camera_info as file or message), Kalibr (camchain), CamOdoCal, Basalt and
OCamCalib. They are looked at as text, without a parser of their formats: it is only told what they hold. Pixels are
counted alike: 0 is the middle of the first, but OCamCalib has no focal length at all.

[rig] has a pinhole with k1, k2, p1, p2, k3 of OpenCV ("plumb_bob", "radtan"). Models of Mei, Scaramuzza and the like
describe mirror and camera in one, and cannot be split.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

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
    """What a file holds: size (w, h), (fx, fy, cx, cy), distortion coefficients; and models by their names."""

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
    """What of the file's distortion [rig] cannot hold."""
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
