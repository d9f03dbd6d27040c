"""Reader of camera pictures: JPEG with its tables, PNG, TIFF, BMP, PPM, PGM, turned upright; other formats are refused.

* JPEG: colour or grey, with its quantisation tables and the subsampling of its chroma. One of R, G, B without chroma
  is colour like any other. Of a multi-picture file of a telephone the first one is taken; others are its previews.
* PNG, TIFF and BMP of 8 bits: colour, grey or a palette; a grey picture has three equal colours.
* PNG and TIFF of 16 bits: one channel is the mosaic's DN; of colours the upper 8 bits are taken, as viewers do. Colours
  of 10 or 12 bits that are not scaled to 16 are refused.
* PPM of 8 bits, and PGM, binary or plain, whose values are the mosaic's DN as they stand.
* PNG of grey with a second plane of 8 bits: YUYV, as `phibench dataset frames` writes it.

Pictures are turned upright as their EXIF orientation says. Other formats are refused by name, with what converts them.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import PICTURE_PIXELS, InputFile
from phibench.scenes.validation import printable_line

_JPEG = ("JPEG", "MPO")  # Pillow calls a JPEG with previews after it MPO
FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM")
PGM = (b"P5", b"P2")
IN_WORDS = "JPEG, PNG, TIFF, BMP, PPM or PGM"
Kind = Literal["jpeg", "rgb", "yuyv", "raw"]
Subsampling = Literal["4:4:4", "4:2:2", "4:2:0"]

_ORIENTATION, _MAKE, _MODEL, _DNG = 0x0112, 0x010F, 0x0110, 0xC612  # EXIF and TIFF tags
_LIT_CODE, _LIT_SHARE = 32, 0.01  # below, JPEG rounds all chroma away
_WHITE_IS_0 = 0  # TIFF's photometric interpretation
_PHOTOMETRIC = 0x0106  # TIFF's tag
# factors of Y in a JPEG
_SAMPLING: dict[tuple[int, int], Subsampling] = {(1, 1): "4:4:4", (2, 1): "4:2:2", (2, 2): "4:2:0"}
_BITS = 258  # TIFF's tag: bits of each colour
_UPPER_CODES = 16  # of the upper 8 bits: colours below have 12 of 16 bits, or fewer
_SIXTEEN = ("I;16", "I;16B", "I;16L", "I")
_PGM = re.compile(rb"P[25](?:\s+|\s*#[^\n]*\n\s*)+(\d+)(?:\s+|\s*#[^\n]*\n\s*)+(\d+)(?:\s+|\s*#[^\n]*\n\s*)+(\d+)\s")


@dataclass(frozen=True)
class CameraPicture:
    """Picture of a file, upright.

    Attributes
    ----------
    pixels : array, read-only
        By `kind`: "jpeg" and "rgb" (H, W, 3) uint8; "raw" (H, W) uint16, DN; "yuyv" (H, W, 2) uint8.
    kind : "jpeg", "rgb", "yuyv" or "raw"
    grey : bool
        The file has one channel of 8 bits, or three that are equal everywhere.
    camera : str
        Maker and model of EXIF; "" where there is none.
    mode : str
        Pillow's name of what the file stores, such as "L" or "RGB"; "" of a PGM.
    orientation : int
        Of EXIF, 1 to 8: how the stored rows were turned to make these.
    tables : arrays of shape (8, 8)
        Quantisation tables of a JPEG; none otherwise.
    subsampling : str or None
        Chroma of a JPEG, such as "4:2:2".
    bits : int
        Of one value, as the file stores it: 8 or 16, or those of the largest value that a PGM tells.
    """

    pixels: NDArray[Any] = field(repr=False)
    kind: Kind
    grey: bool = False
    camera: str = ""
    mode: str = ""
    orientation: int = 1
    tables: tuple[NDArray[Any], ...] = field(default=(), repr=False)
    subsampling: Subsampling | None = None
    bits: int = 8


def read_camera_picture(file: InputFile, data: bytes | None = None) -> CameraPicture:
    """Picture of a file, or of bytes that are already read from it.

    Raises
    ------
    DatasetError
        Of the file's own kind, if it is no picture of `FORMATS`, damaged or too large; in one sentence.
    """
    data = file.read() if data is None else data
    if other := _other_format(data, file.path.suffix.lower()):
        raise file.fault(other)
    if data[:2] in PGM:
        values, top = pgm_values(file, data)
        return CameraPicture(_sealed(values), "raw", bits=max(top.bit_length(), 8))
    picture = _opened(file, data)
    with (
        file.decoding("is a damaged picture"),
        warnings.catch_warnings(),
    ):  # what a decoder has not looked at yet: texts, tags and tables
        warnings.simplefilter("ignore", UserWarning)  # of damaged tags, without the name of the file
        decoded = _of_decoded(file, picture)
        if picture.format == "TIFF":  # Pillow turns one as it decodes it, and forgets so
            told = _directory(data).get(_ORIENTATION, 1)
            decoded = replace(decoded, orientation=_orientation(file, told, decoded.kind))
        if decoded.kind == "rgb" and _has_16_bits(picture, data) and decoded.pixels.max() < _UPPER_CODES:
            raise file.fault("has colours of 16 bits that end below 4096: scale them to 65535, or save 8 bits a colour")
    return decoded


def _opened(file: InputFile, data: bytes) -> Image.Image:
    try:
        return file.picture(FORMATS, data)
    except DatasetError as error:
        if data[:4] in _TIFF and isinstance(error.__cause__, UnidentifiedImageError):
            raise file.fault(
                "is a TIFF of another kind than 1 to 16 bits, such as one of floats; `magick FILE -depth 8 out.png` "
                "converts it"
            ) from error
        raise


def _has_16_bits(picture: Image.Image, data: bytes) -> bool:
    """Tell whether each colour of a PNG or TIFF has 16 bits, of which Pillow gives the upper 8."""
    if picture.format == "PNG":
        return data[24:25] == b"\x10"  # of IHDR, the first chunk: after width and height
    return picture.format == "TIFF" and max(picture.tag_v2.get(_BITS, (8,))) == 16  # type: ignore[attr-defined]


def _of_decoded(file: InputFile, picture: Image.Image) -> CameraPicture:
    if getattr(picture, "n_frames", 1) > 1 and picture.format not in _JPEG:
        raise file.fault(f"holds {picture.n_frames} pictures: one is read")  # type: ignore[attr-defined]
    with file.decoding("has damaged EXIF data; `exiftool -all= FILE` removes them"):
        exif = picture.getexif()
    camera = printable_line(" ".join(str(exif[tag]) for tag in (_MAKE, _MODEL) if tag in exif), 80)
    kind, pixels = _pixels(file, picture)
    orientation = _orientation(file, exif.get(_ORIENTATION, 1), kind)
    grey = picture.mode in ("L", "LA", "1") or (kind in ("jpeg", "rgb") and _is_grey(pixels))
    upright_picture = CameraPicture(
        _sealed(upright(pixels, orientation)), kind, grey, camera, picture.mode, orientation, bits=8 * pixels.itemsize
    )
    return _with_tables(file, picture, upright_picture) if kind == "jpeg" else upright_picture


def _is_grey(pixels: NDArray[Any]) -> bool:
    """Tell whether a picture's three colours are equal everywhere; one of a dark room says nothing of them."""
    red = pixels[..., :1]
    return bool((pixels == red).all() and (red > _LIT_CODE).mean() > _LIT_SHARE)


