"""Reader of pictures as linear light: photographs with colour profiles, OpenEXR, Radiance HDR; checks of panoramas.

Photographs of 8 bits are turned upright as their EXIF data say. They count as sRGB, unless a colour profile or a PNG's
gamma says otherwise: then their codes are converted. EXR and HDR files hold linear values. All give an array of bands
R, G, B in any unit, upper row first.

What Photo Sphere XMP (GPano; Google, 2013) says of a panorama counts: a crop, another projection and a camera that was
not level are refused. So are holes, whose colour nobody saw.

Radiance HDR: G. Ward, in Graphics Gems II (1991); a pixel holds three mantissas and an exponent e, and means
mantissa x 2^(e - 136), over all exposures and corrections of colour. Rows may be run-length coded, a byte plane at a
time. Crops, cube maps and other primaries than Rec. 709 are refused.
"""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from phibench.datasets.common.camera_pictures import FORMATS, IN_WORDS, read_camera_picture
from phibench.datasets.common.input_files import PICTURE_PIXELS, InputFile, quiet_terminal
from phibench.datasets.rooms.mesh_parts import opacity_of
from phibench.datasets.rooms.room_files import RoomError
from phibench.render.sensor.srgb import srgb_decoded, srgb_encoded
from phibench.scenes.frames import Array
from phibench.scenes.validation import printable_line

Light = NDArray[np.float32]
"""Shape (rows, columns, 3), linear, 0 or more, finite."""

ASPECT = 2.0  # columns over rows of an equirectangular picture
_ASPECT_TOLERANCE = 0.01  # a picture that was scaled has lost a row or column
_LEAST_ROWS = 16
_REMEDY = f"give a picture as {IN_WORDS}, OpenEXR or Radiance HDR, of at most {PICTURE_PIXELS:.0e} pixels"
_HDR_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_OVERSHOOT = 0.01  # of the light, below 0
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXR_VALUES = 4 * PICTURE_PIXELS  # of all channels: R, G, B and A of the largest picture
_PRIMARIES = np.array([0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290])  # Rec. 709, white last
_OFF = 0.025  # of a coordinate: Radiance's own have green at 0.29 and white at 1/3
_EXPOSURE = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_ROWS = 256  # decoded at once
_GPANO = re.compile(rb"<GPano:(\w+)>([^<]*)<|\bGPano:(\w+)\s*=\s*[\"']([^\"']*)")  # element, or attribute
_XMP_BYTES = 1 << 16  # a JPEG's part ends there
_DARK = 0.02  # of the light beside; a black of JPEG, with some glare
_SIZES = ("CroppedAreaImage", "FullPano")
_LEVEL_DEG = 1.0  # a wall 3 m away is off by 5 cm
_SAME_CODES = 2  # by which profiles of sRGB differ from each other
_SRGB_GAMMA, _SAME_GAMMA, _GAMMAS = 0.45455, 0.01, (0.1, 10.0)  # gAMA of PNG
_INTEROPERABILITY = 0xA005  # EXIF's table of the colours that a camera chose
_STEPS = np.arange(0, 256, 15, dtype=np.uint8)
_SOME_CODES = np.stack(np.meshgrid(_STEPS, _STEPS, _STEPS), axis=-1).reshape(1, -1, 3)


def read_panorama(path: Path) -> Light:
    """Linear light of an equirectangular picture.

    Raises
    ------
    RoomError
        If the file cannot be read, is a crop, tilted or of another projection, has holes, or its sides are not 2 : 1
        within 1 %.
    """
    light = read_light(path)
    rows, columns = light.shape[:2]
    file = InputFile(path, _REMEDY, RoomError)
    _check_sphere(file, columns, rows)
    if rows < _LEAST_ROWS or abs(columns / rows - ASPECT) > ASPECT * _ASPECT_TOLERANCE:
        raise RoomError(
            f"{path} has {columns} x {rows} pixels: an equirectangular panorama is twice as wide as high, within 1 %, "
            f"and has {_LEAST_ROWS} rows or more; give the whole sphere, uncut"
        )
    if _has_two_circles(light):
        raise file.fault("shows two circles in the dark, as cameras of two fisheye lenses store them: stitch them")
    return light


def _has_two_circles(light: Light) -> bool:
    """Tell whether corners of both halves are dark, and the rows between are lit: at a pole all columns see one place.

    Circles end at 1 from the middle of their half; the corners are beyond them, however the camera is aligned.
    """
    rows, columns = light.shape[:2]
    y, x = 2.0 * (np.arange(rows) + 0.5) / rows - 1.0, (4.0 * (np.arange(columns) + 0.5) / columns) % 2.0 - 1.0
    dark_ends = []
    for end in (y < -0.75, y > 0.75):
        part, distance = light[end].mean(axis=2), np.hypot(y[end][:, None], x)
        dark_ends.append(part[distance > 1.2].mean() < _DARK * part[distance < 0.95].mean())
    return all(dark_ends)


