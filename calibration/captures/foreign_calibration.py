"""Calibration files of other programs (OpenCV, ROS, COLMAP) given as a rig file: recognised; an error tells what to do.

Known are OpenCV (YAML, XML, JSON), ROS (camera_info: file, message, INI), Kalibr (camchain and results), EuRoC,
CamOdoCal, Basalt, ORB-SLAM, COLMAP, Nerfstudio, RealSense, Metashape, MATLAB, Bouguet's toolbox and OCamCalib. They are
looked at as text, without a parser of their formats. Others are known by plain numbers fx, fy, cx and cy.

Most count pixels as [rig] does: 0 is the middle of the first. For COLMAP, Nerfstudio and Metashape it is 0.5, for
MATLAB 1, which names rows before columns, too. [rig] has a pinhole with k1, k2, p1, p2, k3 of OpenCV ("plumb_bob",
"radtan"). Models of Mei, Scaramuzza and the like describe mirror and camera in one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MANY = 4096  # characters after a key in which its numbers stand

_MATRIX = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "cameraMatrix1", "mtx", "K", "M1", "k")
_DISTORTION = (
    "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distcoeffs", "distortion", "dist", "D", "D1", "d",
)  # fmt: skip
_WIDTH, _HEIGHT = ("image_width", "width", "Camera.width"), ("image_height", "height", "Camera.height")
_BOTH_SIDES = ("width", "height")
_BOTH = ("resolution", "image_size", "imagesize", "img_size", "image_dimension")
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
_PINHOLE_ONLY = (
    "radtan", "plumb_bob", "plumb bob", "none", "pinhole", "brown", "rational_polynomial", "", "radial-tangential",
    "radialtangential", "opencv", "brown_conrady", "simple_pinhole",
)  # fmt: skip
_WITHOUT_MIRROR = (
    "calibrate the camera without the mirror, as a pinhole with a chessboard, write its fx_px, fy_px, cx_px, cy_px, "
    "k1, k2, p1, p2 and k3 into [rig] of a TOML file, and radius_m and z_c_m of the mirror by a ruler"
)


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
    skew: float = 0.0
    binning: tuple[float, ...] = ()


def foreign_calibration_fault(text: str) -> str:
    """Fault of a rig file that is a calibration of another program: what to do with it; "" if it is none."""
    if re.search(r'"kind":\s*"phibench calibration"', text):
        return "is a calibration of `phibench calibrate`: give it with --calibration, and a rig file with --rig"
    calibration = next((calibration for known in _PROGRAMS if (calibration := known(text)) is not None), None)
    if calibration is None:
        return _no_toml(text)
    start = f"is a calibration of {calibration.program}, not a rig file"
    if calibration.in_one:
        both = f"holds mirror and camera in one ({calibration.in_one}), which cannot be split"
        return f"{start}, and {both}; {_WITHOUT_MIRROR}"
    if not calibration.focal:
        return f"{start}, and has no focal length; write fx_px, fy_px, cx_px and cy_px into [rig] of a TOML file"
    keys = _rig_keys(calibration)
    several = f" (of its first camera of {calibration.cameras})" if calibration.cameras > 1 else ""
    beyond = _beyond(calibration)
    return (
        f"{start}; write a TOML file with [rig]{several} and {', '.join(keys)}, one key a line, and add radius_m and "
        f"z_c_m of the mirror, which no calibration of a camera knows{beyond}"
    )


_LANGUAGES = {"JSON": r"\s*[{\[]\s*[\"{\]}]", "XML": r"\s*<", "YAML": r"(?m)(\A%YAML|\A---|^\s*[\w-]+:(\s|$))"}


def _no_toml(text: str) -> str:
    """Fault of a text in another language than TOML; "" where none is known."""
    language = next((name for name, start in _LANGUAGES.items() if re.match(start, text)), "")
    if not language:
        return ""
    return f"is not valid TOML but {language}: write a line [rig], and below it a line for each key, as fx_px = 1430.0"


def foreign_container_fault(data: bytes) -> str:
    """Fault of a rig file that is no text but arrays of MATLAB or NumPy; "" if it is none."""
    if data.startswith(b"MATLAB"):
        return (
            "is a MATLAB file, which is not read; if it is of Bouguet's toolbox, give its Calib_Results.m, or write "
            "fc as fx_px and fy_px, cc as cx_px and cy_px, kc as k1, k2, p1, p2 and k3 into [rig] of a TOML file; if "
            f"it is of OCamCalib, it holds mirror and camera in one, which cannot be split; {_WITHOUT_MIRROR}"
        )
    if data.startswith((b"\x89PNG", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM")):
        return "is a picture: give it with --down, --up or the like, and the numbers of the rig with --rig"
    if data.startswith((b"PK\x03\x04", b"\x93NUMPY", b"\x80\x04", b"\x80\x03")):
        return (
            "holds arrays of NumPy or a pickle, which is not read; write K[0, 0] as fx_px, K[1, 1] as fy_px, K[0, 2] "
            "as cx_px, K[1, 2] as cy_px and the distortion as k1, k2, p1, p2, k3 into [rig] of a TOML file"
        )
    return ""


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
    if max(found.binning, default=1.0) > 1.0:
        return (
            f"; pictures are binned {' x '.join(f'{x:g}' for x in found.binning)}, and these numbers are of the whole "
            "sensor: calibrate with binned pictures"
        )
    lost = [name for name, x in zip(_BEYOND, found.distortion[5:8], strict=False) if x != 0.0]  # k4 to k6
    if found.skew:
        return f"; its skew of {found.skew:g} has no key in [rig]: calibrate without it"
    return f"; its {', '.join(lost)} have no keys in [rig]: calibrate without the rational model" if lost else ""


# -- formats ----------------------------------------------------------------------------------------------------------


def _numbers(text: str, at: int, count: int) -> tuple[float, ...]:
    """Numbers that follow a place of a text, after the head of a matrix: rows, cols, dt, type ids, brackets."""
    piece = text[at : at + _MANY]
    head = re.search(r"data\s*[\"']?\s*:|<data>", piece) if count > 2 else None
    if head is not None and "[" not in piece[: head.start()]:  # of a matrix with a head; else of the next one
        piece = piece[head.end() :]
    list_ = re.match(rf"[\s:>\"'=\[\(,\-]*?((?:[\[\(,\s\-]*{_NUMBER}[\]\),]*\s*)+)", piece)
    if list_ is None:
        return ()
    return tuple(float(x) for x in re.findall(_NUMBER, re.sub(r"(?m)^\s*-\s+", " ", list_[1])))[:count]


def _key(text: str, names: tuple[str, ...]) -> int | None:
    """Place after the first of some keys, of YAML, JSON or XML, as they are written or in other cases."""
    for name in names:
        flags = "" if len(name) <= 2 else "(?i)"
        match = re.search(rf"{flags}(?:^|[\s{{,\"'<]){re.escape(name)}[\"']?\s*(?::|=|>|\stype_id=[^>]*>)", text)
        if match is not None:
            return match.end()
    return None


def _values(text: str, names: tuple[str, ...], count: int) -> tuple[float, ...]:
    at = _key(text, names)
    return () if at is None else _numbers(text, at, count)


def _word(text: str, names: tuple[str, ...]) -> str:
    at = _key(text, names)
    match = None if at is None else re.match(r"[\s\"']*([A-Za-z_][\w -]*)", text[at:])
    return "" if match is None else match[1].strip()


def _size(text: str) -> tuple[float, ...]:
    width, height = _values(text, _WIDTH, 1), _values(text, _HEIGHT, 1)
    return (*width, *height) if width and height else _values(text, _BOTH, 2)


def _scalars(text: str, names: tuple[tuple[str, ...], ...]) -> tuple[float, ...]:
    """One number for each of some keys, each under any of its names; none if one is missing."""
    numbers = tuple(x for keys in names for x in _values(text, keys, 1))
    return numbers if len(numbers) == len(names) else ()


def _ocamcalib(text: str) -> _Found | None:
    if re.search(r"(?i)polynomial coefficients for the (DIRECT|inverse) mapping", text):
        return _Found("OCamCalib", in_one=_IN_ONE["ocamcalib"])
    return None


def _kalibr(text: str) -> _Found | None:
    """Camchain of Kalibr: `cam0` with `camera_model`, `intrinsics`, `distortion_model`, `resolution`; EuRoC has one."""
    if re.search(r"(?m)^\s*projection: \[.*\+-", text):  # its results as text
        return _Found("Kalibr", (), _values(text, ("projection",), 4), _values(text, ("distortion",), 4))
    cameras = len(re.findall(r"(?m)^\s*cam\d+\s*:", text)) or int("rate_hz" in text)
    if not cameras or _key(text, ("intrinsics",)) is None:
        return None
    model, numbers = _word(text, ("camera_model",)).lower(), _values(text, ("intrinsics",), 6)
    in_one = next((words for name, words in _IN_ONE.items() if model == name), "")
    coefficients = _values(text, ("distortion_coeffs", "distortion_coefficients"), 5)
    program, distortion = "EuRoC" if "rate_hz" in text else "Kalibr", _word(text, ("distortion_model",))
    return _Found(program, _size(text), numbers[:4], coefficients, distortion, in_one, cameras)


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
    """OpenCV's storage, ROS's camera_info, or a matrix and coefficients as somebody dumped them."""
    matrix = _values(text, _MATRIX, 9)
    # its storage begins so; a dump names it near the top
    opencv = "%YAML" in text[:100] or "opencv" in text[:4000].lower()
    if len(matrix) == 9 and matrix[6] and not matrix[2]:  # by columns, as Open3D writes it
        matrix = (matrix[0], matrix[3], matrix[6], matrix[1], matrix[4], matrix[7], matrix[2], matrix[5], matrix[8])
    if len(matrix) < 9 or matrix[3] or matrix[8] != 1.0:
        return _Found("OpenCV") if opencv else None
    ros = not opencv and bool(_size(text))
    in_one = _IN_ONE["xi"] if _key(text, ("xi",)) is not None else ""
    focal = (matrix[0], matrix[4], matrix[2], matrix[5])
    model = _word(text, ("distortion_model",)) or ("fisheye" if "fisheye" in text.lower() else "")
    program = "ROS (camera_info)" if ros else "OpenCV" if opencv else "OpenCV or another program"
    cameras, lens = 1 + (_key(text, ("M2", "cameraMatrix2")) is not None), _values(text, _DISTORTION, 8)
    binning = _scalars(text, (("binning_x",), ("binning_y",)))
    return _Found(program, _size(text), focal, lens, model, in_one, cameras, matrix[1], binning)


def _camodocal(text: str) -> _Found | None:
    model = _word(text, ("model_type",))
    if not model:
        return None
    focal = _scalars(text, (("fx", "gamma1", "mu"), ("fy", "gamma2", "mv"), ("cx", "u0"), ("cy", "v0")))
    kind = "" if model.lower() == "pinhole" else model
    coefficients = _scalars(text, tuple((key,) for key in _KEYS[:4]))
    return _Found("CamOdoCal", _size(text), focal, coefficients, kind, _IN_ONE.get(model.lower(), ""))


def _orb_slam(text: str) -> _Found | None:
    prefix = re.search(r"(?m)^\s*(Camera\d?)\.fx\s*:", text)
    if prefix is None:
        return None

    def named(*keys: str) -> tuple[tuple[str, ...], ...]:
        return tuple((f"{prefix[1]}.{key}",) for key in keys)

    kind = _word(text, (f"{prefix[1]}.type", "Camera.type"))
    coefficients = _scalars(text, named("k1", "k2", "p1", "p2"))
    third = _scalars(text, named("k3")) if coefficients else ()
    return _Found(
        "ORB-SLAM",
        _size(text),
        _scalars(text, named("fx", "fy", "cx", "cy")),
        (*coefficients, *third),
        "" if kind in ("", "PinHole", "Rectified") else kind,
        cameras=1 + ("Camera2.fx" in text),
    )


def _bouguet(text: str) -> _Found | None:
    """Calib_Results.m of Bouguet's toolbox: fc, cc, kc, nx, ny."""
    if not (re.search(r"(?m)^fc\s*=\s*\[", text) and re.search(r"(?m)^cc\s*=\s*\[", text)):
        return None

    def row(name: str, count: int) -> tuple[float, ...]:
        found = re.search(rf"(?m)^{name}\s*=([^\n]*)", text)
        return () if found is None else tuple(float(x) for x in re.findall(_NUMBER, found[1]))[:count]

    skew = (*row("alpha_c", 1), 0.0)[0]
    size = (*row("nx", 1), *row("ny", 1))
    return _Found("Bouguet's toolbox", size, (*row("fc", 2), *row("cc", 2)), row("kc", 5), skew=skew)


