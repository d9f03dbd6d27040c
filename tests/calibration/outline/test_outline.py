"""The outline's fit against images of known spheres, drawn by other mathematics (`limb_frames`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.limb_frames import drawn_rig, limb_light

from phibench.calibration.outline.first_circle import circles_by_size, grey, sphere_from_circle, sphere_from_rays
from phibench.calibration.outline.limb_image import Plane, Tap, binned_planes, planes_of
from phibench.calibration.outline.limb_sectors import Sectors, _medians, scatter
from phibench.calibration.outline.outline import _approach as approach
from phibench.calibration.outline.outline import find_outline, fit_outline, outline_at
from phibench.calibration.outline.outline_least_squares import step_from
from phibench.calibration.outline.outline_result import binned_rig
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.spots.camera_codes import linear_to_srgb, srgb_to_linear
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.processing import demosaic, eight_bit
from phibench.render.sensor.settings import sensor
from phibench.render.sensor.srgb import srgb_encoded as srgb_of_the_camera
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Pose
from phibench.scenes.rig import Rig


def plain_circle(points_px: np.ndarray) -> tuple[float, float, float]:
    """Least-squares circle (u, v, radius) through edges, shape (n, 2), pixels."""
    from skimage.measure import CircleModel

    model = CircleModel.from_estimate(points_px)  # type: ignore[no-untyped-call]
    return float(model.center[0]), float(model.center[1]), float(model.radius)


def sphere_from_ellipse(points_px: np.ndarray, camera: Camera, radius_m: float) -> np.ndarray:
    """Sphere centre from the least-squares ellipse through edges: the cone over it."""
    from skimage.measure import EllipseModel

    model = EllipseModel.from_estimate(points_px)  # type: ignore[no-untyped-call]
    return sphere_from_rays(camera.rays(model.predict_xy(np.linspace(0.0, 2.0 * np.pi, 360))), radius_m)


def grey_room(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A room whose light changes slowly with direction."""
    return 1.0 + 0.1 * directions[:, 0] - 0.05 * directions[:, 1] * directions[:, 2]


@pytest.fixture(scope="module")
def case() -> tuple[Rig, np.ndarray]:
    rng = np.random.default_rng(11)
    rig = drawn_rig(rng)
    return rig, limb_light(rig, rng, room=grey_room)


@pytest.fixture(scope="module")
def frames(case) -> dict[str, np.ndarray]:
    rig, light = case
    names = ("bayer-raw", "srgb8", "mjpeg")
    return {name: Chain(sensor(name), 0, rig.camera).frame(Light(light), NoiseStream(("outline",))) for name in names}


def nominal(rig: Rig) -> Rig:
    """What a user starts from: the mirror straight above, at about the right distance."""
    return replace(rig, T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, 0.258)))


def test_accuracy_from_scratch_on_light_without_noise(case) -> None:
    """Targets 5 um across and 20 um along the axis; the 3 x 3 rays per pixel of the picture itself are good to 1 um."""
    rig, light = case
    error = find_outline(light, nominal(rig)).sphere_in_camera_m - rig.sphere_in_camera_m
    assert np.abs(error[:2]).max() < 1e-6
    assert abs(error[2]) < 4e-6


