"""For several studies: a cutout of the sensor around a spot's two images; pairs drawn of it, their truth and bounds.

Frames are drawn as if the camera had no other pixels, which saves the time of a whole frame. The corner lies on whole
JPEG units, so that mosaic and compression are those of the whole image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from phibench.benchmark.pair_sets.dataset_pairs import SpotBounds, SpotInImage, spot_bounds
from phibench.datasets.frames.frame_source import PositionLight
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.interface import Box, Pair
from phibench.estimator.pair_set import ImageTruth as Answer
from phibench.estimator.pair_set import PairTruth
from phibench.render.optics.spot_layer import SpotLayer, spot_layer
from phibench.render.optics.truth import SpotTruth, depth_m, spot_truth
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, speckle_gain
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam, LaserSpot
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import POSITIONS, Rig, Stroke, View
from phibench.scenes.room import Room

_UNIT_PX = (16, 16)  # JPEG units of every subsampling
_CAMERAS = 2**31  # numbers of cameras


def cut_region(uv_px: Sequence[tuple[float, float]], size: tuple[int, int], margin_px: int) -> Region:
    """Whole JPEG units around some pixels, and at least a margin, in an image of (height, width)."""
    low, high = np.floor(np.min(uv_px, axis=0)).astype(int), np.ceil(np.max(uv_px, axis=0)).astype(int)
    inside = Region(
        max(int(low[0]), 0), max(int(low[1]), 0), min(int(high[0]) + 1, size[1]), min(int(high[1]) + 1, size[0])
    )
    return inside.grown(size, _UNIT_PX, (margin_px, margin_px))


def cut_rig(rig: Rig, region: Region) -> Rig:
    """The rig with a sensor that has the region's pixels only."""
    camera, (height, width) = rig.camera, region.shape
    cut = replace(
        camera, width_px=width, height_px=height, cx_px=camera.cx_px - region.u0_px, cy_px=camera.cy_px - region.v0_px
    )
    return replace(rig, camera=cut)


@dataclass(frozen=True)
class SpotView:
    """One spot in one view of a cut rig.

    Attributes
    ----------
    truth : chief ray
    layer : the spot's light
    ambient_electrons_per_s : shape (3, h, w)
    """

    truth: SpotTruth
    layer: SpotLayer
    ambient_electrons_per_s: Array = field(repr=False)

    @classmethod
    def of(cls, view: View, spot: LaserSpot, room: Room, ambient: Array) -> SpotView:
        """Compute it, without Mitsuba."""
        shapes = room.shapes(view)
        return cls(spot_truth(view, spot, shapes), spot_layer(view, spot, shapes), ambient)

    def light(self, laser_level: float, f_number: float) -> Light:
        """Light on the sensor."""
        return Light(self.ambient_electrons_per_s, self.layer, laser_level=laser_level, f_number=f_number)


@dataclass(frozen=True)
class SpotPair:
    """One spot at both stroke positions of a rig.

    Attributes
    ----------
    rig : Rig
        True one, cut.
    views : down and up
    name : str
        Place of the spot; intervals resample these.
    beam : Beam
        Whose spot at `depth_m` is that of the views.
    """

    rig: Rig
    stroke_m: float
    depth_m: float
    views: dict[str, SpotView] = field(repr=False)
    name: str = ""
    beam: Beam = Beam()

    @classmethod
    def of(
        cls, rig: Rig, stroke_m: float, spot: LaserSpot, room: Room, ambient: dict[str, Array], name: str
    ) -> SpotPair:
        """Compute both views of a cut rig."""
        at = {p: rig.at(Stroke(stroke_m).offset_m(p)) for p in POSITIONS}
        views = {p: SpotView.of(view, spot, room, ambient[p]) for p, view in at.items()}
        depth = float(depth_m(np.array(spot.position_world_m), at["down"].sphere_centre_m))
        # no divergence: the beam needs to be right at this distance only
        return cls(rig, stroke_m, depth, views, name, Beam(spot.diameter_m, 0.0))

    @property
    def visible(self) -> bool:
        """Both images show the spot."""
        return all(view.truth.visible for view in self.views.values())


@dataclass(frozen=True)
class Shot:
    """Sensor and laser level of a pair of frames.

    Attributes
    ----------
    laser_level : float
        Factor of the spot's light.
    """

    sensor: Sensor
    laser_level: float = 1.0

    def side(self, pair: SpotPair, position: str, camera_seed: int, flicker: float = 1.0) -> PositionLight:
        """Camera and light at one position; `flicker` multiplies the laser."""
        camera = pair.rig.camera
        light = pair.views[position].light(self.laser_level * flicker, camera.f_number)
        return PositionLight(Chain(self.sensor, camera_seed, camera), light, Region.whole(light.size))


