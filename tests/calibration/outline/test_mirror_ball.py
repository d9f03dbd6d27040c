"""Unwrapping of a mirror ball: photographs drawn by a ray tracer of the test's own come back as their surroundings."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers.colour_profiles import P3, P3_TO_SRGB, edited_profile, linear
from PIL import Image

from phibench.calibration.captures.picture_files import read_linear
from phibench.calibration.outline.mirror_ball import BallPhoto, find_ball, unwrap
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.recipe.room_tables import PanoramaTable
from phibench.datasets.rooms.panorama_files import read_panorama
from phibench.datasets.rooms.panorama_room import PanoramaSettings, panorama_room

RADIUS, SURROUNDINGS, FOCAL, SIZE = 0.05, 0.8, 1100.0, (480, 520)  # rows, columns
CENTRE = np.array([0.012, -0.008, 0.30])
"""Of the ball, camera frame (x right, y down): beside the camera's axis, so that its outline is no circle."""
OUTLINE_PX = FOCAL * math.tan(math.asin(RADIUS / 0.3))


def seen(d: np.ndarray) -> np.ndarray:
    """Light by direction from the ball's centre: x back along the camera's axis, z up."""
    x, y, z = np.moveaxis(d / np.linalg.norm(d, axis=-1, keepdims=True), -1, 0)
    return 0.45 + 0.2 * np.stack([x + 0.5 * y * z, y - 0.3 * z, z + 0.6 * x * y], axis=-1)


def photograph(elevation_deg: float = 0.0, centre: np.ndarray = CENTRE, background: float = 0.9) -> np.ndarray:
    """Pinhole rays to the pixel centres, the sphere's quadratic, r = d - 2 (d.n) n, the place on the outer sphere."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    d = np.stack([(u - (SIZE[1] - 1) / 2.0) / FOCAL, (v - (SIZE[0] - 1) / 2.0) / FOCAL, np.ones(SIZE)], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ centre
    root = b**2 - centre @ centre + RADIUS**2
    hit = root > 0.0
    P = d[hit] * (b[hit] - np.sqrt(root[hit]))[:, None] - centre
    n = P / RADIUS
    r = d[hit] - 2.0 * np.sum(d[hit] * n, axis=-1, keepdims=True) * n
    along = np.sum(P * r, axis=-1, keepdims=True)
    X = P + r * (np.sqrt(along**2 + SURROUNDINGS**2 - RADIUS**2) - along)
    image = np.full((*SIZE, 3), background)
    image[hit] = seen(to_world(X, elevation_deg))
    return image.astype(np.float32)


def to_world(vectors: np.ndarray, elevation_deg: float) -> np.ndarray:
    """Camera frame to the panorama's: at 0 degrees right is world y, down -z, forward -x; then the camera tips up."""
    x, y, z = -vectors[..., 2], vectors[..., 0], -vectors[..., 1]
    c, s = math.cos(math.radians(elevation_deg)), math.sin(math.radians(elevation_deg))
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def directions(rows: int) -> np.ndarray:
    elevation = (0.5 - (np.arange(rows)[:, None] + 0.5) / rows) * math.pi
    azimuth = (0.5 - (np.arange(2 * rows)[None, :] + 0.5) / (2 * rows)) * 2.0 * math.pi
    d = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0.0 * azimuth
    return np.stack(d, axis=-1)


@pytest.mark.parametrize("elevation_deg", [0.0, *(pytest.param(e, marks=pytest.mark.slow) for e in (90.0, -30.0))])
def test_surroundings_come_back(elevation_deg):
    """Pixels are 2 / r = 11 mrad apart in the ball's middle, and 1 / cos i as much towards its rim.

    Bilinear interpolation between them errs by curvature x spacing^2 / 8, 1e-5 in the middle. What is asked: 2e-3 where
    a pixel covers less than 50 mrad; the outline's error of 0.1 px is 0.2 / r = 1.1 mrad, times a slope below 0.4.
    """
    light = photograph(elevation_deg)
    ball = find_ball(light, BallPhoto(RADIUS, focal_px=FOCAL, elevation_deg=elevation_deg))
    # 0.05 px of the outline, and |s| by 0.05 px of its radius
    np.testing.assert_allclose(ball.view.rig.sphere_in_camera_m, CENTRE, atol=2e-4)
    found = unwrap(light, ball, SURROUNDINGS, 256)
    expected = seen(directions(128))
    towards = to_world(-CENTRE / np.linalg.norm(CENTRE), elevation_deg)
    angle = np.arccos(np.clip(directions(128) @ towards, -1.0, 1.0))
    middle = angle < math.radians(120.0)
    assert np.abs(found.light - expected)[middle].max() < 2e-3
    assert np.abs(found.light - expected)[found.seen].max() < 0.03
    # a ray that grazes the ball, 80.4 degrees from the line to the camera, meets the surroundings at 166.8 degrees;
    # the rim of 0.5 % and a pixel of 185 ends at sin i = 0.9896, which turns the ray by 2 (90 - 81.7) degrees less
    assert np.degrees(angle[~found.seen].min()) == pytest.approx(166.8 - 16.5, abs=1.0)
    assert np.degrees(angle[found.seen].max()) < 166.8
    assert np.abs(found.light - expected)[~found.seen].max() < 0.2  # the nearest direction: half a radian at most


