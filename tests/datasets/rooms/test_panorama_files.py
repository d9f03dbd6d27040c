"""Pictures with linear light: every format against another library's writer, and damaged ones in one sentence."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from helpers.colour_profiles import P3, P3_TO_SRGB, edited_profile, linear
from PIL import Image

from phibench.datasets.rooms.panorama_files import read_light, read_panorama
from phibench.scenes.validation import SceneError

RNG = np.random.default_rng(7)
LIGHT = (10.0 ** RNG.uniform(-3.0, 3.0, (32, 64, 1)) * RNG.uniform(0.2, 1.0, (32, 64, 3))).astype(np.float32)


def write_exr(path: Path, planes: dict[str, np.ndarray]) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return path


def plain_hdr(light: np.ndarray, head: bytes = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n") -> bytes:
    """Without run lengths: mantissas of 8 bits under the largest band's exponent."""
    exponent = np.ceil(np.log2(light.max(axis=-1)))
    mantissas = np.floor(light * 2.0 ** (8.0 - exponent[..., None])).clip(0, 255)
    pixels = np.concatenate([mantissas, exponent[..., None] + 128.0], axis=-1).astype(np.uint8)
    rows, columns = light.shape[:2]
    return head + f"\n-Y {rows} +X {columns}\n".encode() + pixels.tobytes()


def test_photograph_is_linear(tmp_path):
    codes = RNG.integers(0, 256, (20, 40, 3), dtype=np.uint8)
    Image.fromarray(codes).save(tmp_path / "a.png")
    x = codes / 255.0
    expected = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(read_panorama(tmp_path / "a.png"), expected, atol=1e-6)


def test_photograph_is_turned_as_its_exif_data_say(tmp_path):
    """Orientation 6: the stored picture is shown after a quarter turn with the clock."""
    codes = RNG.integers(0, 256, (40, 20, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(codes).save(tmp_path / "turned.png", exif=exif)
    Image.fromarray(np.rot90(codes, -1)).save(tmp_path / "upright.png")
    np.testing.assert_array_equal(read_panorama(tmp_path / "turned.png"), read_panorama(tmp_path / "upright.png"))


def test_exr_keeps_every_value(tmp_path):
    for names in (("R", "G", "B"), ("R", "G", "B", "A")):
        planes = {name: np.ascontiguousarray(LIGHT[..., min(k, 2)]) for k, name in enumerate(names)}
        np.testing.assert_array_equal(read_panorama(write_exr(tmp_path / "a.exr", planes)), LIGHT)
    grey = read_light(write_exr(tmp_path / "y.exr", {"Y": np.ascontiguousarray(LIGHT[..., 0])}))
    np.testing.assert_array_equal(grey, np.repeat(LIGHT[..., :1], 3, axis=-1))


def test_hdr_of_opencv_is_read(tmp_path):
    """Run-length coded; 8-bit mantissas are good to half a step, 1/256 of the largest band."""
    smooth = np.repeat(LIGHT, 5, axis=1)  # runs
    for light in (LIGHT, smooth[:, : 2 * len(smooth)]):
        cv2.imwrite(str(tmp_path / "a.hdr"), light[..., ::-1])
        found = read_panorama(tmp_path / "a.hdr")
        np.testing.assert_array_equal(found, cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1])
        assert np.max(np.abs(found - light) / light.max(axis=-1, keepdims=True)) < 1.0 / 128.0


def test_hdr_without_run_lengths_and_with_an_exposure(tmp_path):
    (tmp_path / "a.hdr").write_bytes(plain_hdr(LIGHT))
    (tmp_path / "b.hdr").write_bytes(plain_hdr(LIGHT, b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=4.0\n"))
    found = read_light(tmp_path / "a.hdr")
    assert np.max(np.abs(found - LIGHT) / LIGHT.max(axis=-1, keepdims=True)) < 1.0 / 127.0
    np.testing.assert_allclose(4.0 * read_light(tmp_path / "b.hdr"), found, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "data", "word"),
    [
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 16 +X 32\n", "format 32-bit_rle_rgbe"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n+Y 16 +X 32\n", "first row is not the upper"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n\2\2\0\40\200", "do not have the stated length"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\nabc", "do not have the stated length"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 99999\n", "pixels: at most"),
        ("a.exr", b"\x76\x2f\x31\x01" + b"x" * 100, "damaged OpenEXR file"),
        ("a.jpg", b"\xff\xd8\xff\xe0" + b"x" * 100, "picture"),
        ("a.txt", b"no picture", "not a picture"),
    ],
)
def test_damaged_pictures_end_in_one_sentence(tmp_path, name, data, word):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneError, match=word) as caught:
        read_light(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_cut_hdr_files_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.hdr"), LIGHT)
    whole = (tmp_path / "a.hdr").read_bytes()
    for kept in range(60, len(whole), 97):
        (tmp_path / "cut.hdr").write_bytes(whole[:kept])
        with pytest.raises(SceneError):
            read_light(tmp_path / "cut.hdr")


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_values_that_are_no_light_are_refused(tmp_path, value):
    planes = {name: np.full((16, 32), value, np.float32) for name in "RGB"}
    with pytest.raises(SceneError, match="no finite numbers, or negative ones"):
        read_light(write_exr(tmp_path / "a.exr", planes))


@pytest.mark.parametrize(("undershoot", "accepted"), [(0.009, True), (0.011, False)])
def test_a_lossy_picture_may_fall_below_zero_by_a_hundredth_of_its_light(tmp_path, undershoot, accepted):
    plane = np.ones((16, 32), np.float32)
    plane[0, 0] = -undershoot * (plane.size - 1)  # of what is above 0
    path = write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", plane))
    if accepted:
        assert read_light(path).min() == 0.0
    else:
        with pytest.raises(SceneError, match="more than 1 % of its light"):
            read_light(path)


@pytest.mark.parametrize("size", [(200, 90), (90, 200), (100, 100), (203, 100), (8, 4)])
def test_pictures_that_are_no_panorama_are_refused(tmp_path, size):
    Image.new("RGB", size, (90, 90, 90)).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match="twice as wide as high"):
        read_panorama(tmp_path / "a.png")
    Image.new("RGB", (201, 100)).save(tmp_path / "b.png")  # within 1 %
    assert read_panorama(tmp_path / "b.png").shape == (100, 201, 3)


def test_sixteen_bits_are_not_guessed_at(tmp_path):
    Image.fromarray(np.full((16, 32), 40_000, np.uint16)).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match="8 bits"):
        read_light(tmp_path / "a.png")