def _matlab(text: str) -> _Found | None:
    """MATLAB's cameraParameters or cameraIntrinsics, as jsonencode or disp writes them: first pixel 1, rows first."""
    focal, place = (_values(text, (name,), 2) for name in ("FocalLength", "PrincipalPoint"))
    if "RadialDistortion" not in text or len(focal) + len(place) < len(_COLMAP["PINHOLE"]):
        return None
    k1, k2, k3 = (*_values(text, ("RadialDistortion",), 3), 0.0, 0.0, 0.0)[:3]
    p1, p2 = (*_values(text, ("TangentialDistortion",), 2), 0.0, 0.0)[:2]
    skew, size = (*_values(text, ("Skew",), 1), 0.0)[0], _values(text, ("ImageSize",), 2)[::-1]
    return _Found("MATLAB", size, (*focal, place[0] - 1.0, place[1] - 1.0), (k1, k2, p1, p2, k3), skew=skew)


def _ros_ini(text: str) -> _Found | None:
    """INI file of ROS's camera_calibration_parsers: names and numbers in lines of their own."""
    matrix = re.search(rf"(?m)^camera matrix\s+((?:{_NUMBER}\s+){{9}})", text)
    if matrix is None:
        return None
    size = re.search(r"(?m)^width\s+(\d+)\s+height\s+(\d+)", text)
    lens = re.search(rf"(?m)^distortion\s+((?:{_NUMBER}\s+){{4,8}})", text)
    fx, skew, cx, _, fy, cy, *_ = (float(x) for x in matrix[1].split())
    coefficients = () if lens is None else tuple(float(x) for x in lens[1].split())
    whole = () if size is None else (float(size[1]), float(size[2]))
    return _Found("ROS (INI)", whole, (fx, fy, cx, cy), coefficients, skew=skew)


