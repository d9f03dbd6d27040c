"""One reader of pictures: each format gives the pixels that were stored, or is refused by its name."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from phibench.datasets.common.camera_pictures import read_camera_picture, upright
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile

RANDOM = np.random.default_rng(3)
COLOUR = RANDOM.integers(0, 256, (16, 32, 3), dtype=np.uint8)
GREY = RANDOM.integers(0, 256, (16, 32), dtype=np.uint8)
DEEP = RANDOM.integers(0, 65536, (16, 32), dtype=np.uint16)


def read(path: Path):
    return read_camera_picture(InputFile(path, "give another"))


def test_lossless_formats_give_the_pixels_and_their_kind(tmp_path: Path) -> None:
    for suffix in ("png", "tif", "bmp", "ppm"):
        Image.fromarray(COLOUR).save(tmp_path / f"colour.{suffix}")
        found = read(tmp_path / f"colour.{suffix}")
        assert (found.kind, found.grey) == ("rgb", False)
        np.testing.assert_array_equal(found.pixels, COLOUR)
    for suffix in ("png", "tif"):
        Image.fromarray(GREY).save(tmp_path / f"grey.{suffix}")
        found = read(tmp_path / f"grey.{suffix}")
        assert (found.kind, found.grey) == ("rgb", True)
        np.testing.assert_array_equal(found.pixels, np.repeat(GREY[..., None], 3, axis=2))
        assert cv2.imwrite(str(tmp_path / f"deep.{suffix}"), DEEP)
        found = read(tmp_path / f"deep.{suffix}")
        assert (found.kind, found.pixels.dtype) == ("raw", np.uint16)
        np.testing.assert_array_equal(found.pixels, DEEP)
        # of 16 bits a colour: the upper eight, as viewers show them
        assert cv2.imwrite(str(tmp_path / f"deep-colour.{suffix}"), np.stack([DEEP, DEEP, DEEP], axis=-1))
        found = read(tmp_path / f"deep-colour.{suffix}")
        assert found.kind == "rgb"
        np.testing.assert_array_equal(found.pixels[..., 0], DEEP >> 8)


def test_jpeg_gives_its_tables_in_colour_and_grey(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(COLOUR, (0, 0), 2.0)
    for mode, sampling in (("RGB", "4:2:2"), ("RGB", "4:2:0"), ("L", "4:4:4")):
        file = tmp_path / "a.jpg"
        options = {} if mode == "L" else {"subsampling": sampling}
        Image.fromarray(smooth).convert(mode).save(file, quality=85, **options)
        found = read(file)
        assert (found.kind, found.subsampling, found.grey) == ("jpeg", sampling, mode == "L")
        assert found.tables[0][0, 0] == 5  # ITU-T T.81, table K.1 begins with 16; quality 85 takes 30 % of it
        np.testing.assert_array_equal(found.pixels, np.array(Image.open(file).convert("RGB")))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    """Pillow's own turn is the oracle. A JPEG keeps its tables where its blocks stay on the grid."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(COLOUR)
    stored.save(tmp_path / "a.png", exif=exif)
    stored.save(tmp_path / "a.jpg", exif=exif, subsampling="4:2:0", quality=90)
    turn = getattr(Image.Transpose, {
        2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE", 6: "ROTATE_270", 7: "TRANSVERSE",
        8: "ROTATE_90",
    }.get(orientation, ""), None)  # fmt: skip
    seen = stored if turn is None else stored.transpose(turn)
    np.testing.assert_array_equal(read(tmp_path / "a.png").pixels, np.array(seen))
    np.testing.assert_array_equal(upright(COLOUR, orientation), np.array(seen))
    found = read(tmp_path / "a.jpg")
    assert (found.kind, found.orientation) == ("jpeg", orientation)
    stored.crop((0, 0, 24, 16)).save(tmp_path / "b.jpg", exif=exif, subsampling="4:2:0")
    assert read(tmp_path / "b.jpg").kind == ("jpeg" if orientation == 1 else "rgb")