def _check_sphere(file: InputFile, columns: int, rows: int) -> None:
    """Refuse what XMP calls a crop, another projection or a camera that was not level."""
    stated = _stated_sphere(file.read())
    projection = stated.get("ProjectionType", "equirectangular")
    if projection.lower() != "equirectangular":
        raise file.fault(f"has the projection '{printable_line(projection, 40)}' (XMP GPano): make it equirectangular")
    part, whole = ([_number(stated, f"{name}{side}Pixels") for side in ("Width", "Height")] for name in _SIZES)
    is_part = any(0.0 < a < (1.0 - _ASPECT_TOLERANCE) * b for a, b in zip(part, whole, strict=True))
    has_its_sides = abs(columns * part[1] - rows * part[0]) <= _ASPECT_TOLERANCE * rows * part[0]
    if is_part and has_its_sides and whole != [columns, rows]:  # not one that was filled up since
        raise file.fault(
            f"shows {part[0]:g} x {part[1]:g} of {whole[0]:g} x {whole[1]:g} pixels (XMP GPano): give the whole sphere"
        )
    pitch, roll = (_number(stated, f"Pose{name}Degrees") for name in ("Pitch", "Roll"))
    if max(abs(pitch), abs(roll)) > _LEVEL_DEG:
        raise file.fault(
            f"has a pitch of {pitch:g} and a roll of {roll:g} degrees (XMP GPano), which viewers apply in different "
            f"ways: level it, or set both to 0 if it is level; up to {_LEVEL_DEG:g} degree is taken as level"
        )


def _stated_sphere(data: bytes) -> dict[str, str]:
    """Properties of XMP's GPano, the first of each name."""
    start = max(data.find(b"GPano:") - 1, 0)
    found: dict[str, str] = {}
    for name, text, other_name, other_text in _GPANO.findall(data, start, start + _XMP_BYTES):
        found.setdefault((name or other_name).decode(), (text or other_text).decode("latin-1").strip())
    return found


def _number(stated: dict[str, str], name: str) -> float:
    """Number of a property, 0 where it states none."""
    try:
        return float(stated.get(name, ""))
    except ValueError:
        return 0.0


def read_light(path: Path) -> Light:
    """Linear light of a picture.

    Raises
    ------
    RoomError
        If the file is missing, damaged, too large or of another kind, or holds values that are no light.
    """
    file = InputFile(path, _REMEDY, RoomError)
    data = file.read()
    if data[:4] == _EXR_MAGIC:
        light = _exr(file)
    elif data.startswith(_HDR_MAGIC):
        light = _hdr(file, data)
    else:
        light = _photograph(file, data)
    lit = np.maximum(light, 0.0)
    # lossy compression overshoots beside lamps, below 0 as well
    if not np.isfinite(light).all() or lit.sum(dtype=float) - light.sum(dtype=float) > _OVERSHOOT * lit.sum(
        dtype=float
    ):
        raise file.fault(
            f"has pixels that are no finite numbers, or negative ones of more than {100 * _OVERSHOOT:g} % of its light"
        )
    return np.asarray(lit, dtype=np.float32)


def is_linear(path: Path) -> bool:
    """Tell whether a file begins like OpenEXR or Radiance HDR, whose values are linear."""
    data = InputFile(path, _REMEDY, RoomError).read()
    return data[:4] == _EXR_MAGIC or data.startswith(_HDR_MAGIC)


def _photograph(file: InputFile, data: bytes) -> Light:
    picture = read_camera_picture(file, data)
    if picture.kind not in ("jpeg", "rgb"):
        raise file.fault("is no photograph of 8 bits: of DN of a mosaic and of YUYV the colours are not known here")
    opacity = opacity_of(_opened(data))
    if opacity is not None and opacity.min() == 0:
        raise file.fault("has wholly transparent pixels, whose colour nobody saw: fill them, or take the opacity away")
    linear = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)
    return linear[srgb_codes(file, data, picture.pixels)]