_COLMAP = {  # places of fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 among a model's numbers
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": tuple(range(12)),
    "OPENCV_FISHEYE": (0, 1, 2, 3),
    "THIN_PRISM_FISHEYE": (0, 1, 2, 3),
    "RADIAL_FISHEYE": (0, 0, 1, 2),
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2),
    "FOV": (0, 1, 2, 3),
}


def _colmap(text: str) -> _Found | None:
    """cameras.txt of COLMAP, whose first pixel's middle is at 0.5."""
    rows = re.findall(r"(?m)^\d+[ \t]+([A-Z_]+)[ \t]+(\d+)[ \t]+(\d+)((?:[ \t]+[-+.\deE]+)+)[ \t]*$", text)
    rows = [row for row in rows if row[0] in _COLMAP]
    if not rows:
        return None
    model, width, height, words = rows[0]
    numbers, places = tuple(float(x) for x in words.split()), _COLMAP[model]
    if max(places) >= len(numbers):
        return _Found("COLMAP")
    fx, fy, cx, cy, *lens = (numbers[place] for place in places)
    kind = model if model.endswith(("FISHEYE", "FOV")) else ""
    return _Found(
        "COLMAP", (float(width), float(height)), (fx, fy, cx - 0.5, cy - 0.5), tuple(lens), kind, "", len(rows)
    )