def test_plain_fits_are_biased(case) -> None:
    """The steepest place of the light is inside the limb: circle, ellipse and cone put the sphere 0.1 mm too far."""
    rig, light = case
    picture = grey(planes_of(light))
    points, s = next(next(circles_by_size(picture, nominal(rig)))).points_px, rig.sphere_in_camera_m
    camera, R = rig.camera, rig.sphere.radius_m
    for found in (
        sphere_from_circle(plain_circle(points), camera, R),
        sphere_from_ellipse(points, camera, R),
        sphere_from_rays(camera.rays(points), R),
    ):
        assert found[2] - s[2] > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_frames_within_their_covariance(case, frames, preset: str) -> None:
    """Mahalanobis distance of 3 numbers, false alarm rate 1e-4; a centre 0.2 mm off is refused."""
    rig = case[0]
    found = find_outline(frames[preset], nominal(rig), sensor_card(preset))
    limit = scipy.stats.chi2.isf(1e-4, 3)

    def distance(error: np.ndarray) -> float:
        return float(error @ np.linalg.solve(found.covariance_m2, error))

    error = found.sphere_in_camera_m - rig.sphere_in_camera_m
    assert distance(error) < limit
    assert distance(error + [0.0, 0.0, 2e-4]) > limit
    assert found.sigma_m.max() < 3e-5
    assert found.contrast == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_long_picture_is_fitted_in_squares(case, frames, monkeypatch: pytest.MonkeyPatch) -> None:
    """In squares of 2 px errors keep within their covariance, false alarm rate 1e-4, and lengths are in pixels.

    The band of 5 squares reaches twice as far into the mirror: the sigma is not larger than half as much again.
    """
    rig, card = nominal(case[0]), sensor_card("mjpeg")
    whole = find_outline(frames["mjpeg"], rig, card)
    monkeypatch.setattr("phibench.calibration.outline.outline._BINNED_PX", 640)
    sizes: list[tuple[int, ...]] = []

    def approached(at, *arguments):
        sizes.append(at.planes[0].values.shape)
        return approach(at, *arguments)

    monkeypatch.setattr("phibench.calibration.outline.outline._approach", approached)
    found = find_outline(frames["mjpeg"], rig, card)
    assert sizes == [(360, 640)]
    error = found.sphere_in_camera_m - case[0].sphere_in_camera_m
    assert error @ np.linalg.solve(found.covariance_m2, error) < scipy.stats.chi2.isf(1e-4, 3)
    assert (found.sigma_m < 1.5 * whole.sigma_m).all()
    assert found.blur_px == pytest.approx(whole.blur_px, abs=0.4)
    squares = binned_planes(planes_of(frames["mjpeg"], card), 2)
    again = fit_outline(outline_at(squares, binned_rig(rig, 2), found.sphere_in_camera_m))
    assert found.shift_rms_px == pytest.approx(2.0 * again.shift_rms_px, rel=0.05)
    assert np.allclose((binned_rig(rig, 2).outline_px() + 0.5) * 2.0 - 0.5, rig.outline_px())


