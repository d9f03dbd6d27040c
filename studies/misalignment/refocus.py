"""A refocused lens: its focal length in pixels, and what D with the old calibration is off by.

The paper focuses last, after all else is set. A lens that is turned has another image distance, so that fx and fy
change by more than the 0.3 % to which a calibration knows them. The mirror's outline grows with them. Whoever takes
the new outline with the old focal length finds the mirror nearer by nearly as much, and D hardly changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from phibench.calibration.rig.bundle import apparent_outline
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.camera import Camera, refocused
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig
from phibench.studies.framework import Finding
from phibench.studies.misaligned_rigs import seen_px

LENS_M, FOCUS_M = 4e-3, (0.46, 0.23)
"""Focal length of the C310's lens, and planes of focus: the factory's and that of the mirror's virtual image."""
FAR_M = 1e6
"""Plane of focus of a lens that is focused far away."""
OUTLINE, OLD = "z_c from the outline's size", "old calibration"


@dataclass(frozen=True)
class Refocus:
    """One plane of focus.

    Attributes
    ----------
    relative : float
        Focal length over the old one, less 1: the misalignment `focal_relative`.
    errors : dict
        Relative errors of D by what the estimator takes for the rig, shape (n,) each.
    """

    focus_m: float
    focal_px: float
    relative: float
    errors: dict[str, Array]

    def rms(self, kind: str) -> float:
        """Root mean square of the relative errors."""
        return float(np.sqrt(np.mean(np.square(self.errors[kind]))))


def thin_lens(camera: Camera, lens_m: float) -> Camera:
    """The camera with a thin lens of this focal length, focused far away."""
    focal_px = 1.0 / ((1.0 / lens_m - 1.0 / FAR_M) * camera.pixel_pitch_um * 1e-6)
    return replace(camera, fx_px=focal_px, fy_px=focal_px, focus_distance_m=FAR_M)


def refocus(nominal: Rig, focus_m: float, places: Sequence[tuple[float, float]], height_m: float) -> Refocus:
    """Errors of the nominal rig in pictures that were taken after its lens was turned.

    Parameters
    ----------
    nominal : Rig
        Calibrated before.
    focus_m : float
        New plane of focus.
    places : sequence of (D, stroke), metres; spots along world x
    height_m : float, of the spots above the floor
    """
    camera = refocused(nominal.camera, focus_m)
    true = replace(nominal, camera=camera)
    pose = replace(nominal.T_camera_sphere, translation_m=as_vector(apparent_outline(nominal, true)[:3]))
    known = {OLD: nominal, OUTLINE: replace(nominal, T_camera_sphere=pose)}
    D, h = np.array(places, float).T
    errors_by_name: dict[str, list[float]] = {name: [] for name in known}
    for depth_m, stroke_m in zip(D, h, strict=True):
        point = np.array([depth_m, 0.0, height_m])
        down, up = (seen_px(true.at(offset), point) for offset in (0.0, float(stroke_m)))
        for name, rig in known.items():
            errors_by_name[name].append(float(depth_exact(rig, float(stroke_m), down, up).depth_m) / depth_m - 1.0)
    errors = {name: np.array(values) for name, values in errors_by_name.items()}
    return Refocus(focus_m, camera.fx_px, camera.fx_px / nominal.camera.fx_px - 1.0, errors)


def refocus_findings(rows: Sequence[Refocus]) -> Iterator[Finding]:
    """Focal length, its change, and the rms error of D for each plane of focus."""
    for row in rows:
        where = f"lens refocused at {row.focus_m:g} m"
        yield Finding(f"{where}: focal length", row.focal_px, unit="px")
        yield Finding(f"{where}: focal_relative", 100.0 * row.relative, unit="%")
        for kind in (OLD, OUTLINE):
            yield Finding(f"{where}: rms error of D, {kind}", 100.0 * row.rms(kind), unit="%")
