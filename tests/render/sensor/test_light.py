"""Light, mosaic, vignetting, stop and rolling shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_light import FILTERS, spot_at

from phibench.render.optics.spot_layer import splat, spot_layer
from phibench.render.optics.spot_samples import FilmCloud
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, mono, mosaic, vignetting
from phibench.render.sensor.light import Light, Region, layer_spectra, moved_spot, row_times_s, spot_velocity_px_per_s
from phibench.render.sensor.settings import SensorError, sensor
from phibench.scenes.camera import Camera
from phibench.scenes.laser import LaserSpot
from phibench.scenes.room import default_rig

STREAM = NoiseStream(("optics", 0))
PLANES = np.arange(3 * 5 * 6, dtype=float).reshape(3, 5, 6)


def test_red_is_at_even_row_and_even_column() -> None:
    by_hand = np.empty((5, 6))
    for v in range(5):
        for u in range(6):
            by_hand[v, u] = PLANES[{(0, 0): 0, (1, 1): 2}.get((v % 2, u % 2), 1), v, u]
    np.testing.assert_array_equal(mosaic(PLANES), by_hand)
    for v, u in ((0, 1), (1, 0), (1, 1), (2, 3)):
        np.testing.assert_array_equal(mosaic(PLANES[:, v:, u:], (v, u)), by_hand[v:, u:])
    stack = np.stack([PLANES, 2.0 * PLANES])
    np.testing.assert_array_equal(mosaic(stack)[1], 2.0 * by_hand)


def test_mono_sums_the_planes() -> None:
    np.testing.assert_array_equal(mono(PLANES, (1.0, 1.0, 1.0)), PLANES.sum(axis=0))
    np.testing.assert_array_equal(mono(PLANES, (0.0, 0.5, 0.0)), 0.5 * PLANES[1])


def test_vignetting_is_cos_to_the_n_on_top() -> None:
    camera = Camera()
    region = Region.whole((720, 1280))
    assert vignetting(0.0, camera, region) == 1.0
    rays = camera.rays(np.stack(np.meshgrid(np.arange(1280.0), np.arange(720.0)), -1))
    np.testing.assert_allclose(vignetting(3.0, camera, region), rays[..., 2] ** 3, rtol=1e-12)
    flat = Light.flat((6e4, 6e4, 6e4), (720, 1280))
    # without the extra exponent nothing falls off: the layers' natural fall-off is not applied twice
    assert np.ptp(Chain(sensor("ideal")).frame(flat, STREAM)) == 0.0
    shaded = Chain(sensor("ideal", vignetting_exponent=3.0)).frame(flat, STREAM)[1] / 1000.0
    np.testing.assert_allclose(shaded, rays[..., 2] ** 3, rtol=1e-12)


def test_levels_stop_and_exposure_scale_the_light() -> None:
    light = Light(np.full((3, 32, 32), 600.0), spot_at(16.2, 15.7), lamp_level=2.0, laser_level=0.5)
    frame = Chain(sensor("ideal", exposure_s=0.05, f_number=4.8)).frame(light, STREAM)
    # 2.4 -> 4.8: a quarter of the light
    spot = frame.sum(axis=(1, 2)) - 32 * 32 * 2.0 * 600.0 * 0.05 / 4.0
    np.testing.assert_allclose(spot, 0.5 * 9e5 * 0.05 / 4.0 * FILTERS, rtol=1e-6)


def test_reference_is_the_middle_row() -> None:
    times = row_times_s(np.arange(720), 720, 0.030)
    assert times[359] == pytest.approx(-0.5 * 0.030 / 720)
    assert times[360] == -times[359]
    assert times[-1] - times[0] == pytest.approx(0.030 * 719 / 720)


def brute_force(velocity: tuple[float, float], exposure_s: float, centre: tuple[float, float]) -> np.ndarray:
    """Image (120, 160) of a moving spot: the layer computed anew at 200 instants of each row's exposure."""
    image = np.zeros((3, 120, 160))
    for row in range(36):  # the spot is at row 20.9 and moves by 3 px at most
        middle = row_times_s(np.array(row), 120, 0.030)
        instants = middle + exposure_s * ((np.arange(200) + 0.5) / 200 - 0.5)
        for t in instants:
            layer = spot_at(centre[0] + velocity[0] * t, centre[1] + velocity[1] * t)
            line = row - layer.v0_px
            if 0 <= line < layer.electrons_per_s.shape[1]:
                columns = slice(layer.u0_px, layer.u0_px + layer.electrons_per_s.shape[2])
                image[:, row, columns] += layer.electrons_per_s[:, line] / 200
    return image


