"""Detection without a hint: rates, false alarms, distractors, saturation, both frames together.

Frames are of a quarter-size camera (320 x 180, mirror's radius 85 px), drawn by the real chain; the room is made of
tiles of random grey. Spots are pixel-integrated Gaussians at exact positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.sensor_light import FILTERS, spot_at
from scipy.ndimage import gaussian_filter

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.datasets.read import open_dataset
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.interface import Box, Pair
from phibench.estimator.limits.position_bound import spot_limit
from phibench.estimator.methods.joint_fit import joint_fit
from phibench.estimator.methods.registry import detected_spots
from phibench.estimator.methods.spot_search import box_around, spot_boxes
from phibench.estimator.spots.candidates import Candidates, candidates_at, lattice
from phibench.estimator.spots.detect import (
    PROCESSED,
    RAW,
    Choice,
    PairDetection,
    choose,
    consistent_pairs,
    detect,
    epipolar_curve,
    mirror_box,
    outline_mask,
)
from phibench.estimator.spots.gaussian_spot import covariance_bound
from phibench.estimator.spots.image_planes import colour_planes
from phibench.render.optics.spot_layer import SpotLayer
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RIG = Rig(camera=Camera(320, 180, 11.2, 357.5, 357.5, 159.5, 89.5))
SIZE = (180, 320)
STROKE_M = 0.5
BAYER, MONO = sensor("bayer-raw"), sensor("mono-raw")
SRGB, MJPEG = sensor("srgb8"), sensor("mjpeg", jpeg_quality=85)
POINT = (1.6, 1.2, 0.5)  # D = 2 m
WHITE = np.array([1.0, 0.85, 0.42])
Light2 = tuple[str, tuple[float, float], float, Array]  # image, (u, v), electrons behind red, colour


@cache
def tiled(name: str, contrast: float) -> Array:
    """Tiles of random grey, blurred by the optics as the spot is."""
    tiles = 1.0 + contrast * generator("detect", "room", name).uniform(-1.0, 1.0, (18, 32))
    return gaussian_filter(np.kron(tiles, np.ones((10, 10))), 0.7)


@dataclass(frozen=True)
class Scene:
    """A room, a spot of so many electrons in each image, and other lights, always on or with the laser alone."""

    s: Sensor
    electrons: tuple[float, float] = (6000.0, 6000.0)
    point_m: tuple[float, float, float] = POINT
    always: tuple[Light2, ...] = ()
    with_laser: tuple[Light2, ...] = ()
    tiles: float = 0.15
    lamp: Box | None = None  # of the down image

    def uv(self, name: str) -> Array:
        return image_of(RIG.at(0.0 if name == "down" else STROKE_M), np.array(self.point_m)).uv_px

    def light(self, name: str, laser: bool) -> Light:
        s = self.s
        grey = tiled(name, self.tiles)
        if self.lamp is not None and name == "down":
            grey = grey.copy()
            grey[self.lamp.slices] = 200.0  # all three bands are full
        room = 800.0 * WHITE[:, None, None] * grey / s.exposure_s
        lights = [*self.always, *(self.with_laser if laser else ())]
        if laser:
            lights.append((name, tuple(self.uv(name)), self.electrons[name == "up"], FILTERS))
        for where, uv, electrons, colour in lights:
            if where == name:
                room = added(room, spot_at(*uv, 0.7, electrons / s.exposure_s), colour)
        return Light(room)

    def pair(self, draw: int = 0, off: bool = True) -> Pair:
        frames = {
            (name, laser): Chain(self.s, camera=RIG.camera).frame(
                self.light(name, laser), NoiseStream(("detect", name, str(laser), draw))
            )
            for name in ("down", "up")
            for laser in ((True, False) if off else (True,))
        }
        dark = [frames.get((name, False)) for name in ("down", "up")]
        images = frames["down", True], frames["up", True]
        return Pair(draw, *images, RIG, STROKE_M, card_of(self.s), dark[0], dark[1])

    def snr(self, name: str) -> float:
        """Flux over its standard deviation at the limit of the raw pixels, background known."""
        raw = self.s.replace(output="raw")
        spot = spot_at(*self.uv(name), 0.7, self.electrons[name == "up"] / raw.exposure_s)
        region = expected_of_light(Light(self.light(name, False).ambient_electrons_per_s, spot), raw)
        return float(1.0 / np.sqrt(covariance_bound(spot_limit(region, card_of(raw), "flux").fisher, 3)[2, 2]))


def added(room: Array, spot: SpotLayer, colour: Array) -> Array:
    rows, columns = spot.electrons_per_s.shape[1:]
    result = room.copy()
    part = result[:, spot.v0_px : spot.v0_px + rows, spot.u0_px : spot.u0_px + columns]
    part += spot.electrons_per_s[:1] * colour[:, None, None]
    return result


def misses(found: PairDetection, scene: Scene) -> list[float]:
    """Distance of each detection from the truth, pixels; infinite where there is none."""
    return [
        np.inf if spot is None else float(np.hypot(*(np.array(spot.uv_px) - scene.uv(name))))
        for name, spot in (("down", found.down), ("up", found.up))
    ]


def places(count: int) -> list[tuple[float, float, float]]:
    rng = generator("detect", "places")
    D, azimuth = rng.uniform(1.0, 4.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    return [(float(d * np.cos(a)), float(d * np.sin(a)), 0.5) for d, a in zip(D, azimuth, strict=True)]


# -- rates -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_spots_above_the_threshold_are_found(s: Sensor, off: bool) -> None:
    """12 places, one draw each; spots of so many sigma of the raw pixels in both images. All are found within 1 px.

    MJPEG keeps about half of the significance; in one frame the edges of the tiles take their part, most of all of a
    mono sensor's, to which a tile's corner is as good as a spot.
    """
    target = {"bayer-raw": (14, 14), "mono-raw": (14, 50), "srgb8": (14, 20), "mjpeg": (24, 50)}[s.name][not off]
    checked = 0
    for k, point in enumerate(places(12)):
        one = Scene(s, (1000.0, 1000.0), point)
        # nearly proportional: shot noise of the spot itself lowers it a little
        two = replace(one, electrons=tuple(1000.0 * target / one.snr(name) for name in ("down", "up")))
        assert two.snr("down") > 0.6 * target
        assert max(misses(detect(two.pair(k, off)), two)) < 1.0
        checked += 1
    assert checked == 12


@pytest.mark.slow
@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_without_a_spot_nothing_is_found(s: Sensor, off: bool) -> None:
    """12 pairs without laser. The bound for a whole frame is 4e-4; here the disc is 1/16: a false alarm of this test
    has a chance below 12 x 2 x 4e-4 / 16 = 0.06 % on raw pixels; on processed ones it is not known.
    """
    scene = Scene(s, (0.0, 0.0))
    found = [detect(scene.pair(100 + k, off)) for k in range(12)]
    assert [f for f in found if f != PairDetection(None, None)] == []
    # and the same frames with a spot are not empty
    assert detect(Scene(s, (12_000.0, 12_000.0)).pair(100, off)) != PairDetection(None, None)


def test_significance_of_noise_is_normal_or_less() -> None:
    """Places of a lattice on noise alone: mean 0, standard deviation at most 1, on raw pixels with an off frame.

    n = 4 x 500 places; 5 standard errors are 5 / sqrt(n) = 0.11 and 5 / sqrt(2 n) = 0.08.
    """
    z = []
    for k in range(4):
        pair = Scene(BAYER, (0.0, 0.0)).pair(200 + k)
        box = mirror_box(RIG)
        planes = [colour_planes(image, pair.card, box) for image in (pair.down, pair.down_off) if image is not None]
        z.append(candidates_at(planes[0], planes[1], pair.card, lattice(outline_mask(RIG, box), 7), 0.7).z)
    values = np.concatenate(z)
    assert len(values) > 1500
    assert abs(values.mean()) < 0.15
    assert 0.85 < values.std() < 1.08
    assert values.max() < RAW.each


@pytest.mark.slow
@pytest.mark.parametrize("s", [BAYER, SRGB], ids=lambda s: s.name)
def test_the_start_is_good_to_a_fraction_of_a_pixel(s: Sensor) -> None:
    """The parabola's vertex at 20 sigma and more; a spot between red pixels is interpolated away, hence the size."""
    errors = [
        max(misses(detect(scene.pair(k)), scene)) for k, scene in enumerate(Scene(s, point_m=p) for p in places(12))
    ]
    assert np.sqrt(np.mean(np.square(errors))) < 0.8
    assert np.median(errors) < 0.6