def _opened(data: bytes) -> Image.Image:
    """Picture that is decoded where its pixels are asked for; `read_camera_picture` has taken the same bytes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its size, which was looked at
        return Image.open(io.BytesIO(data), formats=FORMATS)


def srgb_codes(file: InputFile, data: bytes, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Codes of a photograph, shape (H, W, 3), as those of sRGB, whatever its colour profile or its gamma says.

    Raises
    ------
    DatasetError
        If it has other primaries without a profile.
    """
    picture = _opened(data)
    if profile := picture.info.get("icc_profile"):
        return _of_profile(profile, codes)
    with file.decoding("has damaged EXIF data; `exiftool -all= FILE` removes them"):
        if picture.getexif().get_ifd(_INTEROPERABILITY).get(1) == "R03":
            raise file.fault("has colours of Adobe RGB (EXIF), and no colour profile: convert it to sRGB")
    if picture.format != "PNG" or "srgb" in picture.info:
        return codes
    if white_first := picture.info.get("chromaticity"):
        _check_primaries(file, "cHRM", np.roll(white_first, -2))
    gamma = picture.info.get("gamma", _SRGB_GAMMA)
    if abs(gamma / _SRGB_GAMMA - 1.0) < _SAME_GAMMA:
        return codes
    if not _GAMMAS[0] < gamma < _GAMMAS[1]:
        raise file.fault(f"has a gAMA of {gamma:g}, not {_GAMMAS[0]:g} to {_GAMMAS[1]:g}: save it as sRGB")
    curve = srgb_encoded((np.arange(256) / 255.0) ** (1.0 / gamma))
    return np.rint(255.0 * curve).astype(np.uint8)[codes]