@pytest.mark.slow
def test_a_hopeless_fit_ends_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dark disc on a bright wall is an outline, but no light of polished steel: 30 steps would not come to rest."""
    rig = Rig()
    v, u = np.mgrid[: rig.camera.height_px, : rig.camera.width_px]
    middle = rig.outline_px().mean(axis=0)
    radius = float(np.hypot(*(rig.outline_px() - middle).T).mean())
    light = np.where(np.hypot(u - middle[0], v - middle[1]) < radius - 1.0, 0.2, 1.0)
    light = light + 0.02 * np.random.default_rng(5).standard_normal(light.shape)
    steps = []

    def counted(*arguments, **options):
        steps.append(step_from(*arguments, **options))
        return steps[-1]

    monkeypatch.setattr("phibench.calibration.outline.outline.step_from", counted)
    with pytest.raises(ImageError, match="without a mirror"):
        fit_outline(outline_at(planes_of(np.stack([light] * 3)), rig, rig.sphere_in_camera_m))
    assert len(steps) <= 6 + 6  # to come near, and to see that it leads nowhere


@pytest.mark.parametrize("block", [2, 3])
def test_squares_hold_the_mean_of_what_is_usable(block: int) -> None:
    rng = np.random.default_rng(3)
    values, usable = rng.random((7, 8)), rng.random((7, 8)) > 0.3
    plane = Plane(values, usable, (((Tap(0.7, 0, 1, 0), Tap(0.3, 1)),) * 4))
    small = binned_planes((plane,), block)[0]
    for v, u in np.ndindex(small.values.shape):
        square = slice(v * block, (v + 1) * block), slice(u * block, (u + 1) * block)
        assert small.usable[v, u] == usable[square].any()
        if small.usable[v, u]:
            assert small.values[v, u] == pytest.approx(values[square][usable[square]].mean())
    assert small.taps[0] == (Tap(0.7, 0), Tap(0.3, 1))


def test_medians_of_groups_are_numpys() -> None:
    rng = np.random.default_rng(4)
    group, values = rng.integers(0, 7, 40), rng.standard_normal(40)
    group[group == 3] = 2  # one without values
    found = _medians(values, group, np.bincount(group, minlength=8))
    expected = [np.median(values[group == k]) if (group == k).any() else 0.0 for k in range(8)]
    assert np.allclose(found, expected, rtol=1e-12)


def test_light_of_codes_is_light_of_numbers(frames) -> None:
    by_codes = planes_of(frames["mjpeg"], sensor_card("mjpeg"))[0]
    by_numbers = planes_of(frames["mjpeg"].astype(float), sensor_card("mjpeg"))[0]
    assert np.allclose(by_codes.values, by_numbers.values, rtol=0.0, atol=1e-14)
    assert np.array_equal(by_codes.usable, by_numbers.usable)
    assert by_codes.taps == by_numbers.taps


@pytest.mark.slow
def test_radius_and_distance_scale_together(case) -> None:
    rig, light = case
    planes, s = planes_of(light), rig.sphere_in_camera_m
    larger = replace(rig, mirror=replace(rig.mirror, radius_m=1.01 * rig.sphere.radius_m))
    starts = outline_at(planes, rig, s + 1e-4), outline_at(planes, larger, 1.01 * (s + 1e-4))
    a, b = map(fit_outline, starts)
    # the same cone; Fresnel's angle across the limb is the same too; 1e-7 m is where the steps come to rest
    assert b.sphere_in_camera_m == pytest.approx(1.01 * a.sphere_in_camera_m, abs=1e-6)


@pytest.mark.slow
def test_an_image_without_a_mirror_is_refused() -> None:
    rng = np.random.default_rng(12)
    blocks = np.kron(rng.uniform(0.5, 2.0, (9, 16)), np.ones((80, 80)))
    for image in (np.ones((3, 720, 1280)), np.zeros((3, 720, 1280)), rng.poisson(900.0, (3, 720, 1280)), [blocks] * 3):
        with pytest.raises(ImageError, match="without a mirror"):
            find_outline(np.asarray(image, float), Rig())


def test_a_mirror_cut_by_the_frame(case) -> None:
    """Moved up by 100 px, 70 % of the outline are left, which is enough; by 400 px, 40 %, which is not."""
    rig, light = case
    for shift, enough in ((100, True), (400, False)):
        cut = np.roll(light, -shift, axis=1)
        cut[:, -shift:] = np.median(light)
        moved = replace(rig, camera=replace(rig.camera, cy_px=rig.camera.cy_px - shift))
        assert (outline_at((), moved, rig.sphere_in_camera_m).visible_arc() > 0.5) is enough
        if enough:
            found = fit_outline(outline_at(planes_of(cut), moved, rig.sphere_in_camera_m + 2e-4))
            error = found.sphere_in_camera_m - rig.sphere_in_camera_m
            assert np.abs(error).max() < 2e-5
            assert found.arc < 0.85
        else:
            with pytest.raises(ImageError, match="cut by the frame"):
                fit_outline(outline_at(planes_of(cut), moved, rig.sphere_in_camera_m + 2e-4))


def lamps_on_a_dark_plate(rig: Rig, part: float) -> np.ndarray:
    """Bare lamps, reflected in a part of the limb in eight wedges, before a dark plate."""
    lamp, plate = 1e4, 0.05  # of the room's light

    def room(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        reflected = np.linalg.norm(points - rig.T_world_camera.t, axis=-1) > 1e-6  # the others begin at the lens
        turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi)
        light = np.where((8.0 * turn) % 1.0 < part, lamp, 1.0 + 0.1 * directions[:, 0])
        return np.where(reflected, light, plate)

    light = limb_light(rig, np.random.default_rng(3), room=room)
    rows, columns = np.indices(light.shape[1:])
    u, v = rig.outline_px().mean(axis=0)
    radius = float(np.hypot(*(rig.outline_px() - (u, v)).T).mean())
    beyond = np.hypot(columns - u, rows - v) > radius + 9.0  # of the part that is traced
    return np.where(beyond, light[:, 5, 5][:, None, None] * plate, light).astype(np.float32)


@pytest.mark.parametrize("part", [pytest.param(0.2, marks=pytest.mark.slow), 0.5])
def test_lamps_that_fill_the_limb_before_a_dark_plate(part: float) -> None:
    """The edge of the full pixels is 3 px outside the limb: 8 of the sigmas that it was once claimed to have.

    Along half of the outline that is refused. Along a fifth of it, sectors without full pixels have the limb: errors
    are within 4 sigma, false alarm rate 2e-4.
    """
    rig = replace(Rig(), T_camera_sphere=Pose("camera", "sphere", (4e-4, -3e-4, 0.2605)))
    light = lamps_on_a_dark_plate(rig, part)
    frame = Chain(sensor("bayer-raw"), 0, rig.camera).frame(Light(light), NoiseStream(("lamps",)))
    if part > 0.4:
        with pytest.raises(ImageError, match=r"lamps fill the pixels along 5\d %"):
            find_outline(frame, Rig(), sensor_card("bayer-raw"))
    else:
        found = find_outline(frame, Rig(), sensor_card("bayer-raw"))
        assert (np.abs(found.sphere_in_camera_m - rig.sphere_in_camera_m) < 4.0 * found.sigma_m).all()


def test_images_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(ImageError, match="preset"):
        planes_of(np.zeros((720, 1280, 3), np.uint8), sensor_card("bayer-raw"))
    with pytest.raises(ImageError, match="whole frame"):
        find_outline(np.ones((3, 72, 128)), Rig())


def test_taps_are_the_cameras_demosaicing() -> None:
    """A grey mosaic through the camera's processing gives the plane's taps times the mosaic, to 8-bit rounding."""
    rng = np.random.default_rng(13)
    mosaic = ndimage_smooth(rng.uniform(0.2, 0.5, (40, 60)))
    image = eight_bit(srgb_of_the_camera(demosaic(mosaic)))
    (plane,) = planes_of(image, sensor_card("srgb8"))
    for v, u in ((10, 20), (11, 20), (10, 21), (11, 21)):
        taps = plane.taps[2 * (v % 2) + u % 2]
        assert sum(tap.weight for tap in taps) == pytest.approx(1.0)
        model = sum(tap.weight * mosaic[v + tap.dv_px, u + tap.du_px] for tap in taps)
        assert plane.values[v, u] == pytest.approx(model, abs=0.01)


def ndimage_smooth(image: np.ndarray) -> np.ndarray:
    from scipy import ndimage

    return ndimage.gaussian_filter(image, 2.0)


def test_srgb_curve_and_its_inverse() -> None:
    x = np.linspace(0.0, 1.0, 1001)
    assert srgb_to_linear(linear_to_srgb(x)) == pytest.approx(x, abs=1e-7)  # the standard's two branches meet to 1e-8
    assert linear_to_srgb(x) == pytest.approx(srgb_of_the_camera(x), abs=1e-7)


def _unwrapped_turns() -> np.ndarray:
    turn = np.linspace(-np.pi, np.pi, 120, endpoint=False)
    return np.stack([np.ones(120), np.cos(turn), np.sin(turn)], axis=-1)


@pytest.mark.parametrize(("together", "low", "high"), [(1, 1.02, 1.2), (2, 1.75, 2.1), (8, 4.8, 6.6)])
def test_scatter_knows_correlated_neighbours(together: int, low: float, high: float) -> None:
    """Shifts that a fit of radius and centre leaves: white ones, and moving averages of 2 and 8.

    The variance of their mean is 1, 2 and 8. White ones give 1.1, because the larger of two estimates is taken: sigma
    is 5 % too large then. Of 8 together 12 neighbours see 5.7: sigma is 16 % too small. The fit itself has taken the
    waves that tell more. 500 draws of a number with relative standard deviation 0.4: good to 2 %.
    """
    rng = np.random.default_rng(14)
    white = rng.standard_normal((500, 120))
    errors = sum((np.roll(white, k, axis=1) for k in range(together)), np.zeros_like(white)) / np.sqrt(together)
    turns = _unwrapped_turns()
    left = errors - errors @ turns @ np.linalg.inv(turns.T @ turns) @ turns.T
    found = float(np.mean([scatter(z, np.ones(120), turns) for z in left]))
    assert low < found < high


def test_a_lamp_in_a_sector_is_seen_in_what_the_model_leaves() -> None:
    """Noise of 1 %; one sector of 24 has a step of 30 % across it: it and two on each side lose their trust."""
    rng = np.random.default_rng(15)
    turn = np.repeat(np.linspace(-np.pi, np.pi, 24, endpoint=False) + 0.1, 60)
    where = Sectors.of(np.zeros(turn.size, int), turn, 24)
    y = 1.0 + 0.01 * rng.standard_normal(turn.size)
    residual = y - 1.0
    residual[(where.sector == 10) & (np.arange(turn.size) % 2 == 0)] += 0.3
    trust = where.described(y, residual)
    assert np.flatnonzero(trust == 0.0).tolist() == [8, 9, 10, 11, 12]
    # the rms of 60 values is good to 9 %: 1.4 of the median is 4 standard deviations away
    assert np.all(trust[[*range(8), *range(13, 24)]] == 1.0)
