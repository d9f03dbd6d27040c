"""Table of depth estimators: name to function of (rig, stroke, pixel down, pixel up)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from phibench.estimator.geometry.paper_depth import depth_approx, depth_paper, depth_revolved
from phibench.estimator.geometry.phi import CONVENTIONS
from phibench.estimator.geometry.status import DepthEstimate
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import Rig

Estimator = Callable[[Rig, float, Array, Array], DepthEstimate]


def paper_estimator(convention: str, rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> DepthEstimate:
    """Eq. (4) with phi in one convention; on a mirror of revolution, with its profile."""
    phi1, phi2 = _phis(convention, rig, stroke_m, uv_down_px, uv_up_px)
    if isinstance(rig.mirror, RevolvedMirror):
        return depth_revolved(phi1, phi2, stroke_m, rig.mirror.profile)
    return depth_paper(phi1, phi2, stroke_m, rig.mirror.radius_m)


def approx_estimator(convention: str, rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> DepthEstimate:
    """Eq. (5) with phi in one convention."""
    phi1, phi2 = _phis(convention, rig, stroke_m, uv_down_px, uv_up_px)
    return depth_approx(phi1, phi2, stroke_m)


ESTIMATORS: dict[str, Estimator] = {
    **{f"paper_{name}": partial(paper_estimator, name) for name in CONVENTIONS},
    "approx_ray": partial(approx_estimator, "ray"),
    "exact": depth_exact,
}


def _phis(convention: str, rig: Rig, stroke_m: float, down_px: Array, up_px: Array) -> tuple[Array, Array]:
    phi = CONVENTIONS[convention]
    return phi(rig.at(0.0), down_px), phi(rig.at(stroke_m), up_px)
