"""Rigs with mirrors of revolution: one of each shape, aligned or off axis."""

from __future__ import annotations

import dataclasses
import math

from phibench.scenes.frames import Pose, rotation_xyz
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import Profile, cone, hyperboloid, paraboloid, sphere_cap
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig

VERTEX_M = 0.2
IMAGE_M = 0.05  # behind the vertex: where paraboloid and hyperboloid show what is level with them
PROFILES = {
    "sphere": sphere_cap(0.06, 0.055),
    "ellipsoid": Profile(0.06, 0.5, 0.045),
    "paraboloid": paraboloid(0.06, 0.06),
    "hyperboloid": hyperboloid(VERTEX_M, 1.25, 0.06),
    "cone": cone(math.pi / 4.0, 0.06),
    "polynomial": Profile(0.08, -0.7, 0.055, (20.0, 300.0)),
    "flattened": Profile(0.06, -1.0, 0.055, (-15.0,)),
}


def revolved(shape: str, *, aligned: bool = True, alpha: float = 0.0, **camera: object) -> Rig:
    """Rig with a mirror of one shape, its focus near the virtual image; off axis it is 5 mm and 2.9 degrees wrong."""
    rig, profile = default_rig(), PROFILES[shape]
    pose = Pose("camera", "sphere", (0.0, 0.0, VERTEX_M))
    if not aligned:
        pose = Pose("camera", "sphere", (0.004, -0.003, VERTEX_M), rotation_xyz(0.04, -0.03))
    settings = {"focus_distance_m": VERTEX_M + IMAGE_M} | camera
    return dataclasses.replace(
        rig,
        camera=dataclasses.replace(rig.camera, **settings),  # type: ignore[arg-type]
        mirror=RevolvedMirror(profile, alpha),
        T_camera_sphere=pose,
    )
