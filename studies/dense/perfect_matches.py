"""Perfect matches in generated rooms: what geometry alone costs by mirror and stroke, without images.

Each room is seen by rigs with fewer and larger pixels. "Seen twice" is the share of the room's pixels whose point both
images show. The central model takes all rays as coming from one point; its cost is that of perfect matches through an
exact rig. A rig "as built" deviates from the nominal one by the errors of a drawing and a ruler. A "calibrated" one
deviates by what the mirror's outline leaves, as in the study `stroke`. Both are seen through the nominal rig. Sigma
of D takes matches with a given error along the epipolar curve, alike for all pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from phibench.datasets.recipe.mirror_tables import MirrorTable
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.rig_parameters import drawn_deviation
from phibench.estimator.geometry.status import keep
from phibench.estimator.geometry.triangulate import approx_estimator, meeting
from phibench.render.optics.correspondence import Correspondence, correspondence
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.room_properties import drawn_properties

STREAM = "study dense"
SPHERE, PARABOLOID, OFF_AXIS, IN_FOCUS = "sphere", "paraboloid", "hyperboloid off its axis", "hyperboloid in its focus"
TWICE, SIGMA, NEAR = "seen twice", "sigma of D", "near space that can be right"
CENTRAL, CENTRAL_90, THROUGH = "central model", "central model, 90 %", "through the nominal rig"
_HEIGHT_M = 3.0  # the stroke of 1.4 m takes the mirror to 2.1 m
_OFF = Misalignment(decentre_x_m=0.004, decentre_y_m=-0.003, mirror_tilt_x_rad=0.04, mirror_tilt_y_rad=-0.03)

Numbers = dict[tuple[str, float, str], float]
"""By rig, stroke and quantity."""


@dataclass(frozen=True)
class PerfectMatchTask:
    """Numbers that are asked of each room.

    Parameters
    ----------
    strokes_m : sequence of float
    divisor : float
        Of the pixels along each side.
    bands_m : sequence of float
        Ends of the bands of D.
    matching_px : float
        Error of a match along the epipolar curve, pixels of the full camera.
    near_m, right_m : float
        Pixels below the first D are right if sigma of D is the second or less.
    """

    strokes_m: Sequence[float]
    divisor: float
    bands_m: Sequence[float]
    matching_px: float
    near_m: float
    right_m: float


def rigs() -> dict[str, Rig]:
    """Rigs that differ in the mirror alone, all exactly known."""
    sphere = build_rig(RigTable())
    paraboloid, hyperboloid = (
        build_rig(RigTable(mirror=MirrorTable(shape=shape))) for shape in ("paraboloid", "hyperboloid")
    )
    return {SPHERE: sphere, PARABOLOID: paraboloid, OFF_AXIS: hyperboloid.perturbed(_OFF), IN_FOCUS: hyperboloid}


def coarser_rig(rig: Rig, divisor: float) -> Rig:
    """The rig with so many times fewer pixels along each side."""
    camera = rig.camera
    size = {name: round(getattr(camera, name) / divisor) for name in ("width_px", "height_px")}
    focal = {name: getattr(camera, name) / divisor for name in ("fx_px", "fy_px")}
    middle = {name: (getattr(camera, name) + 0.5) / divisor - 0.5 for name in ("cx_px", "cy_px")}
    return replace(rig, camera=replace(camera, **size, **focal, **middle))


def room_of(number: int) -> Room:
    """Generated room of a number."""
    return generate_room(drawn_properties(STREAM, number, height_m=_HEIGHT_M, gloss=0.0), STREAM, number)


def room_numbers(
    asked: PerfectMatchTask, exact: Mapping[str, Rig], covariances: Mapping[str, Array], number: int
) -> Numbers:
    """All numbers of one room, in % but for those in metres."""
    room, found = room_of(number), Numbers()
    for stroke_m in asked.strokes_m:
        for name, rig in exact.items():
            values = rig_numbers(asked, coarser_rig(rig, asked.divisor), room, stroke_m)
            found |= {(name, stroke_m, what): value for what, value in values.items()}
        for name, covariance in covariances.items():
            off = drawn_deviation(covariance, generator(STREAM, name, number))
            found[f"rig {name}", stroke_m, THROUGH] = nominal_rig_error(asked, exact[SPHERE], off, room, stroke_m)
    return found


def rig_numbers(asked: PerfectMatchTask, rig: Rig, room: Room, stroke_m: float) -> dict[str, float]:
    """Numbers of an exactly known rig in one room at one stroke, in %."""
    seen = correspondence(room, rig.at(0.0), rig.at(stroke_m))
    uv, up, depth = _pixels_of(seen)
    moved = np.linalg.norm(up_image(rig, stroke_m, uv, 1.0 / depth).jacobian[..., 2], axis=-1)
    sigma = asked.matching_px / asked.divisor * depth**2 / moved
    central = np.abs(approx_estimator("ray", rig, stroke_m, uv, up).depth_m / depth - 1.0)
    whole, near = int(seen.of_room.sum()), int((seen.of_room & (seen.depth_m < asked.near_m)).sum())
    hidden = np.full(whole - len(depth), np.inf)
    right = np.sum((sigma <= asked.right_m) & (depth < asked.near_m))
    by_band = {
        f"{what}, {label}": _median(values[(low <= depth) & (depth < high)])
        for label, (low, high) in bands(asked.bands_m).items()
        for what, values in ((CENTRAL, central), (SIGMA, sigma / depth))
    }
    shares = {
        TWICE: len(depth) / whole,
        SIGMA: _median(np.concatenate([sigma / depth, hidden])),
        NEAR: float(right / near) if near else np.nan,
        CENTRAL: _median(central),
        CENTRAL_90: float(np.quantile(central, 0.9)),
        **by_band,
    }
    return {what: 100.0 * value for what, value in shares.items()}


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else np.nan


def bands(ends_m: Sequence[float]) -> dict[str, tuple[float, float]]:
    """Lower and upper end by the band's name, from 0 to infinity."""
    names = [f"below {ends_m[0]:g} m", *(f"{a:g} to {b:g} m" for a, b in pairwise(ends_m)), f"above {ends_m[-1]:g} m"]
    return dict(zip(names, pairwise((0.0, *ends_m, np.inf)), strict=True))


def nominal_rig_error(asked: PerfectMatchTask, nominal: Rig, off: Misalignment, room: Room, stroke_m: float) -> float:
    """Median error of D of perfect matches of a rig that deviates, seen through the nominal one, %.

    A match whose rays do not meet in front of the mirror counts as wrong by more than any other.
    """
    true, rig = (coarser_rig(each, asked.divisor) for each in (nominal.perturbed(off), nominal))
    uv, up, depth = _pixels_of(correspondence(room, true.at(0.0), true.at(off.stroke_m(stroke_m))))
    at = meeting(rig, stroke_m, uv, up)
    error = np.abs(keep(at.depth_m, at.status) / depth - 1.0)
    return float(100.0 * np.median(np.where(np.isfinite(error), error, np.inf)))


def _pixels_of(found: Correspondence) -> tuple[Array, Array, Array]:
    """Pixels whose point both images show, shape (n, 2), their places in the up image, and D, shape (n,)."""
    v, u = np.nonzero(found.seen)
    return np.stack([u, v], axis=-1).astype(float), found.uv_px[found.seen], found.depth_m[found.seen]
