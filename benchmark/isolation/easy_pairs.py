"""Easy pairs (down, up) and their truth, made in NumPy, not rendered: spots in a smooth room, a simulated noisy camera.

They serve to try a method, not to rank it. There is no lamp, no stripe and no shadow, and the nominal rig is exact.

A spot is a Gaussian integrated over the pixels; the room is a smooth slope. The noise is Gaussian with the variance of
Poisson's law: no easy spot is faint enough to tell the two apart. PRNU and DSNU belong to the camera and are the same
in every frame. Expected electrons go through noise, converter and a plain processing to 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.benchmark.isolation.run_limits import MethodError
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.exposures.expected_electrons import ExpectedRegion
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.estimator.geometry.phi import phi_incidence, phi_normal, phi_ray
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.interface import Box, Pair
from phibench.estimator.limits.position_bound import raw_snr, spot_limit
from phibench.estimator.methods.spot_search import box_at, clipped_box
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.estimator.spots.camera_codes import tone_of, yuyv_image
from phibench.estimator.spots.gaussian_spot import outer, profile
from phibench.estimator.spots.image_planes import KINDS, kind_of, linear_planes, through_jpeg
from phibench.estimator.spots.raw_pixels import bayer_filters
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import Rig
from phibench.scenes.validation import nearest

DEPTH_M, STROKE_M, HEIGHT_M = (1.2, 3.2), (0.35, 0.6), (0.35, 0.65)  # all of these the default rig shows in both images
FLUX_E = (25_000.0, 35_000.0)  # behind the red filter: an eighth of it in the brightest pixel


@dataclass(frozen=True)
class EasySpot:
    """One image's spot: position, blur, the three angles and the azimuth of the world point."""

    uv_px: tuple[float, float]
    sigma_px: float
    phi_rad: dict[str, float]
    azimuth_rad: float


@dataclass(frozen=True)
class EasyScene:
    """Scene of one pair of images (down, up)."""

    depth_m: float
    stroke_m: float
    flux_e: float
    down: EasySpot
    up: EasySpot


def easy_rig() -> Rig:
    """Default rig, stopped down to f/16: without astigmatism from defocus a spot is round, as it is modelled here."""
    rig = Rig()
    return replace(rig, camera=replace(rig.camera, f_number=16.0))


def easy_scene(rig: Rig, number: int) -> EasyScene:
    """Scene of a pair: depth, stroke, height, azimuth and flux come from the stream named after its number."""
    rng = generator("easy pairs", "place", number)
    depth, stroke, height, flux = (float(rng.uniform(*span)) for span in (DEPTH_M, STROKE_M, HEIGHT_M, FLUX_E))
    azimuth = float(rng.uniform(-math.pi, math.pi))
    axis = rig.at(0.0).sphere_centre_m
    point = np.array([axis[0] + depth * math.cos(azimuth), axis[1] + depth * math.sin(azimuth), height])
    down, up = (_spot(rig, offset, point, azimuth) for offset in (0.0, stroke))
    return EasyScene(depth, stroke, flux, down, up)


def _spot(rig: Rig, offset_m: float, point: np.ndarray[tuple[int], np.dtype[np.float64]], azimuth: float) -> EasySpot:
    view = rig.at(offset_m)
    u, v = image_of(view, point).uv_px
    uv = (float(u), float(v))
    at = np.array(uv)
    angles = {"ray": phi_ray(view, at), "normal": phi_normal(view, at), "incidence": phi_incidence(view, at)}
    return EasySpot(uv, spot_blur(rig, uv).round_px, {name: float(phi) for name, phi in angles.items()}, azimuth)


ROOM_E = np.array([200.0, 180.0, 90.0])  # behind R, G, B in the middle of the image
_SLOPE = (0.25, 0.15)  # of the room's light, relative, from the middle to the border, along u and v
_WINDOW_PX = 41  # side of the window that a spot is computed in: its edges are more than 20 blurs away