def equal_planes(*names: str) -> dict[str, np.ndarray]:
    return {name: np.full((16, 32), 0.5, np.float32) for name in names}


@pytest.mark.parametrize(
    ("names", "words"), [(("Y", "RY", "BY"), "colours as Y and BY and RY"), (("X", "Y", "Z"), "colours as Y and X")]
)
def test_an_exr_with_colours_of_another_kind_is_not_grey(tmp_path, names, words):
    with pytest.raises(SceneError, match=words):
        read_light(write_exr(tmp_path / "a.exr", equal_planes(*names)))
    assert read_light(write_exr(tmp_path / "b.exr", equal_planes("Y", "Z"))).shape == (16, 32, 3)  # with depths


WINDOW = (np.array([0, 8], np.int32), np.array([31, 23], np.int32))
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"dataWindow": WINDOW, "displayWindow": (np.array([0, 0], np.int32), WINDOW[1])}, "save it uncropped"),
        ({"dataWindow": WINDOW, "displayWindow": WINDOW, "chromaticities": REC_709}, ""),
        ({"chromaticities": ACES}, r"other primaries than Rec\. 709 \(chromaticities\)"),
    ],
)
def test_what_an_exr_header_says_of_its_pixels_counts(tmp_path, header, words):
    """A crop was stretched over the whole sphere, and wide primaries were taken for those of sRGB."""
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(head, equal_planes("R", "G", "B")) as file:
        file.write(str(tmp_path / "a.exr"))
    if words:
        with pytest.raises(SceneError, match=words):
            read_light(tmp_path / "a.exr")
    else:
        assert read_light(tmp_path / "a.exr")[0, 0] == pytest.approx([0.5] * 3)


def test_a_cube_map_is_no_panorama(tmp_path):
    """The library writes a number where the definition has a type of its own; of the same length."""
    head = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage, "envmap": 1}
    with OpenEXR.File(head, equal_planes("R", "G", "B")) as file:
        file.write(str(tmp_path / "a.exr"))
    number, own = b"envmap\0int\0\4\0\0\0\1\0\0\0", b"envmap\0envmap\0\1\0\0\0\1"
    data = (tmp_path / "a.exr").read_bytes()
    assert data.count(number) == 1
    (tmp_path / "a.exr").write_bytes(data.replace(number, own))
    with pytest.raises(SceneError, match=r"cube map \(envmap\)"):
        read_light(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("line", "factor", "words"),
    [
        (b"COLORCORR=2 1 4", (0.5, 1.0, 0.25), ""),
        (b"COLORCORR=1 0 1", None, "COLORCORR=1 0 1"),
        (b"PRIMARIES=0.64 0.33 0.29 0.6 0.15 0.06 0.333 0.333", (1.0, 1.0, 1.0), ""),
        (b"PRIMARIES=0 0 0 0 0 0 0 0", (1.0, 1.0, 1.0), ""),
        (b"PRIMARIES=0.7347 0.2653 0 1 0.0001 -0.077 0.32168 0.33767", None, r"other primaries than Rec\. 709"),
        (b"GAMMA=1", (1.0, 1.0, 1.0), ""),
        (b"GAMMA=2.2", None, r"GAMMA=2\.2, which is not read"),
        (b"# FORMAT=32-bit_rle_rgbe\nFORMAT=32-bit_rle_xyze", None, "format 32-bit_rle_rgbe"),
    ],
)
def test_what_a_radiance_header_says_of_its_colours_counts(tmp_path, line, factor, words):
    """Corrections are divided out, as exposures are; others were passed over."""
    (tmp_path / "a.hdr").write_bytes(plain_hdr(LIGHT))
    head = b"#?RADIANCE\n" + (b"" if b"xyze" in line else b"FORMAT=32-bit_rle_rgbe\n") + line + b"\n"
    (tmp_path / "b.hdr").write_bytes(plain_hdr(LIGHT, head))
    if words:
        with pytest.raises(SceneError, match=words):
            read_light(tmp_path / "b.hdr")
    else:
        expected = read_light(tmp_path / "a.hdr") * np.array(factor)
        np.testing.assert_allclose(read_light(tmp_path / "b.hdr"), expected, rtol=1e-6)