# -- other lights ----------------------------------------------------------------------------------------------------

RED_LED = np.array([1.0, 0.08, 0.02])


def elsewhere(name: str, point: tuple[float, float, float] = (-1.5, 1.5, 0.9)) -> tuple[float, float]:
    u, v = image_of(RIG.at(0.0 if name == "down" else STROKE_M), np.array(point)).uv_px
    return float(u), float(v)


@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_lights_of_the_room_are_taken_off_with_the_off_frame(s: Sensor) -> None:
    """A red diode and a white lamp, both stronger than the spot, at one point of the room in both images."""
    lights = tuple((n, elsewhere(n), 14_000.0, RED_LED) for n in ("down", "up"))
    lights += tuple((n, elsewhere(n, (1.2, -1.8, 1.2)), 14_000.0, WHITE) for n in ("down", "up"))
    scene = Scene(s, (8000.0, 8000.0), always=lights)
    assert max(misses(detect(scene.pair()), scene)) < 1.0
    dark = replace(scene, electrons=(0.0, 0.0))
    assert detect(dark.pair()) == PairDetection(None, None)


@pytest.mark.parametrize("s", [BAYER, MONO], ids=lambda s: s.name)
def test_a_strong_spot_beside_a_lamp_is_found(s: Sensor) -> None:
    """The lamp begins 4 px beside the spot: within the part around lamps where weak lights are not believed."""
    u, v = Scene(s).uv("down")
    scene = Scene(s, (16_000.0, 16_000.0), lamp=Box(int(u) + 4, int(v) - 10, 20, 20))
    assert max(misses(detect(scene.pair()), scene)) < 1.0
    assert detect(replace(scene, electrons=(0.0, 0.0)).pair()) == PairDetection(None, None)