@dataclass(frozen=True)
class EasyCamera:
    """A camera with a fixed pattern."""

    camera: Camera
    card: SensorCard

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of an image."""
        return self.camera.height_px, self.camera.width_px

    def expected(self, spot: EasySpot, flux_e: float, blue: bool = False) -> ExpectedRegion:
        """Means and derivatives on 41 x 41 pixels around a spot of the laser, or of blue light."""
        box = box_at(spot.uv_px, self.shape, _WINDOW_PX)
        sigma = np.array([spot.sigma_px])
        across = profile(np.array([spot.uv_px[0] - box.u0_px]), sigma, box.width_px)
        down = profile(np.array([spot.uv_px[1] - box.v0_px]), sigma, box.height_px)
        filters, response = self._filters(box, blue)
        images = (
            flux_e * response * outer(a, b)[0]
            for a, b in ((down.share, across.share), (down.share, across.by_centre), (down.by_centre, across.share))
        )
        return ExpectedRegion(box.u0_px, box.v0_px, filters, self._room()[box.slices], *images)

    def image(self, lights: Sequence[ExpectedRegion], stream: tuple[Name, ...]) -> NDArray[Any]:
        """One frame of the room and some spots; as `Pair` describes the card's output."""
        mean = self._room().copy()
        for region in lights:
            rows, columns = region.spot_e.shape
            mean[region.v0_px : region.v0_px + rows, region.u0_px : region.u0_px + columns] += region.spot_e
        return self.developed(mean, stream)

    def developed(self, mean_e: Array, stream: tuple[Name, ...]) -> NDArray[Any]:
        """One frame of expected electrons behind each pixel's filter, shape (H, W)."""
        dn = self._digitised(mean_e, generator("easy pairs", "noise", *stream))
        return dn if self.card.output == "raw" else self._processed(dn)

    def _room(self) -> Array:
        """Expected electrons of room and dark current, shape (H, W), read-only."""
        return _room(self.shape, self.card.mosaic == "bayer", self.card.dark_e_per_s * self.card.exposure_s)

    def _filters(self, box: Box, blue: bool) -> tuple[NDArray[np.int64], Array]:
        """Filter of each pixel of a box and its response to the laser, or to light that is as blue as that is red."""
        shape = (box.height_px, box.width_px)
        response = np.array(self.camera.detector.laser_filter_response)[:: -1 if blue else 1]
        if self.card.mosaic == "mono":
            return np.zeros(shape, np.int64), np.full(shape, response.sum())
        filters = bayer_filters(np.array([(box.u0_px, box.v0_px)]), shape)[0]
        return filters, response[filters]

    def _digitised(self, mean_e: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
        card = self.card
        responsivity, offset = _pattern(self.shape)
        mean = mean_e * (1.0 + card.prnu * responsivity)
        charge = mean + np.sqrt(mean) * rng.standard_normal(self.shape, np.float32)
        charge = np.clip(charge, 0.0, card.full_well_e) + card.read_noise_e * rng.standard_normal(
            self.shape, np.float32
        )
        dn = np.rint((charge + card.dsnu_e * offset) * card.dn_per_e + card.black_level_dn)
        return np.clip(dn, 0, card.top_dn).astype(np.uint16)

    def _processed(self, dn: NDArray[np.uint16]) -> NDArray[np.uint8]:
        planes = linear_planes(dn, _raw(self.card)).astype(np.float32)  # a power of half the bytes takes half the time
        planes = np.repeat(planes, 3, axis=0) if len(planes) == 1 else planes
        codes = 255.0 * np.moveaxis(tone_of(planes, self.card), 0, -1)
        if self.card.output == "yuyv":
            return yuyv_image(codes, self.card)
        image = np.rint(codes).astype(np.uint8)
        return through_jpeg(image, self.card) if self.card.output == "mjpeg" else image


@lru_cache(maxsize=2)
def _room(shape: tuple[int, int], bayer: bool, dark_e: float) -> Array:
    """Smooth light, kept for the next frame."""
    across, down = np.linspace(-1.0, 1.0, shape[1]), np.linspace(-1.0, 1.0, shape[0])
    light = 1.0 + _SLOPE[0] * across + (_SLOPE[1] * down)[:, None]
    # without filters a pixel gathers the light of all three bands
    level = ROOM_E[bayer_filters(np.array([(0, 0)]), shape)[0]] if bayer else ROOM_E.sum()
    room: Array = light * level + dark_e
    room.setflags(write=False)
    return room


@lru_cache(maxsize=2)
def _pattern(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Responsivity and offset of the camera's pixels, standard normal, shape (2, H, W); kept for the next frame."""
    pattern = generator("easy pairs", "camera").standard_normal((2, *shape), np.float32)
    pattern.setflags(write=False)
    return pattern


def _raw(card: SensorCard) -> SensorCard:
    return replace(card, output="raw")


BOX_PX = 64  # as the recipes' `hint_box_px`
_SPAN_PX = 20  # by which a box may be off the spot
_BLUE_SHARE = 0.4  # of the red spot's light: half of it after the white balance, less in luma and in the sum of colours


def require_easy(preset: str) -> None:
    """Raise `MethodError` for a preset that no easy pairs are made for."""
    try:
        kind = kind_of(sensor_card(preset))
    except ValueError:
        kind = ""  # no such preset
    if kind not in KINDS:
        raise MethodError(f"no easy pairs for preset '{preset}': {nearest(preset, KINDS)}")


@dataclass(frozen=True, repr=False)
class EasyPairs(ShortForm):
    """Easy pairs by number; a `PairSet`.

    Parameters
    ----------
    preset : str
        Name of a sensor's preset that ends in pixels, such as "mjpeg".
    rig : Rig
        Its whole mirror should be in the image.
    laser_off, hinted : bool
        Whether pairs come with frames with the laser off, and with boxes.
    whole : int
        So many pairs, the last ones, come without boxes in any case. In a camera with colours they have a fainter blue
        spot besides, `blue_px`: a method that takes blue for red finds that one.

    Raises
    ------
    MethodError
        If there is no such preset.
    """

    preset: str = "bayer-raw"
    count: int = 10
    rig: Rig = field(default_factory=easy_rig)
    laser_off: bool = True
    hinted: bool = True
    whole: int = 0

    def __post_init__(self) -> None:
        require_easy(self.preset)

    def _shown(self) -> dict[str, Any]:
        return {
            "pairs": self.count,
            "preset": self.preset,
            "laser off": "with frames" if self.laser_off else "none",
            "boxes": "with boxes" if self.hinted else "none",
        }

    def __len__(self) -> int:
        """Return the number of pairs."""
        return self.count

    def pair(self, number: int) -> Pair:
        """Images of a pair, with its exact rig."""
        scene, camera = _scene(self.rig, number), self._camera()
        images: dict[str, Any] = {
            f"{name}{'' if on else '_off'}": camera.image(
                self._lights(camera, number, spot) if on else (), (self.preset, number, name, int(on))
            )
            for on in ((True, False) if self.laser_off else (True,))
            for name, spot in _spots(scene)
        }
        down, up = self.boxes(number)
        stroke, card = scene.stroke_m, camera.card
        return Pair(number, rig=self.rig, stroke_m=stroke, card=card, box_down=down, box_up=up, **images)

    def boxes(self, number: int) -> tuple[Box | None, Box | None]:
        """Region hints of a pair."""
        if not self._boxed(number):
            return None, None
        scene = _scene(self.rig, number)
        return self._box(number, "down", scene.down), self._box(number, "up", scene.up)

    def blue_px(self, number: int) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Places (u, v) of the blue spots in both images, across the mirror from the red ones; None without them."""
        if not self._is_whole(number) or self._camera().card.mosaic == "mono":
            return None  # boxes hide it, and grey pixels have no blue
        scene = _scene(self.rig, number)
        return self._across(scene.down).uv_px, self._across(scene.up).uv_px

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        scene, camera = _scene(self.rig, number), self._camera()
        down, up = (_spot_truth(camera, scene, spot) for _, spot in _spots(scene))
        quality = camera.card.jpeg_quality if camera.card.output == "mjpeg" else None
        return PairTruth(
            number,
            f"easy-{number}",
            0,
            self.preset,
            quality,
            self._boxed(number),
            scene.depth_m,
            scene.stroke_m,
            self.rig,
            self.rig,
            down,
            up,
        )

    def document(self) -> dict[str, Any]:
        """Provenance."""
        return {"name": "easy pairs", "preset": self.preset, "pairs": self.count, "rig": asdict(self.rig)}

    def _is_whole(self, number: int) -> bool:
        return self.count - self.whole <= number < self.count

    def _boxed(self, number: int) -> bool:
        return self.hinted and not self._is_whole(number)

    def _lights(self, camera: EasyCamera, number: int, spot: EasySpot) -> list[ExpectedRegion]:
        flux = _scene(self.rig, number).flux_e
        blue = [] if self.blue_px(number) is None else [self._across(spot)]
        return [camera.expected(spot, flux), *(camera.expected(other, _BLUE_SHARE * flux, blue=True) for other in blue)]

    def _across(self, spot: EasySpot) -> EasySpot:
        """A spot on the other side of the mirror's centre."""
        u, v = 2.0 * self.rig.outline_px().mean(axis=0) - np.array(spot.uv_px)
        return replace(spot, uv_px=(float(u), float(v)))

    def _camera(self) -> EasyCamera:
        return EasyCamera(self.rig.camera, sensor_card(self.preset))

    def _box(self, number: int, name: str, spot: EasySpot) -> Box:
        shift = generator("easy pairs", "box", number, name).integers(-_SPAN_PX, _SPAN_PX, 2, endpoint=True)
        u, v = (round(x) + int(d) - BOX_PX // 2 for x, d in zip(spot.uv_px, shift, strict=True))
        return clipped_box(Box(u, v, BOX_PX, BOX_PX), (self.rig.camera.height_px, self.rig.camera.width_px))


def _spots(scene: EasyScene) -> tuple[tuple[str, EasySpot], ...]:
    return ("down", scene.down), ("up", scene.up)


@cache
def _scene(rig: Rig, number: int) -> EasyScene:
    return easy_scene(rig, number)


def _spot_truth(camera: EasyCamera, scene: EasyScene, spot: EasySpot) -> ImageTruth:
    region, card = camera.expected(spot, scene.flux_e), camera.card
    limit = spot_limit(region, card)
    bound = limit.covariance_px2
    peak = float(region.mean_e.max())
    return ImageTruth(
        spot.uv_px,
        spot.phi_rad,
        spot.azimuth_rad,
        True,
        "none",
        float(region.spot_e.sum()),
        peak,
        raw_snr(region, card),
        peak > card.saturation_e,
        bound if card.output == "raw" else None,
        bound,
    )