def test_a_plane_of_opacity_is_no_chroma(tmp_path: Path) -> None:
    cut = np.where(np.arange(32) < 20, 255, 0).astype(np.uint8) * np.ones_like(GREY)  # the background made clear
    half = np.where(np.arange(32) < 15, 128, 255).astype(np.uint8) * np.ones_like(GREY)
    planes = (np.full_like(GREY, 255), "rgb"), (cut, "rgb"), (half, "rgb"), (np.full_like(GREY, 128), "yuyv")
    for second, kind in planes:
        Image.fromarray(np.stack([GREY, second], axis=-1)).save(tmp_path / "a.png")
        assert read(tmp_path / "a.png").kind == kind


def test_a_jpeg_says_how_its_chroma_lies(tmp_path: Path) -> None:
    """4:4:4 stands only for equal factors; R, G, B without chroma are no JPEG of a camera; previews are passed over."""
    smooth = cv2.GaussianBlur(COLOUR, (0, 0), 2.0)
    for factors, sampling in (
        (0x111111, "4:4:4"),
        (0x211111, "4:2:2"),
        (0x221111, "4:2:0"),
        (0x121111, ""),
        (0x411111, ""),
    ):
        done, data = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factors])
        assert done
        (tmp_path / "a.jpg").write_bytes(data.tobytes())
        if sampling:
            assert read(tmp_path / "a.jpg").subsampling == sampling
        else:
            with pytest.raises(DatasetError, match="another chroma"):
                read(tmp_path / "a.jpg")
    Image.fromarray(smooth).save(tmp_path / "b.jpg", keep_rgb=True, quality=90)
    assert (read(tmp_path / "b.jpg").kind, read(tmp_path / "b.jpg").tables) == ("rgb", ())
    preview = Image.fromarray(smooth[:8, :8])
    Image.fromarray(smooth).save(tmp_path / "c.jpg", "MPO", save_all=True, append_images=[preview], quality=90)
    found = read(tmp_path / "c.jpg")
    assert (found.kind, found.pixels.shape, len(found.tables)) == ("jpeg", smooth.shape, 2)


def test_plain_pgm_holds_dn_like_a_binary_one(tmp_path: Path) -> None:
    values = DEEP >> 6  # 10 bits, which Pillow stretches to 16
    rows = "\n".join(" ".join(map(str, row)) + " # a row" for row in values)
    (tmp_path / "a.pgm").write_text(f"P2\n# DN\n32 16\n1023\n{rows}\n")
    found = read(tmp_path / "a.pgm")
    assert found.kind == "raw"
    np.testing.assert_array_equal(found.pixels, values)
    for text, words in (
        ("P2 2 1 1023 5 1024", "values beyond 1023"),
        ("P2 2 1 255 5", "another size"),
        ("P2 2 1 9 a b", "damaged"),
    ):
        (tmp_path / "b.pgm").write_text(text)
        with pytest.raises(DatasetError, match=words):
            read(tmp_path / "b.pgm")