@pytest.mark.slow
@pytest.mark.parametrize("velocity", [(150.0, 0.0), (0.0, -200.0), (-120.0, 90.0)])
@pytest.mark.parametrize("exposure_s", [1e-4, 1 / 60])
def test_a_moving_spot_is_what_brute_force_gives(velocity: tuple[float, float], exposure_s: float) -> None:
    centre = (80.31, 20.87)  # row times near -10 ms
    spot = spot_at(*centre)
    u0, v0, planes = moved_spot(spot, velocity, exposure_s, 0.030, 120)
    image = np.zeros((3, 120, 160))
    image[:, v0 : v0 + planes.shape[1], u0 : u0 + planes.shape[2]] = planes
    expected = brute_force(velocity, exposure_s, centre)
    # blur 0.8 px: exp(-2 (pi 0.8 / 2)^2) = 4 % at half a cycle in u and in v, squared times the pixel's 0.4: 7e-4;
    # 200 instants: (3 px / 200)^2 / 24 / 0.8^2 = 1e-5
    assert np.abs(image - expected).max() < 1e-3 * expected.max()
    assert np.abs(expected - brute_force((0.0, 0.0), 1e-4, centre)).max() > 0.1 * expected.max()
    # the same light; the sums' frequency 0 is exact, rows that see the spot at other times trade with each other
    np.testing.assert_allclose(image.sum(), expected.sum(), rtol=1e-4)