def test_runs_of_the_older_code_are_no_pixels(tmp_path):
    """A pixel of mantissas 1, 1, 1 repeats the one before; a file of another length was refused before."""
    data = bytearray(plain_hdr(LIGHT))
    data[-4:] = bytes((1, 1, 1, 4))
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(SceneError, match="do not have the stated length"):
        read_light(tmp_path / "a.hdr")


def test_the_one_layer_of_an_exr_is_read(tmp_path):
    """As a renderer names it; of two layers nobody says which one is meant."""
    planes = {f"View.Combined.{name}": plane for name, plane in equal_planes("R", "G", "B", "A").items()}
    assert read_light(write_exr(tmp_path / "a.exr", dict(planes)))[0, 0] == pytest.approx([0.5] * 3)
    planes |= {f"View.Gloss.{name}": plane for name, plane in equal_planes("R", "G", "B").items()}
    with pytest.raises(SceneError, match="no channels R, G and B"):
        read_light(write_exr(tmp_path / "b.exr", planes))


# Colours that a photograph states.

CODES = RNG.integers(0, 256, (16, 32, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize(
    ("profile", "expected"),
    [
        (edited_profile(), linear(CODES)),
        (edited_profile(gamma=1.0), CODES / 255.0),
        (edited_profile(gamma=1.8), (CODES / 255.0) ** 1.8),
        (edited_profile(colorants=P3), np.clip(linear(CODES) @ P3_TO_SRGB.T, 0.0, 1.0)),
        (b"no profile", linear(CODES)),
    ],
)
def test_a_colour_profile_counts(tmp_path, suffix, profile, expected):
    """Every photograph counted as sRGB: linear pictures were too dark, those of a wide gamut too pale."""
    path = tmp_path / f"a.{suffix}"
    codes = np.repeat(np.repeat(CODES, 16, axis=0), 16, axis=1)  # whole blocks of JPEG
    Image.fromarray(codes).save(
        path, icc_profile=profile, **({"quality": 100, "subsampling": 0} if suffix == "jpg" else {})
    )
    # codes of 8 bits: half a step before and after, 0.5 / 255 times the steepest slope of the curve, 2.3, each
    atol = 0.01 if suffix != "jpg" else 0.03
    np.testing.assert_allclose(read_light(path)[8::16, 8::16], expected, atol=atol)


def with_chunk(path: Path, name: bytes, data: bytes) -> Path:
    """PNG of the codes with one more chunk after its head of 33 bytes."""
    Image.fromarray(CODES).save(path)
    png, whole = path.read_bytes(), name + data
    path.write_bytes(png[:33] + struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole)) + png[33:])
    return path


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        (b"gAMA", struct.pack(">I", 45455), linear(CODES)),
        (b"gAMA", struct.pack(">I", 100000), CODES / 255.0),
        (b"gAMA", struct.pack(">I", 55556), (CODES / 255.0) ** 1.8),
        (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000), linear(CODES)),
        (b"cHRM", struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000), r"Rec\. 709 \(cHRM\)"),
        (b"gAMA", struct.pack(">I", 1), "gAMA of 1e-05"),
    ],
)
def test_what_a_png_says_of_its_colours_counts(tmp_path, name, data, expected):
    path = with_chunk(tmp_path / "a.png", name, data)
    if isinstance(expected, str):
        with pytest.raises(SceneError, match=expected):
            read_light(path)
    else:
        np.testing.assert_allclose(read_light(path), expected, atol=0.006)  # half a code of 8 bits, times 2.3