@pytest.mark.parametrize("s", [BAYER, SRGB], ids=lambda s: s.name)
def test_a_white_point_is_no_spot_even_without_an_off_frame(s: Sensor) -> None:
    white = tuple((n, elsewhere(n), 20_000.0, WHITE) for n in ("down", "up"))
    scene = Scene(s, (6000.0, 6000.0), always=white)
    assert max(misses(detect(scene.pair(off=False)), scene)) < 1.0
    # the same point in red is what a single frame cannot tell from the laser: the stronger one is taken
    red = tuple((n, elsewhere(n), 20_000.0, RED_LED) for n in ("down", "up"))
    fooled = detect(replace(scene, always=red).pair(off=False))
    assert min(misses(fooled, scene)) > 10.0


@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("s", [BAYER, SRGB, MJPEG], ids=lambda s: s.name)
def test_the_stronger_of_two_spots_of_the_laser_is_taken(s: Sensor, off: bool) -> None:
    """The weaker one has half the electrons and is a point of the room as well; in the up image it is the stronger."""
    times = 2.0 if s is MJPEG else 1.0
    second = (("down", elsewhere("down"), 4000.0 * times, FILTERS), ("up", elsewhere("up"), 10_000.0 * times, FILTERS))
    scene = Scene(s, (8000.0 * times, 8000.0 * times), with_laser=second)
    assert max(misses(detect(scene.pair(off=off)), scene)) < 1.0


@pytest.mark.parametrize("times", [3.0, 10.0])
@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_saturated_spots_are_found(s: Sensor, times: float) -> None:
    """At 40 000 electrons the brightest pixel of a blur of 0.7 px is full; three and ten times that."""
    scene = Scene(s, (times * 40_000.0, times * 40_000.0))
    assert max(misses(detect(scene.pair()), scene)) < 1.0


# -- both frames together --------------------------------------------------------------------------------------------


def test_lights_that_are_not_one_point_are_no_pair() -> None:
    """Down and up each show one strong light, on different azimuths: one of them is reported, not both."""
    light = (("up", elsewhere("up"), 9000.0, FILTERS),)
    found = detect(Scene(BAYER, (9000.0, 0.0), with_laser=light).pair())
    assert (found.down is None) != (found.up is None)


def test_a_spot_in_one_image_only_is_reported() -> None:
    scene = Scene(BAYER, (9000.0, 0.0))
    found = detect(scene.pair())
    assert misses(found, scene)[0] < 1.0
    assert found.up is None