# Beyond half a cycle in u and in v at once lie up to 3.5e-4, 1.6e-3 and 6e-3 of the peak, and they count four times in
# the worst phase: left out, the errors are 1.4e-3, 6e-3 and 2.4e-2. A Gaussian is a tenth off for a streak as long as
# this, so that a tenth remains. What lies beyond one cycle, of 1e-3 of the peak at 0.5 px, comes on top.
@pytest.mark.parametrize(("blur_px", "allowed"), [(0.7, 1.6e-4), (0.6, 8e-4), (0.5, 4e-3)])
@pytest.mark.parametrize("half_px", [0.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_a_shifted_spot_is_the_one_at_its_new_place(
    blur_px: float, allowed: float, half_px: float, turn: float
) -> None:
    """Spots of points along a diagonal streak, moved by half a pixel in u and in v: all phases of both places."""
    along = np.linspace(-half_px, half_px, 33)[:, None] * [1.0, turn]
    light, margin, worst = np.full(33, 1.0 / 33), 3, 0.0
    for phase in np.mgrid[0.0:1.0:0.25, 0.0:1.0:0.25].reshape(2, -1).T:
        spot, wanted = (
            splat(FilmCloud(20.0 + phase + shift + along, light), blur_px, np.ones(3)) for shift in (0.0, [0.5, -0.5])
        )
        bands = [
            spectrum * np.exp(-2j * np.pi * (0.5 * ku - 0.5 * kv[:, None]))
            for spectrum, kv, ku in layer_spectra(spot, margin)
        ]
        found = np.fft.ifft2(np.sum(bands, axis=0)).real
        image = np.zeros_like(found)
        v, u = wanted.v0_px - spot.v0_px + margin, wanted.u0_px - spot.u0_px + margin
        height, width = wanted.electrons_per_s.shape[1:]
        image[:, v : v + height, u : u + width] = wanted.electrons_per_s
        worst = max(worst, float(np.abs(found - image).max() / image.max()))
    print(f"blur {blur_px} px, streak of {2 * half_px} px along {turn:+.0f}: {worst:.1e} of the peak")
    assert worst < allowed


def test_the_displacement_is_velocity_times_row_time() -> None:
    """The centroid of the frame's image: u moves by v_u t(row of the spot), to first order of a slow motion."""
    spot, velocity, row = spot_at(80.31, 20.87), (30.0, 0.0), 20.87
    u0, _, planes = moved_spot(spot, velocity, 1e-4, 0.030, 120)
    columns = u0 + np.arange(planes.shape[2])
    centroid = (planes[0].sum(axis=0) @ columns) / planes[0].sum()
    assert centroid - 80.31 == pytest.approx(30.0 * (row - 59.5) * 0.030 / 120, abs=1e-4)


def test_a_spot_at_rest_is_the_layer_itself() -> None:
    spot = spot_at(80.31, 20.87)
    assert moved_spot(spot, (0.0, 0.0), 0.01, 0.03, 120)[2] is spot.electrons_per_s
    slow = moved_spot(spot, (1e-9, 0.0), 0.01, 0.03, 120)[2][:, 3:-3, 3:-3]
    assert np.abs(slow - spot.electrons_per_s).max() < 1e-9 * slow.max()


@pytest.mark.slow
def test_a_moving_rig_against_layers_rendered_on_the_way() -> None:
    """Rig at 0.2 m/s: rows put together from layers of the carriage's true positions."""
    rig = default_rig()
    target = LaserSpot((2.0, 1.0, 0.5), (-1.0, 0.0, 0.0), 0.005)
    view, speed, exposure_s, height = rig.at(0.2), 0.2, 1 / 60, 720
    velocity = spot_velocity_px_per_s(view, target, speed)
    assert np.hypot(*velocity) > 5.0
    spot = spot_layer(view, target, ())
    u0, v0, planes = moved_spot(spot, velocity, exposure_s, 0.030, height)
    rows = np.arange(v0, v0 + planes.shape[1])
    expected = np.zeros_like(planes)
    instants = np.linspace(-0.5, 0.5, 9)[:-1] + 1 / 16
    for fraction in instants:
        for i, t in enumerate(row_times_s(rows, height, 0.030)):
            offset = view.offset_m + speed * (t + fraction * exposure_s)
            layer = spot_layer(rig.at(float(offset)), target, ())
            line = rows[i] - layer.v0_px
            if 0 <= line < layer.electrons_per_s.shape[1]:
                start = layer.u0_px - u0
                expected[:, i, start : start + layer.electrons_per_s.shape[2]] += layer.electrons_per_s[:, line] / 8
    # flux along the way: +-17 ms at 0.2 m/s change the distance by 3 mm, 2e-3 of 2 m, flux by twice that at the ends;
    # the image itself by less than 1 px
    assert np.abs(planes - expected).max() < 3e-3 * expected.max()
    still = np.zeros_like(planes)
    window = Region(u0, v0, u0 + planes.shape[2], v0 + planes.shape[1])
    inner = Region(spot.u0_px, spot.v0_px, *(np.array([spot.u0_px, spot.v0_px]) + spot.electrons_per_s.shape[:0:-1]))
    still[(slice(None), *inner.slices(window))] = spot.electrons_per_s
    assert np.abs(still - expected).max() > 0.02 * expected.max()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"lamp_level": -1.0}, "Light.lamp_level = -1.0: must be 0 or above"),
        ({"laser_level": float("nan")}, "Light.laser_level = nan"),
        ({"f_number": 0.0}, "allowed range is 0.5 to 256"),
        ({"ambient_electrons_per_s": np.zeros((720, 1280))}, r"has the shape \(720, 1280\)"),
    ],
)
def test_bad_light_is_refused(change: dict, complaint: str) -> None:
    with pytest.raises(SensorError, match=complaint):
        replace(Light.flat((1.0, 1.0, 1.0), (32, 32)), **change)


def test_a_spot_that_leaves_the_image_is_refused() -> None:
    with pytest.raises(SensorError, match="move the carriage more slowly"):
        moved_spot(spot_at(20.0, 20.0), (1e5, 0.0), 0.01, 0.03, 120)
