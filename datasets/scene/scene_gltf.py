"""Sample as a glTF file, for Blender and other programs: room, robot, holder, mirror, camera and spot, one node each.

It is the glTF of rooms (`gltf_export`) with the rig: the mirror is a mesh of a smooth metal, whose colour is its
reflectance in the three bands at normal incidence. glTF's camera has a pinhole in the image's middle, without a
principal point, distortion or focus. The spot is a disc of its diameter that shines red.
"""

from __future__ import annotations

import math

import numpy as np

from phibench.datasets.rooms.gltf_export import GltfWriter, y_up
from phibench.render.plugins.mirror_plugins import grid_triangles
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room

_RINGS, _SPOKES = 91, 180  # of the mirror's mesh, two degrees apart
_SPOT_SIDES = 32  # of the polygon that is shown for the spot
_SPOT_LIFT_M = 1e-4  # off the surface: two faces in one plane flicker


def scene_glb(view: View, room: Room, spot: LaserSpot | None = None) -> bytes:
    """Bytes of a `.glb` file of one view."""
    document = GltfWriter()
    for shape in room.shapes(view):
        document.add(shape)
    _add_mirror(document, view)
    if spot is not None:
        _add_spot(document, spot)
    _add_camera(document, view)
    return document.encoded(room.name)


def _add_mirror(document: GltfWriter, view: View) -> None:
    mirror = view.rig.mirror
    points, normals = mirror.grid(_RINGS, _SPOKES)
    pose = view.T_world_sphere
    bands = view.rig.camera.detector.band_wavelength_nm
    colour = [float(mirror.reflectance(np.array(1.0), nm)) for nm in bands]
    surface = {"metallicFactor": 1.0, "baseColorFactor": [*colour, 1.0]}
    # glTF's roughness is the square root of the microfacets' alpha
    surface["roughnessFactor"] = math.sqrt(mirror.roughness_alpha)
    document.add_mesh(
        MIRROR_NAME,
        pose.points(points.reshape(-1, 3)),
        {"name": MIRROR_NAME, "doubleSided": True, "pbrMetallicRoughness": surface},
        grid_triangles(_RINGS, _SPOKES, closed=True),
        pose.directions(normals.reshape(-1, 3)),
    )


def _add_spot(document: GltfWriter, spot: LaserSpot) -> None:
    a, b = spot.tangents()
    turn = 2.0 * np.pi * np.arange(_SPOT_SIDES) / _SPOT_SIDES
    rim = 0.5 * spot.diameter_m * (np.cos(turn)[:, None] * a + np.sin(turn)[:, None] * b)
    normal = np.array(spot.normal_world)
    points = np.array(spot.position_world_m) + _SPOT_LIFT_M * normal + np.concatenate([np.zeros((1, 3)), rim])
    i = np.arange(_SPOT_SIDES)
    fan = np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % _SPOT_SIDES], axis=-1)
    area_m2 = math.pi * spot.diameter_m**2 / 4.0
    # of a Lambertian disc that sends out all the power that its albedo leaves
    radiance = spot.power_w * (0.7 if spot.albedo is None else spot.albedo) / (math.pi * area_m2)
    document.add_mesh("laser_spot", points, document.emitting("laser_spot", (radiance, 0.0, 0.0)), fan)


def _add_camera(document: GltfWriter, view: View) -> None:
    """Camera of the view; glTF's looks along -z, its y axis up in the image."""
    camera = view.rig.camera
    matrix = np.eye(4)
    matrix[:3, :3] = y_up(view.T_world_camera.R.T).T @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = y_up(view.camera_centre_m)
    document.add_camera(
        "camera",
        {
            "yfov": 2.0 * math.atan(0.5 * camera.height_px / camera.fy_px),
            "aspectRatio": camera.width_px / camera.height_px * camera.fy_px / camera.fx_px,
            "znear": 0.001,  # metres; the mirror is decimetres away
        },
        matrix,
    )