def test_the_curve_goes_through_the_up_image_of_the_point_for_a_tilted_rig_too() -> None:
    rig = replace(RIG, stroke_axis_world=(0.02, -0.01, 1.0))
    down = np.array([image_of(rig.at(0.0), np.array(p)).uv_px for p in places(10)])
    up = np.array([image_of(rig.at(STROKE_M), np.array(p)).uv_px for p in places(10)])
    fits = consistent_pairs(rig, STROKE_M, down, up)
    assert np.diag(fits).all()
    assert 10 <= fits.sum() < 60  # others are on other azimuths
    curve = epipolar_curve(rig, STROKE_M, down)
    assert np.isfinite(curve).all()
    assert consistent_pairs(rig, STROKE_M, down[:0], up).shape == (0, 10)


def test_far_candidates_are_not_consistent_with_a_spot_beyond_the_range() -> None:
    """A point at 0.2 m lies before the nearest D: its up image is off the curve's end."""
    point = np.array([0.2, 0.0, 0.6])
    down, up = (image_of(RIG.at(offset), point).uv_px[None] for offset in (0.0, STROKE_M))
    assert not consistent_pairs(RIG, STROKE_M, down, up).any()


# -- what methods see --------------------------------------------------------------------------------------------------


def test_boxes_hold_the_spot_and_stay_in_the_image() -> None:
    scene = Scene(BAYER)
    pair = scene.pair()
    for box, name in zip(spot_boxes(pair), ("down", "up"), strict=True):
        assert box is not None
        u, v = scene.uv(name)
        assert box.u0_px + 5 < u < box.u0_px + box.width_px - 6
        assert box.v0_px + 5 < v < box.v0_px + box.height_px - 6
    edge = box_around(replace(detect(pair).down, uv_px=(0.2, 179.0)), pair.down)  # type: ignore[type-var]
    assert edge == Box(0, 159, 21, 21)
    assert spot_boxes(Scene(BAYER, (0.0, 0.0)).pair()) == (None, None)


def test_hints_are_kept_and_restrict_the_search() -> None:
    scene = Scene(BAYER)
    pair = scene.pair()
    wrong = Box(100, 60, 16, 16)
    hinted = replace(pair, box_down=wrong, box_up=wrong)
    assert spot_boxes(hinted, hints=True) == (wrong, wrong)
    assert spot_boxes(hinted) == (None, None)
    assert min(misses(detect(hinted), scene)) == np.inf
    assert max(misses(detect(pair), scene)) < 1.0


def test_the_method_answers_positions_or_why_not() -> None:
    scene = Scene(BAYER)
    answer = detected_spots(scene.pair())
    assert answer.down.uv_px is not None
    assert answer.down.covariance_px2 is None
    assert np.hypot(*(np.array(answer.down.uv_px) - scene.uv("down"))) < 0.5
    none = detected_spots(Scene(BAYER, (0.0, 0.0)).pair())
    assert none.down.uv_px is None
    assert none.down.status == "no spot found"


@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_joint_fit_answers_a_depth_with_its_sigma(s: Sensor, off: bool) -> None:
    """D = 2 m, within 5 sigma (a chance of 6e-7 for the raw outputs, whose sigma is that of a bound)."""
    answer = joint_fit(Scene(s, (12_000.0, 12_000.0), tiles=0.0).pair(off=off))
    assert answer.depth_m is not None
    assert answer.sigma_depth_m is not None
    assert abs(answer.depth_m - 2.0) < 5.0 * answer.sigma_depth_m
    assert answer.sigma_depth_m < 0.2


@pytest.mark.parametrize("s", [BAYER, MONO, SRGB, MJPEG], ids=lambda s: s.name)
def test_joint_fit_of_a_spot_in_one_image_answers_no_depth(s: Sensor) -> None:
    one = joint_fit(Scene(s, (12_000.0, 0.0), tiles=0.0).pair(off=True))
    assert one.depth_m is None
    assert one.down.uv_px is not None


def test_inputs_are_not_changed() -> None:
    pair = Scene(BAYER).pair()
    for image in pair.images.values():
        image.flags.writeable = False
    assert detect(pair).down is not None