def _of_profile(profile: bytes, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Codes of a colour profile as those of sRGB; a profile that no viewer could use is passed over, as they do."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = {"RGB ": "RGB", "GRAY": "L"}[source.profile.xcolor_space]
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        turn = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB", intent)
    except (ImageCms.PyCMSError, OSError, KeyError):
        return codes

    def turned(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        seen = np.ascontiguousarray(pixels if mode == "RGB" else pixels[..., 0])
        return np.asarray(ImageCms.applyTransform(Image.fromarray(seen), turn))

    some = _SOME_CODES if mode == "RGB" else np.repeat(_STEPS[None, :, None], 3, axis=2)
    return codes if np.abs(turned(some) - some.astype(int)).max() <= _SAME_CODES else turned(codes)


def _exr(file: InputFile) -> Light:
    """Channels R, G and B, or Y alone, of an OpenEXR file."""
    import OpenEXR

    with file.decoding("is a damaged OpenEXR file"):
        with quiet_terminal(), OpenEXR.File(str(file.path), header_only=True) as opened:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in opened.header()["dataWindow"])
            channels, parts = len(opened.header().get("channels", ())), len(opened.parts)
            header = dict(opened.header())
        _check_exr(file, header)
        columns, rows = (high - low + 1).tolist()
        if not (0 < columns and 0 < rows and columns * rows <= PICTURE_PIXELS):
            raise file.fault(f"has {columns} x {rows} pixels: at most {PICTURE_PIXELS:.0e} are read")
        if parts != 1 or columns * rows * channels > _EXR_VALUES:
            raise file.fault(f"has {channels} channels in {parts} parts: one part with R, G and B is read")
        with quiet_terminal(), OpenEXR.File(str(file.path), separate_channels=True) as opened:
            planes = {name: np.asarray(channel.pixels) for name, channel in opened.channels().items()}
    if "R" not in planes and (coded := sorted({"RY", "BY", "X"} & set(planes))):
        raise file.fault(f"has colours as {' and '.join(['Y', *coded])}, which are not read: save red, green and blue")
    layers = [name[:-1] for name in planes if name.endswith(".R")]  # of programs that name their passes
    layer = layers[0] if len(layers) == 1 and not {"R", "Y"} & set(planes) else ""
    names = tuple("YYY") if "Y" in planes and "R" not in planes else tuple(layer + band for band in "RGB")
    if not all(name in planes and planes[name].shape == (rows, columns) for name in names):
        raise file.fault("has no channels R, G and B of one size")
    return np.stack([planes[name].astype(np.float32) for name in names], axis=-1)


def _check_exr(file: InputFile, header: dict[str, Any]) -> None:
    """Refuse what changes the meaning of the pixels: a crop, other primaries, a cube."""
    windows = [np.array(header[name], np.int64).tolist() for name in ("dataWindow", "displayWindow")]
    if windows[0] != windows[1]:
        raise file.fault(
            f"holds the pixels {windows[0]} (dataWindow) of the picture {windows[1]} (displayWindow): save it uncropped"
        )
    if "chromaticities" in header:
        _check_primaries(file, "chromaticities", np.ravel(header["chromaticities"]))
    if "cube" in str(header.get("envmap", "")).lower():
        raise file.fault("is a cube map (envmap): convert it to an equirectangular picture")


def _check_primaries(file: InputFile, name: str, values: Array) -> None:
    if values.shape != (8,) or not np.abs(values - _PRIMARIES).max() <= _OFF:
        raise file.fault(f"has colours of other primaries than Rec. 709 ({name}): convert it to linear Rec. 709")


# Radiance HDR.


def _hdr(file: InputFile, data: bytes) -> Light:
    head, _, rest = data.partition(b"\n\n")
    if re.findall(rb"^FORMAT=[ \t]*(.*?)\s*$", head, re.M) != [b"32-bit_rle_rgbe"]:
        raise file.fault("is no Radiance file of the format 32-bit_rle_rgbe")
    line, _, pixels = rest.partition(b"\n")
    size = re.fullmatch(rb"-Y (\d{1,6}) \+X (\d{1,6})\s*", line)
    if size is None:
        raise file.fault("is a Radiance file whose first row is not the upper one, from left to right")
    rows, columns = int(size[1]), int(size[2])
    if not 0 < rows * columns <= PICTURE_PIXELS:
        raise file.fault(f"has {columns} x {rows} pixels: at most {PICTURE_PIXELS:.0e} are read")
    try:
        coded = _hdr_pixels(pixels, rows, columns)
    except (IndexError, ValueError) as error:
        raise file.fault("is a damaged Radiance file: its rows do not have the stated length") from error
    exposure = _exposure(file, head) * _correction(file, head)
    light = np.empty((rows, columns, 3), np.float32)
    for start in range(0, rows, _ROWS):
        lines = coded[start : start + _ROWS]
        # RGBE: 128 of the exponent, 8 of the mantissa's bits
        scale = np.exp2(lines[..., 3].astype(np.int32) - 136.0) * (lines[..., 3] > 0)
        light[start : start + _ROWS] = lines[..., :3] * (scale[..., None] / exposure)
    return light


def _exposure(file: InputFile, head: bytes) -> float:
    """Product of all exposures that a header states."""
    exposure = 1.0
    for text in re.findall(rb"^EXPOSURE=(.*)$", head, re.M):
        exposure *= float(text) if _EXPOSURE.fullmatch(text.strip()) else 0.0
        if not 1e-30 < exposure < 1e30:  # float32 ends at 1e38
            shown = printable_line(text.decode("latin-1").strip(), 40)
            raise file.fault(f"has EXPOSURE={shown}: a number above 0 is needed")
    return exposure


def _correction(file: InputFile, head: bytes) -> Array:
    """Product of all corrections of colour that a header states, shape (3,); other primaries and curves are refused."""
    correction = np.ones(3)
    for name, count in ((b"COLORCORR", 3), (b"PRIMARIES", 8), (b"GAMMA", 1)):
        for text in re.findall(rb"^" + name + rb"=(.*)$", head, re.M):
            words = text.split()
            is_plain = len(words) == count and all(_EXPOSURE.fullmatch(word) for word in words)
            values = np.array([float(word) for word in words]) if is_plain else np.full(count, np.nan)
            if not values.any():
                continue  # all 0 is written where nothing is known
            if name == b"PRIMARIES":
                _check_primaries(file, "PRIMARIES", values)
            elif not (1e-30 < values.min() and values.max() < 1e30) or (name == b"GAMMA" and values != 1.0):
                shown = printable_line(text.decode("latin-1").strip(), 40)
                raise file.fault(f"has {name.decode()}={shown}, which is not read: save linear light")
            else:
                correction *= values
    return correction


def _hdr_pixels(data: bytes, rows: int, columns: int) -> NDArray[np.uint8]:
    """Mantissas and exponents, shape (rows, columns, 4)."""
    if data[:2] != b"\x02\x02" or not 8 <= columns < 32768:  # the newer code's limits, by Radiance's own reader
        if len(data) != 4 * rows * columns:
            raise ValueError("neither plain nor of the newer run-length code")
        coded = np.frombuffer(data, np.uint8).reshape(rows, columns, 4)
        if (coded[..., :3] == 1).all(axis=-1).any():  # of a pixel the largest mantissa has 128 or more
            raise ValueError("runs of the older code")
        return coded
    result = np.empty((rows, 4, columns), np.uint8)
    at = 0
    for row in result:
        if data[at : at + 4] != bytes((2, 2, columns >> 8, columns & 255)):
            raise ValueError("no head of a row")
        at = _hdr_row(data, at + 4, row)
    return result.transpose(0, 2, 1)


def _hdr_row(data: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Decode the four byte planes of a row; return the place after it."""
    columns = row.shape[1]
    for plane in row:
        decoded = bytearray()
        while len(decoded) < columns:
            count = data[at]
            if count > 128:  # a run; otherwise as many single bytes
                decoded += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                decoded += data[at + 1 : at + 1 + count]
                at += 1 + count
                if count == 0:
                    raise ValueError("a run of no length")
        plane[:] = np.frombuffer(decoded, np.uint8)
    return at