@pytest.mark.slow
def test_distance_of_the_surroundings_matters():
    """A point 0.8 m off is seen from a place up to 50 mm beside the centre: 60 mrad."""
    light = photograph()
    ball = find_ball(light, BallPhoto(RADIUS, focal_px=FOCAL))
    middle = np.abs(np.arctan2(directions(128)[..., 1], directions(128)[..., 0])) < 2.0
    error = np.abs(unwrap(light, ball, 1e6, 256).light - seen(directions(128)))[middle].max()
    assert error > 5e-3


@pytest.mark.slow
def test_distance_gives_the_focal_length():
    light = photograph(centre=np.array([0.0, 0.0, 0.30]))
    ball = find_ball(light, BallPhoto(RADIUS, distance_m=0.30))
    # 0.1 px of 185
    assert ball.view.rig.camera.fx_px == pytest.approx(FOCAL, rel=1e-3)
    assert ball.circle_px == pytest.approx((259.5, 239.5, OUTLINE_PX), abs=0.2)


def test_a_stated_circle_is_taken():
    light = photograph(centre=np.array([0.0, 0.0, 0.30]))
    ball = find_ball(light, BallPhoto(RADIUS, focal_px=FOCAL, circle_px=(259.5, 239.5, OUTLINE_PX)))
    np.testing.assert_allclose(ball.view.rig.sphere_in_camera_m, [0.0, 0.0, 0.30], atol=1e-12)
    assert ball.edges == 1.0