def test_a_camera_that_chose_adobe_rgb_is_told(tmp_path):
    """DCF 2.0: the interoperability index R03, and no profile."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(CODES).save(tmp_path / "a.jpg", exif=exif)
    with pytest.raises(SceneError, match=r"Adobe RGB \(EXIF\)"):
        read_light(tmp_path / "a.jpg")


@pytest.mark.parametrize(("least", "words"), [(255, ""), (1, ""), (0, "wholly transparent pixels")])
def test_holes_have_no_colour(tmp_path, least, words):
    """A stitched picture is white or black below the tripod, as its program likes."""
    codes = np.dstack([CODES, np.full((16, 32), 255, np.uint8)])
    codes[12:, :, 3] = least
    Image.fromarray(codes).save(tmp_path / "a.png")
    if words:
        with pytest.raises(SceneError, match=words):
            read_panorama(tmp_path / "a.png")
    else:
        np.testing.assert_allclose(read_panorama(tmp_path / "a.png"), linear(CODES), atol=1e-6)


def xmp(form: str, **properties: object) -> bytes:
    """XMP packet, properties as elements or attributes."""
    if form == "elements":
        return ("<rdf:D>" + "\n".join(f"<GPano:{k}>{v}</GPano:{k}>" for k, v in properties.items()) + "</>").encode()
    return ("<rdf:D " + " ".join(f'GPano:{k}="{v}"' for k, v in properties.items()) + " />").encode()


def sizes(part: tuple[int, int], whole: tuple[int, int]) -> dict[str, object]:
    names = (
        "CroppedAreaImageWidthPixels",
        "CroppedAreaImageHeightPixels",
        "FullPanoWidthPixels",
        "FullPanoHeightPixels",
    )
    return dict(zip(names, (*part, *whole), strict=True))


@pytest.mark.parametrize(("suffix", "form"), [("jpg", "elements"), ("png", "attributes"), ("tif", "attributes")])
@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"ProjectionType": "equirectangular", **sizes((32, 16), (32, 16)), "CroppedAreaTopPixels": 0}, ""),
        ({**sizes((8192, 4096), (8192, 4096)), "PosePitchDegrees": 0.9, "PoseRollDegrees": -0.5}, ""),  # made smaller
        (sizes((8192, 2000), (8192, 4096)), ""),  # filled up, then made smaller
        ({"PoseHeadingDegrees": 225.0, "InitialViewPitchDegrees": 20, "UsePanoramaViewer": True}, ""),
        (sizes((32, 16), (64, 32)), "shows 32 x 16 of 64 x 32 pixels"),
        (sizes((4096, 2048), (8192, 4096)), "shows 4096 x 2048 of 8192 x 4096 pixels"),
        ({"ProjectionType": "cylindrical"}, "projection 'cylindrical'"),
        ({"PosePitchDegrees": 17.0, "PoseRollDegrees": -121.0}, "pitch of 17 and a roll of -121 degrees"),
    ],
)
def test_what_a_panorama_says_of_its_sphere_counts(tmp_path, suffix, form, stated, words):
    """A crop with sides 2 : 1 was stretched over the whole sphere; a camera that leant made a room that leans."""
    path, packet = tmp_path / f"a.{suffix}", xmp(form, **stated)
    if suffix == "png":
        with_chunk(path, b"iTXt", b"XML:com.adobe.xmp" + bytes(5) + packet)
    else:
        Image.fromarray(CODES).save(path, **({"xmp": packet} if suffix == "jpg" else {"tiffinfo": {700: packet}}))
    if words:
        with pytest.raises(SceneError, match=words):
            read_panorama(path)
    else:
        assert read_panorama(path).shape == (16, 32, 3)


def test_two_fisheye_circles_are_no_panorama(tmp_path):
    """Unstitched pictures have sides of 2 : 1, too; black poles alone are those of a crop that was filled up."""
    y, x = np.mgrid[-1:1:128j, -1:3:256j]
    distance, height = np.hypot(y, (x + 1.0) % 2.0 - 1.0), 90.0 * np.abs(y)
    codes = RNG.integers(30, 256, (128, 256, 3), dtype=np.uint8)
    noise = RNG.integers(0, 8, codes.shape, dtype=np.uint8)
    for radius in (0.93, 1.0, 1.05):
        Image.fromarray(np.where(distance[..., None] < radius, codes, noise)).save(tmp_path / "a.png")
        with pytest.raises(SceneError, match="two circles"):
            read_panorama(tmp_path / "a.png")
    for highest_deg in range(20, 91, 5):
        for is_dark in (height > highest_deg, (height > highest_deg) & (y > 0.0), distance < 0.7):
            Image.fromarray(np.where(is_dark[..., None], noise, codes)).save(tmp_path / "a.png")
            assert read_panorama(tmp_path / "a.png").shape == codes.shape
