"""Rigid motion of the whole rig between the two images of a pair: the robot rolls, pitches, yaws or slips a little."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phibench.scenes.frames import IDENTITY, Matrix, Pose, Vector, as_matrix, as_vector


@dataclass(frozen=True)
class Motion:
    """Turn about the lens centre, then shift, in world axes; camera and mirror go together.

    Parameters
    ----------
    translation_m : 3 floats
        Shift of the lens centre.
    rotation : 3 x 3 nested tuple, proper orthogonal to 1e-9
        Turn about the lens centre, where the carriage has brought it.
    """

    translation_m: Vector = (0.0, 0.0, 0.0)
    rotation: Matrix = IDENTITY

    def __post_init__(self) -> None:
        checked = Pose("world", "world", self.translation_m, self.rotation)
        object.__setattr__(self, "translation_m", checked.translation_m)
        object.__setattr__(self, "rotation", checked.rotation)

    def moved(self, T_world_camera: Pose) -> Pose:
        """Camera pose after the motion."""
        return replace(
            T_world_camera,
            translation_m=as_vector(T_world_camera.t + np.array(self.translation_m)),
            rotation=as_matrix(np.array(self.rotation) @ T_world_camera.R),
        )

    def then(self, other: Motion) -> Motion:
        """Both motions, `other` last; both turn about the lens centre, so that shifts add."""
        shift = np.array(self.translation_m) + np.array(other.translation_m)
        return Motion(as_vector(shift), as_matrix(np.array(other.rotation) @ np.array(self.rotation)))
