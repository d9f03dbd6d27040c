"""Scene of one view in standard Mitsuba plugins, with the laser spot as area emitters and the camera as a thin lens.

The light is all of it, the room's alone, or the spot's alone.

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

from phibench.render.optics.beam_deposit import BEAM_REACH_M, deposit, transmittance
from phibench.render.optics.faces import FaceTable, IntArray
from phibench.render.optics.room_tracer import RoomGeometry, room_geometry
from phibench.render.optics.truth import spot_truth
from phibench.render.plugins.plugin_tree import BitmapPlugin, Plugin, Rgb, SceneSetting, Value
from phibench.render.plugins.room_plugins import diffuse, mirror_plugin, room_plugins, scene_transform
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose, Vector, as_matrix, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room
from phibench.scenes.shapes import Bitmap, Checker

# Laser spot as area emitters of its own size, power and profile.
#
# The scattered light of a spot is a radiance on the faces that it lies on. Each of these faces gets a rectangle with a
# picture of that radiance, a hair above it. A texel's radiance is what the beam leaves at its centre: so edges, corners
# and textures cut the light as they do in the spot layer. The rectangle takes the albedo of the wall in its middle:
# lamps light what lies under the spot.
#
# The bands of a scene are those of the room's light. Electrons of the laser behind a filter are those of its own
# wavelength; so is the mirror's reflectance. The radiance of a band is scaled by both ratios, and gives these
# electrons.
#
# What a coat sends out depends on the direction: the radiance is that towards the mirror.


_SIGMAS = 5.0  # of a Gaussian: 4e-6 of its power lies beyond
_TEXELS, _FINER = 96, 3  # along a side of a rectangle, and places along a side of a texel
_PROBES = 41  # along a side, to find the faces
_LIFT_M, _BEHIND_M = 1e-4, 1e-3


@dataclass(frozen=True)
class LitRectangle:
    """Rectangle on a face that a spot lies on.

    Attributes
    ----------
    pose : Pose
        Its z axis is the normal.
    half_m : 2 floats
    radiance : array, shape (rows, columns)
        W/(m^2 sr) at the laser's wavelength, the lowest row first.
    covered : array, shape (rows, columns)
        Part of each texel that the face takes up.
    patch : int
        Number of the face; -1 for a flat spot.
    """

    pose: Pose
    half_m: tuple[float, float]
    radiance: Array
    covered: Array
    patch: int


def spot_plugins(view: View, spot: LaserSpot, room: Room, *, alone: bool) -> dict[str, Plugin]:
    """Emitters of a spot as the mirror shows it, under their keys; none where it has no reflection point.

    Unless they are `alone` they also have the light of the wall below them, where that shines.
    """
    geometry = room_geometry(room, view)
    truth = spot_truth(view, spot, geometry)
    mirror_m = np.array(truth.reflection_point_world_m)
    if not np.isfinite(mirror_m).all():
        return {}
    bands = _band_ratios(view, spot, math.cos(truth.phi_incidence_rad))
    faces = [_flat(spot)] if spot.beam_direction_world is None else _on_faces(spot, geometry, mirror_m)
    found = {}
    for number, lit in enumerate(face for face in faces if face.radiance.any()):
        name, (albedo, light) = f"spot_{number}", _wall(geometry, lit)
        radiance = lit.radiance[..., None] * bands + lit.covered[..., None] * light * (not alone)
        values: dict[str, Value] = {
            "to_world": scene_transform(view, _lifted(lit.pose), (*lit.half_m, 1e-3)),
            "emitter": Plugin("emitter", "area", {"radiance": _picture(name, radiance)}),
            "bsdf": _ground(name, lit, albedo),
        }
        found[name] = Plugin("shape", "rectangle", values, name, "laser spot")
    return found


def _band_ratios(view: View, spot: LaserSpot, cos_incidence: float) -> Array:
    """Band radiance over the laser's that gives the laser's electrons, shape (3,)."""
    detector, mirror = view.rig.camera.detector, view.rig.mirror
    of_laser = np.array(detector.laser_electrons_per_joule(spot.wavelength_nm))
    of_bands = np.array(detector.band_electrons_per_joule())
    cos = np.array(cos_incidence)
    shown = [float(mirror.reflectance(cos, nm)) for nm in detector.band_wavelength_nm]
    return of_laser / of_bands * float(mirror.reflectance(cos, spot.wavelength_nm)) / np.array(shown)


def _flat(spot: LaserSpot) -> LitRectangle:
    a, b = spot.tangents()
    axes = np.stack([a, b, np.array(spot.normal_world)], axis=1)
    half = _reach(spot) * spot.scale_m
    x, y = _places(half, half)
    inside = np.ones((_TEXELS, _TEXELS))
    pose = Pose("world", "shape", spot.position_world_m, as_matrix(axes))
    return LitRectangle(pose, (half, half), _means(spot.radiance_w_m2_sr(np.hypot(x, y))), inside, -1)


def _on_faces(spot: LaserSpot, geometry: RoomGeometry, mirror_m: Array) -> list[LitRectangle]:
    """Rectangles on every face that a beam meets."""
    steps = _reach(spot) * np.linspace(-1.0, 1.0, _PROBES)
    disc = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    met = deposit(spot, geometry, disc)
    planes = _planes(geometry.without_robot.table, np.unique(met.patch[met.lit]))
    return [_on_plane(spot, geometry, patches, mirror_m) for patches in planes]


def _planes(table: FaceTable, patches: IntArray) -> list[list[int]]:
    """Faces by their planes: triangles of a wall share a rectangle, two at one place would hide each other."""
    planes: list[list[int]] = []
    for patch in map(int, patches):
        normal, centre = table.normal[patch], table.centre_m[patch]
        for plane in planes:
            apart = abs((table.centre_m[plane[0]] - centre) @ normal)
            if normal @ table.normal[plane[0]] > 1.0 - 1e-9 and apart < 1e-5:
                plane.append(patch)
                break
        else:
            planes.append([patch])
    return planes


def _on_plane(spot: LaserSpot, geometry: RoomGeometry, patches: list[int], mirror_m: Array) -> LitRectangle:
    beam, table, patch = np.array(spot.beam_direction_world), geometry.without_robot.table, patches[0]
    normal = table.normal[patch]
    normal = -normal if normal @ beam > 0.0 else normal
    cos = float(-normal @ beam)
    centre = np.array(spot.position_world_m)
    centre = centre + ((table.centre_m[patch] - centre) @ normal) / (beam @ normal) * beam
    across = np.cross(normal, beam)
    across = spot.across_beam()[0] if np.linalg.norm(across) < 1e-9 else across / np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across), normal], axis=1)
    reach_m = _reach(spot) * spot.scale_m
    half = (reach_m, min(reach_m / cos, BEAM_REACH_M))
    x, y = _places(*half)
    points = centre + x[..., None] * axes[:, 0] + y[..., None] * axes[:, 1]
    disc = (points - np.array(spot.position_world_m)) @ np.stack(spot.across_beam(), axis=1)
    light = deposit(spot, geometry, disc.reshape(-1, 2) / spot.scale_m)
    here = np.isin(light.patch, patches).reshape(x.shape)
    radius = np.linalg.norm(disc, axis=-1)
    strength = np.where(here, light.strength.reshape(x.shape), 0.0)
    coat = float(light.coat[here.ravel()].max(initial=0.0))
    if coat > 0.0:
        towards = (mirror_m - points) / np.linalg.norm(mirror_m - points, axis=-1, keepdims=True)
        strength = strength * transmittance(np.maximum(towards @ normal, 0.0), np.full(x.shape, coat))
    radiance = strength / np.pi * cos * spot.irradiance_w_m2(radius)
    pose = Pose("world", "shape", as_vector(centre), as_matrix(axes))
    return LitRectangle(pose, half, _means(radiance), _means(here.astype(float)), patch)


def _reach(spot: LaserSpot) -> float:
    return _SIGMAS if spot.profile == "gaussian" else 1.0


def _places(half_x_m: float, half_y_m: float) -> tuple[Array, Array]:
    """Places within the texels, shape (fine rows, fine columns) each, metres."""
    fine = (np.arange(_TEXELS * _FINER) + 0.5) * 2.0 / (_TEXELS * _FINER) - 1.0
    x, y = np.meshgrid(fine * half_x_m, fine * half_y_m)
    return x, y


def _means(fine: Array) -> Array:
    """Means over texels."""
    return np.asarray(fine.reshape(_TEXELS, _FINER, _TEXELS, _FINER).mean(axis=(1, 3)))


def _lifted(pose: Pose) -> Pose:
    return replace(pose, translation_m=as_vector(pose.t + _LIFT_M * pose.R[:, 2]))


def _wall(geometry: RoomGeometry, lit: LitRectangle) -> tuple[Vector, Array]:
    """Albedo of the wall in the bands, and its own light, shape (3,), in the rectangle's middle; black without a wall.

    Of a flat spot it is the face right behind.
    """
    table, own = geometry.without_robot.table, geometry.without_robot
    normal, dark = lit.pose.R[:, 2], (0.0, 0.0, 0.0)
    patch = lit.patch
    if patch < 0:
        start = lit.pose.t + _BEHIND_M * normal
        patch = int(own.first_hit(start[None], -normal[None], np.array([2.0 * _BEHIND_M])).patch[0])
    if patch < 0 or table.emits[patch]:
        return dark, np.zeros(3)
    place = table.places(np.array([patch]), lit.pose.t[None])[0]
    texture = table.textures[table.texture[patch]]
    if isinstance(texture, Bitmap):
        value = texture.evaluate(place * np.array(texture.texel_m) + np.array(texture.origin_m))
    elif isinstance(texture, Checker):
        value = np.array(texture.albedo_odd if np.floor(place).sum() % 2.0 > 0.5 else texture.albedo_even)
    else:
        value = np.array(texture.albedo)
    return (dark, value) if table.is_radiance[patch] else (as_vector(value), np.zeros(3))


def _ground(name: str, lit: LitRectangle, albedo: Vector) -> Plugin:
    """Material of the rectangle: the wall's, and nothing where it reaches beyond the face."""
    material = diffuse(Rgb(albedo))
    if lit.covered.min() == 1.0:
        return material
    opacity = _picture(f"{name}_opacity", np.repeat(lit.covered[..., None], 3, axis=-1))
    return Plugin("bsdf", "mask", {"opacity": opacity, "material": material})


def _picture(name: str, values: Array) -> Plugin:
    picture = BitmapPlugin(name, values.astype(np.float32))
    own: dict[str, Value] = {"filename": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    return Plugin("texture", "bitmap", own)


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


def exported_camera(camera: Camera) -> Camera:
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
    """Electrons/s that a pixel of such a camera gets of a radiance of 1 W/(m^2 sr), shape (..., 3), at (..., 2)."""
    cos = camera.rays(uv_px)[..., 2]
    area = math.pi * camera.aperture_radius_m**2 / (camera.fx_px * camera.fy_px)
    return (area * cos**4)[..., None] * np.array(camera.detector.band_electrons_per_joule())


def sensor_plugin(view: View) -> Plugin:
    """Sensor of one view; film, image window and samples are settings."""
    camera = exported_camera(view.rig.camera)
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
