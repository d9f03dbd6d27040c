"""Scene of one view in standard Mitsuba plugins, and its camera: all light, the room's alone, or the spot alone.

Units are millimetres, with the sphere centre at the origin: in metres with the origin on the floor Mitsuba's ray offset
moves the spot by 0.01 px. Colours are three bands, one for each colour filter of the detector, in Mitsuba's rgb mode.
Layers are per filter, no measured spectra of the room's materials exist, and the laser is handled at its own wavelength
elsewhere: a spectral variant would add colour noise for no gain in truth.

**Camera.** It is Mitsuba's `thinlens`, which has no principal point. The film is therefore one whose middle is the
principal point, to half a pixel, and the image a crop of it. The rest, at most a quarter of a pixel, is a shear of the
sensor's transform: x' = x + s z moves the rays of all lens points alike, and a plane of focus onto itself. Mitsuba
takes shears and scales below 1e-3.

Distortion and the Gaussian blur have no place, and neither have unlike fx and fy. Images are mean radiances of the
pixels, W/(m^2 sr) in the three bands: `etendue` makes electrons of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from phibench.render.plugins.mirror_plugins import mirror_plugin
from phibench.render.plugins.plugin_tree import Plugin, SceneSetting, Value
from phibench.render.plugins.room_plugins import room_plugins
from phibench.render.plugins.spot_plugins import spot_plugins
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room

Light = Literal["all", "ambient", "spot"]
_SPOT_DEPTH = (
    4  # over the mirror, and through what a mask leaves open: the layer has none of the light that the room sends back
)
LIGHTS: tuple[Light, ...] = ("all", "ambient", "spot")
_SHEAR = 9e-4  # Mitsuba refuses transforms whose columns' products are off by 1e-3
_SCALE = 4.5e-4
_NEAR_MM, _FAR_MM = 1.0, 1e6  # clipping planes: nothing of the scene is nearer or farther
SAMPLES = 64
DEPTH = 30


def standard_scene(view: View, room: Room, spot: LaserSpot | None = None, light: Light = "all") -> Plugin:
    """Whole scene of one view: integrator, sensor, mirror, every shape of the room, and the spot.

    Parameters
    ----------
    view, room
    spot : LaserSpot, or None
    light : "all", "ambient" or "spot"
        Of the room and the spot, of the room, or of the spot, whose scene has no other light.

    Raises
    ------
    SceneError
        If no standard plugin reflects as the mirror does.
    """
    depth = _SPOT_DEPTH if light == "spot" else DEPTH
    values: dict[str, Value] = {
        "integrator": Plugin("integrator", "path", {"max_depth": SceneSetting("max_depth", depth)}),
        "sensor": sensor_plugin(view),
        MIRROR_NAME: mirror_plugin(view),
    }
    values |= room_plugins(view, room, lit=light != "spot")
    if spot is not None and light != "ambient":
        values |= spot_plugins(view, spot, room, alone=light == "spot")
    return Plugin("scene", "scene", values)


# Camera.


@dataclass(frozen=True)
class Axis:
    """One axis of the film, pixels.

    Attributes
    ----------
    size, offset : int
        Of the film, and where the image begins on it.
    rest : float
        From the film's middle to the principal point.
    """

    size: int
    offset: int
    rest: float

    @classmethod
    def of(cls, side: int, centre_px: float) -> Axis:
        """Axis of an image of `side` pixels, with the principal point at a pixel."""
        doubled = round(2.0 * (centre_px + 0.5))
        offset = max(0, side - doubled)
        return cls(doubled + 2 * offset, offset, centre_px + 0.5 - 0.5 * doubled)


def carried(camera: Camera) -> Camera:
    """Camera of the exported scene: no distortion, unlike fx and fy only as far as Mitsuba takes a scale.

    The Gaussian blur stays a number of the camera; the scene has none.
    """
    close = abs(camera.fy_px / camera.fx_px - 1.0) < _SCALE
    fine = max(abs(axis.rest) for axis in film_axes(camera)) < _SHEAR * camera.fx_px
    cx_px, cy_px = (
        (camera.cx_px, camera.cy_px) if fine else (0.5 * axis.size - axis.offset - 0.5 for axis in film_axes(camera))
    )
    fy_px = camera.fy_px if close else camera.fx_px
    return replace(camera, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0, fy_px=fy_px, cx_px=cx_px, cy_px=cy_px)


def etendue(camera: Camera, uv_px: Array) -> Array:
    """Electrons/s that a pixel of a carried camera gets of a radiance of 1 W/(m^2 sr), shape (..., 3), at (..., 2)."""
    cos = camera.rays(uv_px)[..., 2]
    area = math.pi * camera.aperture_radius_m**2 / (camera.fx_px * camera.fy_px)
    return (area * cos**4)[..., None] * np.array(camera.detector.band_electrons_per_joule())


def sensor_plugin(view: View) -> Plugin:
    """Sensor of one view; film, image window and samples are settings."""
    camera = carried(view.rig.camera)
    x, y = axes = film_axes(camera)
    sizes = (camera.width_px, camera.height_px)
    crops = {"width": x.size, "height": y.size, "crop_offset_x": x.offset, "crop_offset_y": y.offset}
    crops |= dict(zip(("crop_width", "crop_height"), sizes, strict=True))
    film: dict[str, Value] = {name: SceneSetting(name, value) for name, value in crops.items()}
    film |= {"pixel_format": "rgb", "component_format": "float32", "sample_border": False}
    film["rfilter"] = Plugin("rfilter", "box")
    values: dict[str, Value] = {
        "fov": math.degrees(2.0 * math.atan(0.5 * x.size / camera.fx_px)),
        "fov_axis": "x",
        "aperture_radius": MM_PER_M * camera.aperture_radius_m,
        "focus_distance": MM_PER_M * camera.focus_distance_m,
        "near_clip": _NEAR_MM,
        "far_clip": _FAR_MM,
        "to_world": _to_world(view, camera, axes),
        "sampler": Plugin("sampler", "multijitter", {"sample_count": SceneSetting("spp", SAMPLES)}),
        "film": Plugin("film", "hdrfilm", film),
    }
    return Plugin("sensor", "thinlens", values, label="camera")


def film_axes(camera: Camera) -> tuple[Axis, Axis]:
    """Both axes of the film of a camera."""
    return Axis.of(camera.width_px, camera.cx_px), Axis.of(camera.height_px, camera.cy_px)


def _to_world(view: View, camera: Camera, axes: tuple[Axis, Axis]) -> Array:
    """Transform of Mitsuba's camera, whose x runs to the left and y up, with what the film cannot hold of it."""
    own = np.diag([-1.0, -1.0, 1.0])
    # where the principal point lies right of the film's middle, a pixel's ray points left of the pinhole's
    own[0, 2], own[1, 2] = -axes[0].rest / camera.fx_px, -axes[1].rest / camera.fy_px
    own[1, 1] = -camera.fx_px / camera.fy_px
    matrix = np.eye(4)
    matrix[:3, :3] = view.T_world_camera.R @ own
    matrix[:3, 3] = MM_PER_M * view.T_world_camera.directions(-view.rig.T_camera_sphere.t)
    return matrix
