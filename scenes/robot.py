"""The robot ESCALADE360 as simple solids, with the mast and the camera's housing.

The paper gives the overall dimensions 0.90 x 0.53 x 0.30 m and tracks with flippers after the PackBot; the split into
body, tracks and flippers is ours. The mast that lifts the sensor and the housing are not in the paper either; they are
there so that the middle of the mirror shows a camera on a robot. The holder of the mirror is not modelled.
"""

from __future__ import annotations

import math

import numpy as np

from phibench.scenes.frames import Pose, as_vector, rotation_xyz
from phibench.scenes.rig import View
from phibench.scenes.solids import Cuboid, cuboid
from phibench.scenes.textures import Uniform

BODY_TOP_M = 0.30
_HOUSING_M = (0.072, 0.030, 0.032)  # the C310's bar, lying on its back
_LENS_CLEARANCE_M = 1e-3  # the housing's top stays below the lens centre so that it shades no aperture
_GREY, _BLACK, _OLIVE = (0.10, 0.10, 0.10), (0.03, 0.03, 0.03), (0.16, 0.17, 0.10)


def chassis() -> tuple[Cuboid, ...]:
    """Body, two tracks and two flippers, standing on the floor, front towards world +x."""
    flipper = rotation_xyz(y_rad=math.radians(-25.0))
    return (
        cuboid("robot_body", (-0.05, 0.0, 0.19), (0.66, 0.31, 0.22), _OLIVE),
        cuboid("robot_track_left", (-0.06, 0.21, 0.10), (0.78, 0.09, 0.20), _BLACK),
        cuboid("robot_track_right", (-0.06, -0.21, 0.10), (0.78, 0.09, 0.20), _BLACK),
        cuboid("robot_flipper_left", (0.30, 0.21, 0.18), (0.28, 0.05, 0.08), _GREY, flipper),
        cuboid("robot_flipper_right", (0.30, -0.21, 0.18), (0.28, 0.05, 0.08), _GREY, flipper),
    )


def carriage(view: View) -> tuple[Cuboid, ...]:
    """Camera housing and the mast below it, for a rig at one stroke offset."""
    T_world_camera = view.T_world_camera
    height = _HOUSING_M[2]
    centre = Pose("camera", "shape", (0.0, 0.0, -_LENS_CLEARANCE_M - height / 2.0))
    housing = Cuboid("camera_housing", T_world_camera @ centre, _HOUSING_M, Uniform(_GREY))
    foot = T_world_camera.points(np.array([0.0, 0.0, -_LENS_CLEARANCE_M - height]))
    rise = max(float(foot[2]) - BODY_TOP_M, 1e-3)
    mast = cuboid(
        "robot_mast", as_vector(np.array([foot[0], foot[1], BODY_TOP_M + rise / 2.0])), (0.03, 0.02, rise), _GREY
    )
    return (housing, mast)


def escalade360(view: View) -> tuple[Cuboid, ...]:
    """All solids of robot and sensor housing for one view; the same number and order at every offset."""
    return (*chassis(), *carriage(view))