def _with_tables(file: InputFile, picture: Image.Image, found: CameraPicture) -> CameraPicture:
    """JPEG with its tables; one that was turned off the grid of its blocks is R, G, B like any other."""
    tables = tuple(np.array(table, float).reshape(8, 8) for _, table in sorted(picture.quantization.items()))  # type: ignore[attr-defined]
    sampling = _sampling(picture)
    if sampling is None or not tables:
        raise file.fault("is a JPEG with another chroma than 4:4:4, 4:2:2 or 4:2:0; `djpeg FILE > out.ppm` decodes it")
    if _without_chroma(picture):
        return replace(found, kind="rgb")
    if found.orientation > 1:
        # a JPEG is turned by whole units: a cut one at an edge would lie inside
        down, across = {"4:4:4": (8, 8), "4:2:2": (8, 16), "4:2:0": (16, 16)}[sampling]
        aside = found.orientation > 4
        if picture.height % down or picture.width % across or (aside and sampling == "4:2:2"):
            return replace(found, kind="rgb")
        tables = tuple(table.T for table in tables) if aside else tables
    return replace(found, tables=tables, subsampling=sampling)


def _sampling(picture: Image.Image) -> Subsampling | None:
    """Subsampling of the chroma by the factors of the components, luma's over the others'; None of any other kind."""
    factors = [(h, v) for _, h, v, _ in picture.layer]  # type: ignore[attr-defined]
    if len(factors) == 1:
        return "4:4:4"
    (h, v), *others = factors
    ratios = {(h / x, v / y) for x, y in others}
    return _SAMPLING.get(ratios.pop()) if len(ratios) == 1 else None