@pytest.mark.slow
def test_a_panorama_coarser_than_the_photograph_is_averaged():
    """Noise falls with the number of the photograph's pixels in one of the panorama's, 9 x 9 in the middle."""
    light = photograph(centre=np.array([0.0, 0.0, 0.30]))
    noisy = light + np.random.default_rng(2).normal(0.0, 0.05, light.shape).astype(np.float32)
    ball = find_ball(light, BallPhoto(RADIUS, focal_px=FOCAL))
    noise = [
        (unwrap(noisy, ball, SURROUNDINGS, w).light - unwrap(light, ball, SURROUNDINGS, w).light) for w in (64, 256)
    ]
    fine, coarse = (each[len(each) // 4 : -len(each) // 4].std() for each in reversed(noise))
    assert coarse < 0.5 * fine


@pytest.mark.slow
@pytest.mark.parametrize("background", [0.0, 0.3, 0.9])
def test_the_outline_is_found_before_any_background(background):
    """Light may rise or fall at the outline, or both along it."""
    ball = find_ball(photograph(background=background), BallPhoto(RADIUS, focal_px=FOCAL))
    np.testing.assert_allclose(ball.view.rig.sphere_in_camera_m, CENTRE, atol=2e-3)


# The command.


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    x = photograph()
    codes = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)
    Image.fromarray(np.rint(255.0 * codes).astype(np.uint8)).save(tmp_path / "ball.png")
    return tmp_path / "ball.png"


STATED = ("--radius-m", "0.05", "--focal-px", "1100")


@pytest.mark.parametrize("name", ["room.exr", "room.png"])
def test_command_writes_a_panorama_that_makes_a_room(photo, tmp_path, capsys, name):
    """8 bits: half a code of a slope of up to 1 / 100; two such steps in the PNG."""
    out = tmp_path / name
    options = ("--surroundings-m", "0.8", "--width", "200")
    assert main(["room", "from-mirror-ball", str(photo), "--out", str(out), *STATED, *options]) == 0
    said = capsys.readouterr().out
    assert "outline: centre" in said
    assert "ball's centre 0.3" in said
    # the printed table is that of a recipe: no number in it is refused, and the example says that it is one
    [table] = tomllib.loads(said[said.index("[[rooms") :])["rooms"]["panoramas"]
    assert table["file"] == name
    assert PanoramaTable.model_validate(table).settings(0.0).box_m == (-1.0, 1.0, -1.0, 1.0, 2.5)  # a room has 2 m
    assert said.count("an example: put in yours") == 3
    drawn = np.asarray(Image.open(tmp_path / "room-outline.png")).astype(int)
    red = np.argwhere((drawn == [255, 0, 0]).all(axis=-1))
    middle = 0.5 * (np.array(SIZE) - 1.0) + FOCAL / 0.3 * CENTRE[1::-1]  # of the ball, (row, column), to some pixels
    assert np.abs(np.linalg.norm(red - middle, axis=1) - OUTLINE_PX).max() < 6.0
    light = read_panorama(out)
    assert light.shape == (100, 200, 3)
    azimuth = np.abs(np.arctan2(directions(100)[..., 1], directions(100)[..., 0]))
    assert np.abs(light - seen(directions(100)))[azimuth < 1.5].max() < 0.015
    room = panorama_room(PanoramaSettings(out, (0.3, 0.2, 1.2), box_m=(-2.0, 2.0, -2.0, 2.0, 2.5), texel_m=0.05))
    assert room.lit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"--focal-px": None}, "one of them"),
        ({"--distance-m": "0.3"}, "one of them"),
        ({"--radius-m": "-1"}, "must be above 0"),
        ({"--focal-px": None, "--distance-m": "0.05"}, "above 1.02 radii"),
        ({"--surroundings-m": "0.06"}, "above 1.5 radii"),
        ({"--width": "201"}, "even number"),
        ({"--camera-elevation-deg": "120"}, "-90 to 90"),
        ({"--out": "room.jpg"}, ".exr or .png"),
        ({"--focal-px": "10"}, "into the ball"),
        ({"--point-m": ("9", "0", "1")}, "--point-m = (9.0, 0.0, 1.0): the camera must be inside the box"),
        ({"--box-m": ("2", "-2", "-2", "2", "2.5")}, "--box-m = (2.0, -2.0, -2.0, 2.0, 2.5): x_low = 2 is not below"),
        ({"--circle": ("5000", "100", "50")}, "meet the picture"),
    ],
)
def test_mistakes_end_in_one_sentence(photo, tmp_path, capsys, monkeypatch, change, word):
    monkeypatch.chdir(tmp_path)
    options: dict = {"--out": "room.exr", "--radius-m": "0.05", "--focal-px": "1100", **change}
    tokens = [
        t for name, value in options.items() if value for t in (name, *([value] if isinstance(value, str) else value))
    ]
    assert main(["room", "from-mirror-ball", str(photo), *tokens]) == 2
    out, err = capsys.readouterr()
    assert word in err
    assert err.count("\n") == 1
    assert "Traceback" not in out + err
    assert not list(tmp_path.glob("room*"))


@pytest.mark.slow
def test_a_picture_without_a_ball_is_refused(tmp_path):
    rng = np.random.default_rng(1)
    for light in (rng.random((200, 300, 3)), np.full((200, 300, 3), 0.5), np.zeros((200, 300, 3))):
        with pytest.raises(DatasetError, match="no outline of a ball"):
            find_ball(light.astype(np.float32), BallPhoto(RADIUS, focal_px=FOCAL))


def test_a_photograph_has_the_colours_of_its_profile(tmp_path):
    """Display P3, as telephones write it: a red of code 200 is one of more light than sRGB's."""
    codes = np.full((16, 16, 3), (200, 60, 60), np.uint8)
    Image.fromarray(codes).save(tmp_path / "a.png", icc_profile=edited_profile(colorants=P3))
    expected = np.clip(P3_TO_SRGB @ linear(codes)[0, 0], 0.0, 1.0)
    # two roundings to 8 bits, half a code of 1 / 255 each, where the curve's slope is below 2
    np.testing.assert_allclose(read_linear(tmp_path / "a.png")[8, 8], expected, atol=2.0 / 255.0)