def drawn_pair(
    number: int, shot: Shot, pair: SpotPair, nominal: tuple[Rig, float], names: tuple[Name, ...], box_px: int
) -> Pair:
    """One draw of a pair with laser-off frames and boxes, as a method sees it.

    Parameters
    ----------
    nominal : nominal rig, cut, and nominal stroke
    names : of the noise's stream, the draw last; the camera's pattern is that of the draw, too
    box_px : side of the boxes around the spots
    """
    seed = int(generator(*names, "camera").integers(_CAMERAS))
    images: dict[str, Any] = {}
    for position in POSITIONS:
        side = shot.side(pair, position, seed)
        for key, light, word in ((position, side.light, "on"), (f"{position}_off", side.light.laser_off(), "off")):
            images[key] = side.chain.frame(light, _stream(names, position, word))
            images[key].flags.writeable = False
    box_down, box_up = (_box(names, p, pair.views[p].truth, side_px=box_px, rig=pair.rig) for p in POSITIONS)
    rig, stroke_m = nominal
    return Pair(
        number,
        **images,
        rig=rig,
        stroke_m=stroke_m,
        card=card_of(shot.sensor),
        box_down=box_down,
        box_up=box_up,
        beam=pair.beam,
    )


def without_off(pair: Pair) -> Pair:
    """The pair without its laser-off frames."""
    return replace(pair, down_off=None, up_off=None)


def truth_of(
    number: int, shot: Shot, pair: SpotPair, nominal: tuple[Rig, float], bounds: dict[str, SpotBounds], draw: int
) -> PairTruth:
    """The exact answer to a drawn pair."""
    sensor = shot.sensor
    down, up = (_answer(pair.views[p].truth, bounds[p]) for p in POSITIONS)
    return PairTruth(
        number=number,
        sample_id=pair.name,
        draw=draw,
        preset=sensor.name,
        jpeg_quality=sensor.jpeg_quality if sensor.output == "mjpeg" else None,
        hinted=True,
        depth_m=pair.depth_m,
        stroke_m=pair.stroke_m,
        true_rig=pair.rig,
        nominal_rig=nominal[0],
        down=down,
        up=up,
        nominal_stroke_m=nominal[1],
    )


def bounds_of(shot: Shot, pair: SpotPair, names: tuple[Name, ...] | None = None) -> dict[str, SpotBounds]:
    """Bounds of both images; with the names of a draw, for the laser as speckle made it in that draw."""
    return {p: _bounds(shot, pair, p, 1.0 if names is None else _flicker(shot, names, p)) for p in POSITIONS}


def _bounds(shot: Shot, pair: SpotPair, position: str, flicker: float) -> SpotBounds:
    view = pair.views[position]
    rates = tuple(float(x) for x in view.layer.total_electrons_per_s)
    uv = (view.truth.u_px, view.truth.v_px)
    spot = SpotInImage(uv, rates, view.truth.visible, pair.depth_m, pair.beam)
    return spot_bounds(shot.side(pair, position, 0, flicker), pair.rig, spot)


def _flicker(shot: Shot, names: tuple[Name, ...], position: str) -> float:
    return speckle_gain(shot.sensor, _stream(names, position, "on"))


def _stream(names: tuple[Name, ...], position: str, laser: str) -> NoiseStream:
    return NoiseStream((*names, position, laser))


def _answer(truth: SpotTruth, bounds: SpotBounds) -> Answer:
    phi = {"ray": truth.phi_ray_rad, "normal": truth.phi_normal_rad, "incidence": truth.phi_incidence_rad}
    return Answer(
        uv_px=(truth.u_px, truth.v_px),
        phi_rad=phi,
        azimuth_rad=truth.azimuth_rad,
        visible=truth.visible,
        cause=truth.cause,
        **vars(bounds),
    )


def _box(names: tuple[Name, ...], position: str, truth: SpotTruth, *, side_px: int, rig: Rig) -> Box:
    """Square that holds the spot anywhere, 8 pixels and more from its edges, as far as the image has room."""
    random, low = generator(*names, "box", position), []
    for centre, size in ((truth.u_px, rig.camera.width_px), (truth.v_px, rig.camera.height_px)):
        start = round(centre - random.uniform(8.0, side_px - 8.0))
        low.append(min(max(start, 0), max(size - side_px, 0)))
    width, height = min(side_px, rig.camera.width_px), min(side_px, rig.camera.height_px)
    return Box(low[0], low[1], width, height)