def test_grey_is_known_by_its_pixels(tmp_path: Path) -> None:
    """A monochrome camera's driver may write R, G, B that are equal; a dark picture tells nothing.

    JPEG rounds the chroma of a dark room with the laser off to none: such a picture is no monochrome camera's.
    """
    for suffix in ("png", "jpg"):
        Image.fromarray(np.repeat(GREY[..., None], 3, axis=2)).save(tmp_path / f"a.{suffix}")
        assert read(tmp_path / f"a.{suffix}").grey
    Image.fromarray(COLOUR // 40 + np.array([1, 0, 0], np.uint8)).save(tmp_path / "dark.jpg", quality=30)
    dark = read(tmp_path / "dark.jpg")
    assert (dark.pixels == dark.pixels[..., :1]).all()
    assert not dark.grey


def test_dn_of_a_tiff_are_as_stored_or_refused(tmp_path: Path) -> None:
    """Pillow turns a TIFF by its tag without a word, and does not invert 16 bits in which 0 is white."""
    for tags, words in (({0x0112: 3}, "orientation 3"), ({0x0106: 0}, "0 is white")):
        Image.fromarray(DEEP).save(tmp_path / "a.tif", tiffinfo=tags)
        with pytest.raises(DatasetError, match=words):
            read(tmp_path / "a.tif")
    Image.fromarray(COLOUR).save(tmp_path / "b.tif", tiffinfo={0x0112: 3})
    turned = read(tmp_path / "b.tif")
    np.testing.assert_array_equal(turned.pixels, COLOUR[::-1, ::-1])
    assert turned.orientation == 3  # pictures of a pair must be turned alike


def _tiff_with_tag(tag: int) -> bytes:
    entries = ((256, 1), (257, 1), (tag, 0x00000401))
    body = b"".join(struct.pack("<HHII", key, 4, 1, value) for key, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4)


FOREIGN = {
    "HEIC": ("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "heif-convert"),
    "AVIF": ("a.avif", b"\0\0\0\x1cftypavif\0\0\0\0avifmif1", "avifdec"),
    "Canon CR3": ("a.cr3", b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "LibRaw"),
    "DNG": ("a.dng", _tiff_with_tag(0xC612), "dcraw -D -4"),
    "Canon CR2": ("a.cr2", b"II*\0\x10\0\0\0CR\2\0" + bytes(40), "dcraw"),
    "Nikon NEF": ("a.nef", _tiff_with_tag(300), "dcraw"),
    "Fujifilm RAF": ("a.raf", b"FUJIFILMCCD-RAW 0201", "dcraw"),
    "WebP": ("a.webp", b"RIFF\x24\0\0\0WEBPVP8 ", "dwebp"),
    "GIF": ("a.gif", b"GIF89a" + bytes(20), "magick"),
    "PFM": ("a.png", b"PF\n1 1\n-1.0\n" + bytes(12), "magick"),  # under another name
    "JPEG XL": ("a.jxl", b"\xff\x0a" + bytes(20), "magick"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_other_formats_are_refused_by_name(tmp_path: Path, name: str) -> None:
    file, data, remedy = FOREIGN[name]
    (tmp_path / file).write_bytes(data)
    with pytest.raises(DatasetError) as error:
        read(tmp_path / file)
    text = str(error.value)
    assert f"is a {name} file" in text
    assert remedy in text
    assert "\n" not in text


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_colours_that_are_not_scaled_to_16_bits_are_told(tmp_path: Path, suffix: str) -> None:
    """12 bits as they are gave a picture of 16 codes; scaled ones have their upper 8 bits."""
    colours = np.stack([DEEP >> 4, DEEP >> 5, DEEP >> 6], axis=-1)  # up to 4095
    for factor, message in ((1, "scale them to 65535"), (16, "")):
        assert cv2.imwrite(str(tmp_path / f"a.{suffix}"), colours[..., ::-1] * factor)
        if message:
            with pytest.raises(DatasetError, match=message):
                read(tmp_path / f"a.{suffix}")
        else:
            np.testing.assert_array_equal(read(tmp_path / f"a.{suffix}").pixels, colours >> 4)


def test_what_a_camera_does_not_write_is_told(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    assert cv2.imwrite(str(tmp_path / "floats.tif"), COLOUR.astype(np.float32))
    Image.fromarray(COLOUR).convert("CMYK").save(tmp_path / "print.jpg")
    pages = [Image.fromarray(GREY), Image.fromarray(GREY)]
    pages[0].save(tmp_path / "pages.tif", save_all=True, append_images=pages[1:])
    (tmp_path / "video.mp4").write_bytes(b"\0\0\0\x18ftypisom\0\0\2\0isomiso2")
    exif = Image.Exif()
    exif[0x0112] = 3
    buffer = io.BytesIO()
    Image.fromarray(DEEP).save(buffer, "PNG", exif=exif)
    (tmp_path / "turned.png").write_bytes(buffer.getvalue())
    for file, word in (
        ("empty.png", "is empty"),
        ("floats.tif", "a TIFF of another kind"),
        ("print.jpg", "CMYK"),
        ("pages.tif", "2 pictures"),
        ("video.mp4", "ffmpeg"),
        ("turned.png", "EXIF"),
    ):
        with pytest.raises(DatasetError, match=word):
            read(tmp_path / file)
