"""Alignment: direction and size of the move, its sigma, the picture, and the command."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from helpers.ball_photographs import ball_photograph
from helpers.limb_frames import limb_light
from PIL import Image
from scipy import ndimage

from phibench.calibration.captures.picture_files import read_linear, read_picture
from phibench.calibration.captures.rig_file import read_rig_file
from phibench.calibration.outline.ball_circle import BallCircle
from phibench.calibration.outline.contour import aside_by_tilt_m
from phibench.calibration.outline.first_circle import rig_circle
from phibench.calibration.rig.align import (
    Alignment,
    alignment,
    circle_in_words,
    circle_of,
    distance_of,
    in_words,
    nominal_centre,
    sharpness,
)
from phibench.cli import main as cli
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import linear_to_srgb
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Pose
from phibench.scenes.rig import Rig

OFF_M = (1.5e-3, -0.8e-3)


def room(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return 1.0 + 0.1 * directions[:, 0]


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    rig = replace(Rig(), T_camera_sphere=Pose("camera", "sphere", (*OFF_M, 0.2605)))
    return limb_light(rig, np.random.default_rng(31), room=room)


def test_the_move_brings_the_mirror_above_the_lens(light) -> None:
    found = alignment(light, Rig(), tilt_sigma_rad=0.0, principal_point_sigma_px=0.0, vertical=False)
    assert found.meeting is None
    assert found.move_world_m == pytest.approx([-OFF_M[0], -OFF_M[1], 0.0], abs=3e-6)
    assert found.move_px == pytest.approx(-1430.0 / 0.2605 * np.array(OFF_M), abs=0.05)
    assert found.sigma_m == found.sigma_outline_m


@pytest.mark.slow
def test_doubts_about_the_camera_are_in_sigma(light) -> None:
    """0.1 deg and 5 px at 0.26 m: 0.45 mm and 0.91 mm."""
    found = alignment(light, Rig())
    assert found.sigma_m == pytest.approx(np.hypot(0.2605 * np.radians(0.1), 0.2605 * 5.0 / 1430.0), rel=1e-3)


@pytest.mark.slow
def test_a_tilted_camera_moves_along_the_worlds_axes(light) -> None:
    """Turned by 90 degrees about the vertical, the image's right is the world's y."""
    turned = replace(Rig(), T_world_camera=Pose("world", "camera", (0, 0, 0.45), ((0, -1, 0), (1, 0, 0), (0, 0, 1))))
    found = alignment(light, turned)
    assert found.move_world_m == pytest.approx([OFF_M[1], -OFF_M[0], 0.0], abs=3e-6)
    assert found.move_camera_m == pytest.approx([-OFF_M[0], -OFF_M[1], 0.0], abs=3e-6)


def test_command_reads_the_cameras_jpeg_and_draws(light, tmp_path, capsys) -> None:
    file, out = tmp_path / "frame.jpg", tmp_path / "arrow.png"
    file.write_bytes(Chain(sensor("mjpeg")).jpeg_bytes(Light(light), NoiseStream(("align",))))
    assert cli.main(["align", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.index("centred, as far as") < said.index("arrow.png") < said.index("1.70 mm")
    assert "--outline-sigma-factor" in said
    assert "1.70 mm" in said  # |(1.5, 0.8)|
    assert "the paper's check): fewer than 3 agree" in said  # a room without edges
    assert "sharpness in the mirror: 0." in said
    assert "left" in said
    assert "down" in said
    before, after = (np.asarray(Image.open(path).convert("RGB"), float) for path in (file, out))
    assert (np.abs(after - before).max(axis=-1) > 30).sum() > 1000  # the outline alone is 2000 px long


def with_edges(light: np.ndarray, rig: Rig) -> np.ndarray:
    """Nine bright sectors on the walls in the mirror: edges through the middle of its outline."""
    u0, v0, radius = rig_circle(rig)
    v, u = np.mgrid[: light.shape[1], : light.shape[2]]
    away, turn = np.hypot(u - u0, v - v0), np.arctan2(v - v0, u - u0)
    bright = np.zeros(turn.shape)
    for start in np.linspace(-3.0, 2.6, 9):
        for border, sign in ((start, 1.0), (start + 0.3, -1.0)):
            bright += sign / (1.0 + np.exp(-np.clip((turn - border) * away / 0.5, -50.0, 50.0)))
    return np.asarray(light * (1.0 + 0.5 * bright * ((away > 0.4 * radius) & (away < 0.94 * radius))), np.float32)


@pytest.mark.slow
def test_vertical_edges_make_the_papers_check(tmp_path, capsys) -> None:
    """An aligned rig whose edges pass through the middle: found, drawn, and worth more than 0.1 deg and 5 px."""
    light = with_edges(limb_light(Rig(), np.random.default_rng(33), room=room), Rig())
    used = alignment(light, Rig())
    assert used.meeting is not None
    assert len(used.meeting.edges) >= 15
    assert used.meeting.off_px < 0.3
    # 18 edges tell the point to some hundredths of a pixel; what is left is 1 - 0.83 of the principal point's 0.91 mm
    assert used.sigma_m < 0.25 * np.hypot(0.26 * np.radians(0.1), 0.26 * 5.0 / 1430.0)
    assert np.linalg.norm(used.move_world_m) < 3.0 * used.sigma_m
    file, out = tmp_path / "frame.jpg", tmp_path / "drawn.png"
    file.write_bytes(Chain(sensor("mjpeg")).jpeg_bytes(Light(light), NoiseStream(("align", "edges"))))
    assert cli.main(["align", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    for words in ("the paper's check): ", "they pass through it", "deg from the nominal one", "turn the lens until"):
        assert words in said, said
    drawn = np.asarray(Image.open(out).convert("RGB"), int)
    assert (np.abs(drawn - (0, 200, 255)).max(axis=-1) < 10).sum() > 1000  # fifteen edges of 50 px, 3 px wide


def test_a_blurred_picture_is_less_sharp_at_any_noise() -> None:
    """Checks of 24 px in noise of 0 and 5 %: sharpness falls with the blur, and noise does not turn that around."""
    rng, (v, u) = np.random.default_rng(9), np.mgrid[:720, :1280]
    checks = 1.0 + 0.5 * np.sign(np.sin(u / 24.0) * np.sin(v / 24.0))
    for noise in (0.0, 0.05):
        found = []
        for blur_px in (0.7, 1.0, 1.5, 2.5, 4.0):
            light = ndimage.gaussian_filter(checks, blur_px) + noise * rng.standard_normal(checks.shape)
            found.append(sharpness(np.repeat(light[None], 3, axis=0), None, (639.5, 359.5, 339.0)))
        assert np.all(np.diff(found) < -0.01), found


@pytest.fixture
def rig_file(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text('[rig.mirror]\nshape = "hyperboloid"\n')
    return file


def test_a_rig_file_says_a_mirror_of_another_shape(rig_file, tmp_path, capsys) -> None:
    """A hyperboloid aside by 1.70 mm, within 0.03 mm; half a degree of its own tilt is in sigma."""
    rig = read_rig_file(rig_file).rig
    aside = replace(rig, T_camera_sphere=Pose("camera", "sphere", (*OFF_M, rig.sphere_in_camera_m[2])))
    frame = Chain(sensor("srgb8")).frame(
        Light(limb_light(aside, np.random.default_rng(5), room=room)), NoiseStream(("align",))
    )
    file, out = tmp_path / "frame.png", tmp_path / "arrow.png"
    Image.fromarray(frame).save(file)
    exact = ("--principal-point-sigma-px", "0", "--tilt-sigma-deg", "0")
    assert cli.main(["align", str(file), "--rig", str(rig_file), "--out", str(out), *exact]) == 0
    said = capsys.readouterr().out
    moved = [float(said.split(f"{axis} ")[1].split(" mm")[0]) for axis in ("world x", "mm, y")]
    assert moved == pytest.approx([-1.5, 0.8], abs=0.03)
    sigma = float(said.split("standard deviation ")[1].split(" mm")[0])
    assert sigma == pytest.approx(1e3 * aside_by_tilt_m(rig) * np.radians(0.5), abs=0.02)
    assert sigma > 0.3
    assert Image.open(out).size == (1280, 720)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--radius-mm", "60"), ("--radius-mm: ", "says what the rig is", "leave the option out")),
        (("--cx-px", "630"), ("--cx-px: ", "leave the option out")),
        ((), ("300 x 200 pixels", "1280 x 720", "write width_px")),
    ],
)
def test_what_contradicts_a_rig_file_is_refused(rig_file, tmp_path, capsys, options, words) -> None:
    file = tmp_path / "grey.png"
    Image.fromarray(np.full((200, 300, 3), 90, np.uint8)).save(file)
    assert cli.main(["align", str(file), "--rig", str(rig_file), *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(word in said for word in words), said


def test_a_rig_file_that_is_none_is_refused(tmp_path, capsys) -> None:
    file = tmp_path / "rig.toml"
    for text in ('[rig.mirror]\nshape = "pyramid"\n', "[rig.mirror"):
        file.write_text(text)
        assert cli.main(["align", str(tmp_path / "a.png"), "--rig", str(file)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_what_is_no_frame_is_refused_in_one_sentence(tmp_path, capsys) -> None:
    text = tmp_path / "a.png"
    text.write_text("no picture")
    with pytest.raises(ImageError, match="not a picture"):
        read_picture(text)
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((720, 1280), np.uint8)).save(buffer, "PNG")
    text.write_bytes(buffer.getvalue())
    assert cli.main(["align", str(text)]) == 2
    assert cli.main(["align", str(tmp_path / "none.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 2
    Image.fromarray(np.full((32, 32), 60_000, np.uint16)).save(text)  # a photograph of 16 bits, or DN of a mosaic
    assert cli.main(["align", str(text)]) == 2
    assert "--sensor, or a photograph with 8 bits" in capsys.readouterr().err


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, BallCircle]]:
    """Pictures whose circle the command has fitted, with it; the same pixels again cost no second fit."""
    done = list[tuple[np.ndarray, BallCircle]]()

    def circle(image: np.ndarray, card: SensorCard) -> BallCircle:
        for known, found in done:
            if np.array_equal(known, image):
                return found
        done.append((image, circle_of(image, card)))
        return done[-1][1]

    monkeypatch.setattr("phibench.calibration.rig.align.circle_of", circle)
    return done


@pytest.mark.parametrize(("ellipse_px", "said"), [((3.7, 0.0), "7 % longer along 0 deg"), ((0.0, 0.9), "")])
def test_a_stretched_picture_is_told(ellipse_px: tuple[float, float], said: str) -> None:
    """Pixels of 16:15, as in video; an ellipse of 1.6 % is that of a sphere 10 degrees off the axis."""
    circle = BallCircle((250.0, 170.0, 113.0), ellipse_px, 0.25 * np.eye(3), 40.0, 3.0, np.zeros(360))
    words = circle_in_words(circle)
    assert said in words
    assert ("doubtful: it is an ellipse" in words) == bool(said)


def test_a_photograph_of_an_unknown_camera_gives_the_circle(fitted, tmp_path, capsys) -> None:
    """Neither focal length nor distance: the circle in pixels. With the focal length the outline tells the distance."""
    photo = ball_photograph(np.random.default_rng([7, 3]))
    codes = np.rint(255.0 * linear_to_srgb(np.clip(photo.light / 1.5, 0.0, 1.0))).astype(np.uint8)
    file, out = tmp_path / "ball.png", tmp_path / "circle.png"
    Image.fromarray(codes).save(file)
    assert cli.main(["align", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"radius {photo.radius_px:.0f}"[:-1] in said
    assert "give --focal-px" in said
    assert "vertical edges (the paper's check): " in said
    assert Image.open(out).size == (640, 480)
    assert cli.main(["align", str(file), "--cx-px", "319.5", "--out", str(out)]) == 2
    assert "--cx-px 319.5: needs --focal-px" in capsys.readouterr().err
    ((seen, circle),) = fitted
    assert np.array_equal(seen, codes)
    assert distance_of(circle, photo.focal_px, 0.06) == pytest.approx(0.06 * np.linalg.norm(photo.centre), rel=0.01)


@pytest.mark.slow
def test_grey_turned_and_deep_photographs_are_read_like_their_twin(fitted, tmp_path, capsys) -> None:
    """A grey JPEG, one that EXIF turns, and TIFF: `align` and the panorama's reader find the circle of the PNG.

    Three circles are fitted: the TIFF has the pixels of the PNG.
    """
    photo = ball_photograph(np.random.default_rng([7, 5]))
    codes = np.rint(255.0 * linear_to_srgb(np.clip(photo.light / 1.5, 0.0, 1.0))).astype(np.uint8)
    grey, exif = Image.fromarray(codes).convert("L"), Image.Exif()
    exif[0x0112] = 6  # stored after a quarter turn against the clock
    grey.save(tmp_path / "twin.png")
    grey.save(tmp_path / "grey.jpg", quality=95)
    grey.rotate(90, expand=True).save(tmp_path / "turned.jpg", quality=95, exif=exif)
    grey.save(tmp_path / "grey.tif")
    circles = {}
    for name in ("twin.png", "grey.jpg", "turned.jpg", "grey.tif"):
        assert cli.main(["align", str(tmp_path / name), "--out", str(tmp_path / "out.png")]) == 0
        said = re.search(r"\(([\d.]+) \+- [\d.]+, ([\d.]+) .*radius ([\d.]+)", capsys.readouterr().out)
        assert said is not None, name
        circles[name] = np.array([float(x) for x in said.groups()])
        # JPEG of quality 95 moves an edge by hundredths of a pixel; the sentence has one decimal
        assert np.abs(circles[name] - circles["twin.png"]).max() <= 0.25, name
        light = read_linear(tmp_path / name)
        assert light.shape == (*codes.shape[:2], 3)
        assert np.abs(light - read_linear(tmp_path / "twin.png")).max() < 0.1
    assert len(fitted) == 3


@pytest.mark.parametrize("size", [(1, 1), (12, 9), (300, 200)])
def test_pictures_without_a_ball_end_in_one_sentence(tmp_path, capsys, size) -> None:
    file = tmp_path / "grey.png"
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(file)
    assert cli.main(["align", str(file)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no outline of a ball was found" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (("--radius-mm", "600"), ("--radius-mm 600", "--distance-mm 260")),
        (("--radius-mm", "-3"), ("above 0",)),
        (("--distance-mm", "40"), ("1.02 radii to 10 m",)),
        (("--radius-mm", "1"), ("radius of 6 px", "check these numbers")),
        (("--radius-mm", "30"), ("without a mirror", "looked for was an outline", "116 to 233 px")),
    ],
)
def test_numbers_of_another_mirror_are_named(light, tmp_path, capsys, numbers, words) -> None:
    file = tmp_path / "frame.jpg"
    file.write_bytes(Chain(sensor("mjpeg")).jpeg_bytes(Light(light), NoiseStream(("align",))))
    assert cli.main(["align", str(file), *numbers]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(word in said for word in words), said


def test_a_picture_that_is_no_whole_frame_needs_its_principal_point() -> None:
    whole = Rig().camera
    assert nominal_centre(np.zeros((720, 1280, 3)), whole) == (639.5, 359.5)
    assert nominal_centre(np.zeros((720, 1180, 3)), whole, 539.5, 359.5) == (539.5, 359.5)
    for shape in ((720, 1180), (540, 960)):
        with pytest.raises(ImageError, match="1280 x 720"):
            nominal_centre(np.zeros((*shape, 3)), whole)


def test_standard_deviations_below_0_are_refused() -> None:
    with pytest.raises(ImageError, match="0 or above"):
        alignment(np.zeros((720, 1280, 3), np.uint8), Rig(), None, -0.1)


@pytest.mark.parametrize(
    ("sigma_m", "words"), [(1e-4, "move the mirror by 2.00 mm"), (1.9e-3, "measured, and perhaps chance")]
)
def test_a_move_that_chance_explains_is_no_instruction(sigma_m: float, words: str) -> None:
    move, outline, camera = np.array([2e-3, 0.0, 0.0]), cast(Any, None), cast(Any, None)
    assert in_words(Alignment(move, move, move[:2], 1e-5, sigma_m, outline, camera)).startswith(words)