def _metashape(text: str) -> _Found | None:
    """Agisoft's XML: cx, cy from the picture's middle, p1 and p2 in the other order than OpenCV's, b1 as fx - fy."""
    if "<calibration" not in text or _key(text, ("projection",)) is None:
        return None
    size, focal = _size(text), _values(text, ("f",), 1)
    if len(size) < len(_BOTH_SIDES) or not focal:
        return _Found("Metashape")
    b1, cx, cy, k1, k2, k3, p1, p2 = _optional(text, ("b1", "cx", "cy", "k1", "k2", "k3", "p1", "p2"))
    place = (0.5 * (size[0] - 1.0) + cx, 0.5 * (size[1] - 1.0) + cy)
    kind = _word(text, ("projection",)).lower()
    model = "" if kind == "frame" else kind
    return _Found("Metashape", size, (focal[0] + b1, focal[0], *place), (k1, k2, p2, p1, k3), model)


def _optional(text: str, keys: Sequence[str]) -> tuple[float, ...]:
    return tuple((*_values(text, (key,), 1), 0.0)[0] for key in keys)


def _plain_numbers(text: str) -> _Found | None:
    """Numbers by their names, as many programs dump them; Nerfstudio's first pixel is at 0.5."""
    names = (("fx_px", "fl_x", "fx"), ("fy_px", "fl_y", "fy"), ("cx_px", "cx", "ppx"), ("cy_px", "cy", "ppy"))
    focal = _scalars(text, names)
    if not focal:
        return None
    nerf = _key(text, ("fl_x",)) is not None
    half = 0.5 if nerf else 0.0
    size = _scalars(text, (("w",), ("h",))) if nerf else _size(text) or _scalars(text, (("width_px",), ("height_px",)))
    lens = _values(text, ("coeffs", *_DISTORTION), 5) or _optional(text, _KEYS)
    model = _word(text, ("camera_model", "distortion_model", "model"))
    program = "Nerfstudio" if nerf else "RealSense" if _key(text, ("ppx",)) is not None else "another program"
    in_one = _IN_ONE["xi"] if _key(text, ("xi",)) is not None else _IN_ONE.get(model.lower(), "")
    return _Found(program, size, (*focal[:2], focal[2] - half, focal[3] - half), lens, model, in_one)


_PROGRAMS = (
    _ocamcalib, _kalibr, _basalt, _camodocal, _orb_slam, _bouguet, _ros_ini, _colmap, _metashape, _matlab,
    _plain_numbers, _matrix_file,
)  # fmt: skip
