"""Rigs with drawn misalignments, in closed form: where they show spots, and what an aligned reader makes of them."""

from __future__ import annotations

import numpy as np

from phibench.estimator.depth import depth_paper
from phibench.estimator.mirror_image import image_of
from phibench.estimator.phi import CONVENTIONS
from phibench.estimator.sensitivities import PARAMETERS
from phibench.estimator.triangulate import depth_exact
from phibench.scenes.checks import SceneError
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig

EXACT = "exact"
SENSES = (*CONVENTIONS, EXACT)
_TRIES = 1000


def drawn_misalignment(rig: Rig, random: np.random.Generator) -> Misalignment:
    """Independent normal errors of the usual study magnitudes, of all that moves a chief ray.

    One that cannot exist (a distortion that folds the image) is drawn again.
    """
    for _ in range(_TRIES):
        drawn = Misalignment(**{name: random.normal(scale=MISALIGNMENT[name].study) for name in PARAMETERS})
        try:
            rig.perturbed(drawn)
        except SceneError:
            continue
        return drawn
    raise SceneError(f"none of {_TRIES} drawn misalignments of the rig can exist: take a rig with less distortion")


def seen(rig: Rig, misalignment: Misalignment, points_m: Array, strokes_m: Array) -> tuple[Array, Array, Array]:
    """Pixels down and up, shape (n, 2), and true D, shape (n,), of world points (n, 3) with nominal strokes (n,)."""
    true = rig.perturbed(misalignment)
    down = image_of(true.at(0.0), points_m).uv_px
    up = np.full_like(down, np.nan)
    for stroke in np.unique(strokes_m):
        at = strokes_m == stroke
        up[at] = image_of(true.at(misalignment.stroke_m(float(stroke))), points_m[at]).uv_px
    away = points_m[:, :2] - true.at(0.0).sphere_centre_m[:2]
    return down, up, np.hypot(away[:, 0], away[:, 1])


def estimates(sense: str, rig: Rig, strokes_m: Array, down_px: Array, up_px: Array) -> Array:
    """D by eq. (4) with phi in one sense, or by the exact estimator, shape (..., n), from pixels (..., n, 2).

    The rig is an aligned one, so that phi does not depend on the carriage.
    """
    if sense == EXACT:
        return depth_exact(rig, strokes_m, down_px, up_px).depth_m
    view = rig.at(0.0)
    phi1, phi2 = (CONVENTIONS[sense](view, uv) for uv in (down_px, up_px))
    return depth_paper(phi1, phi2, strokes_m, rig.mirror.radius_m).depth_m


def drawn_errors(
    rig: Rig, points_m: Array, strokes_m: Array, count: int, random: np.random.Generator
) -> dict[str, Array]:
    """Errors of D, shape (count, n), metres, in every sense of phi, of an aligned reader of drawn rigs."""
    pictures = [seen(rig, drawn_misalignment(rig, random), points_m, strokes_m) for _ in range(count)]
    down, up, true = (np.stack(part) for part in zip(*pictures, strict=True))
    return {sense: estimates(sense, rig, strokes_m, down, up) - true for sense in SENSES}