def test_an_image_that_does_not_fit_the_card_is_refused_in_a_sentence() -> None:
    pair = Scene(BAYER).pair()
    with pytest.raises(ValueError, match=r"raw needs \(H, W\)"):
        detect(replace(pair, card=card_of(SRGB)))


# -- rendered frames -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8"])
def test_spots_of_a_rendered_room_are_found(tiny_dataset: Path, preset: str, off: bool) -> None:
    sample: Any = next(x for x in open_dataset(tiny_dataset) if x.row.experiment == "seen")
    # pixels of 16 times the area: 1/60 s would fill them all
    source = sample.frame_source(preset, exposure=1.0 / 960.0, laser_level=6.0)
    for k in range(2):
        frames = source.frames(k, laser_off=off)
        dark = (frames.down_off, frames.up_off) if off else (None, None)
        card = card_of(frames.by_name["down"].sensor)
        found = detect(Pair(k, frames.down, frames.up, sample.rig, sample.row.stroke_m, card, *dark))
        for spot, row in ((found.down, sample.row.down), (found.up, sample.row.up)):
            assert spot is not None
            assert np.hypot(spot.uv_px[0] - row.u_px, spot.uv_px[1] - row.v_px) < 1.0


@pytest.mark.parametrize(
    ("electrons", "significance", "pair"),
    [
        (5.0, 5.0, True),  # a ratio that nearly every surface has
        (10.0, 5.0, False),  # noise beside a strong spot, which the other image hides
        (10.0, 8.0, True),  # each sure by itself: a wall that is seen at a low angle
        (40.0, 8.0, False),
    ],
)
def test_one_spot_may_be_much_fainter_in_one_image_if_it_is_sure_there(
    electrons: float, significance: float, pair: bool
) -> None:
    """The strong one is in the down image; the other lies on its curve, `electrons` times fainter."""
    rig, strong = Rig(), np.array([[760.0, 420.0]])
    on_curve = epipolar_curve(rig, 0.5, strong)[0, 20][None]
    one, true = np.ones(1), np.ones(1, bool)
    down = Candidates(strong, 60.0 * one, 1e4 * one, one, one, true)
    up = Candidates(on_curve, significance * one, 1e4 / electrons * one, one, one, true)
    alone = Choice(0, apart=significance > RAW.alone)  # both are sure, but not of one point
    assert choose(rig, 0.5, down, up, RAW, sure=True) == (Choice(0, 0) if pair else alone)


SPOT_PX, OTHER_PX = np.array([760.0, 420.0]), np.array([540.0, 300.0])


def candidates(uv_px: list[np.ndarray], z: tuple[float, ...], electrons: tuple[float, ...]) -> Candidates:
    one = np.ones(len(z))
    return Candidates(np.array(uv_px), np.array(z), np.array(electrons), one, one, one.astype(bool))


def test_a_saturated_spot_that_seems_fainter_in_one_image_is_not_lost_to_another_light() -> None:
    """A full spot's electrons are too low in the down image; up it outshines the other light by far."""
    rig = Rig()
    spot_up, other_up = (epipolar_curve(rig, 0.5, place[None])[0, 20] for place in (SPOT_PX, OTHER_PX))
    down = candidates([OTHER_PX, SPOT_PX], (45.0, 12.0), (1.1e5, 0.9e5))
    up = candidates([spot_up, other_up], (32.0, 16.0), (7e4, 1.5e4))
    assert choose(rig, 0.5, down, up, PROCESSED, sure=True) == Choice(1, 0)


def test_a_spot_that_down_hides_is_not_lost_to_another_light_in_both_images() -> None:
    """The other light is the more significant one down, with half of the spot's light at most."""
    rig = Rig()
    other_up = epipolar_curve(rig, 0.5, OTHER_PX[None])[0, 20]
    down = candidates([OTHER_PX], (26.0,), (1.2e4,))
    up = candidates([SPOT_PX, other_up], (24.0, 13.0), (2.5e4, 1e4))
    assert choose(rig, 0.5, down, up, PROCESSED, sure=True) == Choice(None, 0)
    weaker = candidates([SPOT_PX, other_up], (24.0, 13.0), (1.4e4, 1e4))  # not by 1.5 times: no other light is so near
    assert choose(rig, 0.5, down, weaker, PROCESSED, sure=True) == Choice(0, 1)