def _without_chroma(picture: Image.Image) -> bool:
    """Tell whether a JPEG holds R, G, B: by Adobe's mark, or by its components' names (libjpeg's rule)."""
    if picture.mode == "L" or "jfif" in picture.info:
        return False
    names = [number for number, *_ in picture.layer]  # type: ignore[attr-defined]
    return bool(picture.info.get("adobe_transform", 1) == 0 or ("adobe" not in picture.info and names == [82, 71, 66]))


def upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Stored rows turned as the orientation 1 to 8 of EXIF says, a copy."""
    if orientation > 4:  # rows are stored as columns
        pixels = np.swapaxes(pixels, 0, 1)
    # EXIF 2.3, tag 274
    rows, columns = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}.get(orientation, (1, 1))
    return np.ascontiguousarray(pixels[::rows, ::columns])


def _orientation(file: InputFile, told: object, kind: Kind) -> int:
    if not (isinstance(told, int) and 1 <= told <= 8):
        return 1  # no orientation: viewers show such a picture as it is stored
    if told != 1 and kind in ("raw", "yuyv"):
        raise file.fault(f"is turned by EXIF (orientation {told}): DN and YUYV are read in the sensor's own rows alone")
    return told


def _sealed(image: NDArray[Any]) -> NDArray[Any]:
    image.flags.writeable = False
    return image


def _pixels(file: InputFile, picture: Image.Image) -> tuple[Kind, NDArray[Any]]:
    if picture.mode in _SIXTEEN:
        values = np.array(picture)
        if values.min(initial=0) < 0 or values.max(initial=0) > 65535:
            raise file.fault("has pixels beyond 16 bits")
        if picture.format == "TIFF" and picture.tag_v2.get(_PHOTOMETRIC) == _WHITE_IS_0:  # type: ignore[attr-defined]
            raise file.fault("is a TIFF of 16 bits in which 0 is white: save it with 0 as black")
        return "raw", values.astype(np.uint16)
    if (picture.format, picture.mode) == ("PNG", "LA") and not _is_opacity(np.asarray(picture)[..., 1]):
        return "yuyv", np.array(picture)
    if picture.mode not in ("RGB", "RGBA", "RGBX", "L", "LA", "P", "PA", "1"):
        raise file.fault(f"is a {picture.format} file of mode {picture.mode}: grey or R, G, B of 8 or 16 bits is read")
    return ("jpeg" if picture.format in _JPEG else "rgb"), np.array(picture.convert("RGB"))


def _is_opacity(plane: NDArray[Any]) -> bool:
    """Tell whether most pixels of a second plane are wholly opaque or wholly clear: chroma hardly ever ends there."""
    return bool(np.isin(plane, (0, 255)).mean() > 0.5)


def pgm_values(file: InputFile, data: bytes) -> tuple[NDArray[np.uint16], int]:
    """DN of a PGM, binary (P5) or plain (P2), and the largest that it tells; Pillow would stretch them to 16 bits.

    Raises
    ------
    DatasetError
        Of the file's own kind, if it is damaged; in one sentence.
    """
    head = _PGM.match(data[:1000])  # a head with comments, and no search through the pixels
    # a million columns: no picture, and slow as a number
    if head is None or any(len(text) > 6 for text in head.groups()):
        raise file.fault("is not a picture of the format PGM")
    width, height, top = (int(text) for text in head.groups())
    if not (0 < width * height <= PICTURE_PIXELS and 0 < top < 65536):
        raise file.fault(f"is a PGM of {width} x {height} pixels up to {top}: no picture of a camera")
    body = data[head.end() :]
    if data[:2] == b"P2":
        with file.decoding("is a damaged PGM"):
            values = np.array(re.sub(rb"#[^\n]*", b"", body).split(), np.int64)
    else:
        kind = np.dtype(np.uint8) if top < 256 else np.dtype(">u2")  # netpbm: two bytes, the high one first
        values = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)
    if len(values) != width * height or (data[:2] == b"P5" and len(body) != width * height * values.itemsize):
        raise file.fault(f"is a PGM of another size than the {width} x {height} pixels that it tells")
    if values.min() < 0 or values.max() > top:
        raise file.fault(f"is a PGM with values beyond {top}, which it tells as the largest")
    return values.reshape(height, width).astype(np.uint16), top


# -- formats that are not read ---------------------------------------------------------------------------------------

_DEVELOP = "`dcraw -D -4 FILE` writes the DN of its mosaic as PGM"
_RAW_SUFFIXES = {
    ".dng": "DNG", ".cr2": "Canon CR2", ".cr3": "Canon CR3", ".nef": "Nikon NEF", ".arw": "Sony ARW",
    ".orf": "Olympus ORF", ".rw2": "Panasonic RW2", ".raf": "Fujifilm RAF", ".pef": "Pentax PEF",
}  # fmt: skip
_TIFF = (b"II*\0", b"MM\0*")
_RAW_MAGIC = {
    b"FUJIFILMCCD-RAW": "Fujifilm RAF",
    b"IIRO": "Olympus ORF",
    b"IIRS": "Olympus ORF",
    b"IIU\0": "Panasonic RW2",
}
_BRANDS = {
    "HEIC": ((b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"), "`heif-convert FILE out.png`"),
    "AVIF": ((b"avif", b"avis"), "`avifdec FILE out.png`"),
    "Canon CR3": ((b"crx ",), "LibRaw's `4channels` or `unprocessed_raw FILE`"),
}
_MAGIC = {
    b"GIF8": "GIF",
    b"P7": "PAM",
    b"PF": "PFM",
    b"Pf": "PFM",
    b"\0\0\0\x0cjP": "JPEG 2000",
    b"\xff\x4f\xff\x51": "JPEG 2000",
    b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL": "JPEG XL",
    b"8BPS": "Photoshop",
    b"%PDF": "PDF",
}


def _other_format(data: bytes, suffix: str) -> str:
    """Fault of a format that is known and not read; "" for all others."""
    if not data:
        return "is empty"
    if data[4:8] == b"ftyp":
        brand = data[8:12]  # ISO base media: after size and "ftyp"
        named = next((name for name, (brands, _) in _BRANDS.items() if brand in brands), None)
        if named == "HEIC" and any(brand_of_avif in data[16:64] for brand_of_avif in _BRANDS["AVIF"][0]):
            named = "AVIF"
        if named is None:
            return "is a video; `ffmpeg -i FILE %04d.png` takes single frames out of it"
        return _converted(named, f"{_BRANDS[named][1]} converts it")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _converted("WebP", "`dwebp FILE -o out.png` converts it")
    if raw := _raw_format(data, suffix):
        return _converted(raw, _DEVELOP)
    named = next((name for magic, name in _MAGIC.items() if data.startswith(magic)), None)
    return _converted(named, "`magick FILE out.png` converts it") if named else ""


def _converted(name: str, how: str) -> str:
    return f"is a {name} file, which is not read here; {how}"


def _raw_format(data: bytes, suffix: str) -> str:
    """Name of a camera's own raw format: by its first bytes, or a TIFF with DNG's tag or a known suffix."""
    if named := next((name for magic, name in _RAW_MAGIC.items() if data.startswith(magic)), None):
        return named
    if data[:4] not in _TIFF:
        return ""  # no TIFF, in which raw formats are kept
    if data[8:10] == b"CR":
        return "Canon CR2"
    return "DNG" if _DNG in _directory(data) else _RAW_SUFFIXES.get(suffix, "")


def _directory(data: bytes) -> Image.Exif:
    """Tags of a TIFF's first picture; none of a damaged one, which the decoder tells."""
    directory = Image.Exif()
    try:
        directory.load(b"Exif\0\0" + data)
        return directory if len(directory) else Image.Exif()
    except Exception:  # damaged EXIF data: as a picture without
        return Image.Exif()
