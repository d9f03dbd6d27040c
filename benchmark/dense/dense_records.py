"""Records of a dense score: D of answers and its errors, one row per pair and part of its pixels (whole, strata).

Pixels that count are those whose room point both images show. Errors are relative, D / truth - 1, over the pixels that
are answered; an unanswered pixel lowers the share that is answered and the recall, and nothing else.

Perfect matches split the error. The true place in the other image, seen through the rig that the method was given,
leaves the error of that rig alone (calibration). The same place by the central model, which takes every ray as
coming from one point, adds what that model costs. What remains of the answer is the matching's part.

Sparsification: pixels are left out by the largest claimed sigma first, or by the largest error first. The area between
both curves of the mean error, each over the mean of all, is AUSE (E. Ilg et al., ECCV 2018): 0 is a perfect order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl
from scipy.ndimage import binary_dilation

from phibench.benchmark.dense.dense_pairs import DenseTruth
from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.benchmark.scores.record_columns import THRESHOLDS
from phibench.estimator.dense.dense_interface import DenseAnswer
from phibench.estimator.geometry.epipolar_line import range_at
from phibench.estimator.geometry.reflection import room_rays
from phibench.estimator.geometry.status import keep
from phibench.estimator.geometry.triangulate import approx_estimator, meeting
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

ABOVE = (0.02, 0.05, 0.10)
_REMOVED = np.arange(100) / 100.0  # shares that are left out, of the sparsification
_LEAST_PIXELS = 200  # of a stratum in a pair
_AT_ONCE = 1 << 15

COLUMNS: dict[str, str] = {
    "number": "pair, as in the pair set",
    "sample_id": "sample; intervals resample these",
    "draw": "draw of the noise",
    "preset": "preset of the sensor",
    "room": "kind of the room",
    "stroke_m": "h",
    "by": "what the stratum is by; all is the whole",
    "label": "which part of it",
    "pixels": "whose room point both images show",
    "answered": "share of them that is answered",
    "hidden_answered": "share of the pixels that is answered, of those whose point the up image does not show",
    "median": "of |relative error|",
    "mean": "of |relative error|: MARE of Helvipad",
    "square": "mean squared relative error",
    "p90": "of |relative error|, 90 % are below",
    "bias": "median relative error, with its sign",
    **{f"above_{round(100 * t)}": f"share of the answers that is off by more than {round(100 * t)} %" for t in ABOVE},
    "recall": "share of all pixels within 0.5, 1, 2, 5, 10 and 20 %, averaged over these",
    "mae_m": "mean |error of D|",
    "square_m2": "mean squared error of D",
    "disparity_mae_deg": "mean |error| of the angle between the point's directions from both sphere centres",
    "disparity_square_deg2": "mean squared error of that angle",
    "disparity_mare": "mean |error| of that angle over the angle",
    "seam_m": "left-right consistency: mean difference between D across the panorama's seam and that of the truth",
    "calibration": "median |relative error| of perfect matches through the rig that was given",
    "central": "median |difference| between perfect matches by the central model and by that rig",
    "central_p90": "of the same difference, 90 % are below",
    "matching": "median |difference| between the answers and perfect matches through that rig",
    "matching_central": "the same, and perfect matches by the central model",
    "ause": "area between the curves of sparsification by the claimed sigma and by the error",
    "coverage": "share of the answers within 1.96 claimed sigma",
    "seconds": "inside the method",
    "failure": "of the harness; empty if none",
    "message": "about the failure",
}
_TEXTS = ("sample_id", "preset", "room", "by", "label", "failure", "message")
COLUMN_TYPES: dict[str, pl.DataType] = {
    name: pl.String() if name in _TEXTS else pl.Int64() if name in ("number", "draw", "pixels") else pl.Float64()
    for name in COLUMNS
}


def depths_of(answer: DenseAnswer, rig: Rig, stroke_m: float) -> Array:
    """D of an answer, shape (H, W), float64; places in the up image become D through a rig."""
    if answer.target_uv_px is None:
        return np.asarray(answer.depth_m, float)
    return exact_depths(rig, stroke_m, np.asarray(answer.target_uv_px, float), answer.answered)


def exact_depths(rig: Rig, stroke_m: float, up_px: Array, where: BoolArray) -> Array:
    """D, shape (H, W), of the midpoints of the rays of all pixels and of places in the up image; NaN elsewhere."""
    depth = np.full(where.shape, np.nan)
    for index in _some(where):
        at = meeting(rig, stroke_m, _pixels(index, where.shape[1]), up_px.reshape(-1, 2)[index])
        depth.reshape(-1)[index] = keep(at.depth_m, at.status)
    return depth


def central_depths(rig: Rig, stroke_m: float, up_px: Array, where: BoolArray) -> Array:
    """The same by the central model, eq. (5) of the paper: D = h / (cot 2 phi_1 - cot 2 phi_2)."""
    depth = np.full(where.shape, np.nan)
    for index in _some(where):
        found = approx_estimator("ray", rig, stroke_m, _pixels(index, where.shape[1]), up_px.reshape(-1, 2)[index])
        depth.reshape(-1)[index] = found.depth_m
    return depth


def _some(where: BoolArray) -> list[Any]:
    index = np.flatnonzero(where)
    return np.array_split(index, len(index) // _AT_ONCE + 1)


def _pixels(index: Any, width: int) -> Array:
    v, u = np.divmod(index, width)
    return np.stack([u, v], axis=-1).astype(float)


@dataclass(frozen=True)
class TruthErrors:
    """Errors that follow from a pair's truth alone, shared by all methods: see the module's docstring."""

    truth: DenseTruth

    @cached_property
    def calibration(self) -> Array:
        """Relative error of perfect matches through the given rig, shape (H, W)."""
        t = self.truth
        return exact_depths(t.given_rig, t.given_stroke_m, t.found.uv_px, t.scored) / t.depth_m - 1.0

    @cached_property
    def central(self) -> Array:
        """Relative error of perfect matches by the central model and the given rig, shape (H, W)."""
        t = self.truth
        return central_depths(t.given_rig, t.given_stroke_m, t.found.uv_px, t.scored) / t.depth_m - 1.0

    def disparity_rad(self, depth_m: Array) -> Array:
        """Angle between the directions from both sphere centres to the points of D on the true rays, shape (H, W)."""
        t, angle = self.truth, np.full(depth_m.shape, np.nan)
        down, up = t.true_rig.at(0.0), t.true_rig.at(t.stroke_m).sphere_centre_m
        for index in _some(np.isfinite(depth_m) & t.scored):
            ray = room_rays(down, _pixels(index, depth_m.shape[1]))
            with np.errstate(invalid="ignore"):
                s = range_at(ray.origin_world_m - down.sphere_centre_m, ray.direction_world, depth_m.reshape(-1)[index])
            X = ray.origin_world_m + s[:, None] * ray.direction_world
            angle.reshape(-1)[index] = _angle(X - down.sphere_centre_m, X - up)
        return angle

    @cached_property
    def true_disparity_rad(self) -> Array:
        """The angle of the true D, shape (H, W)."""
        return self.disparity_rad(self.truth.depth_m)

    @cached_property
    def strata(self) -> list[tuple[str, str, BoolArray]]:
        """Parts of the pixels that count, with at least 200 pixels each: what by, which, mask."""
        t = self.truth
        parts = [("all", "all", t.scored), *self._by_edges()]
        near = _near_jumps(t.depth_m) & t.scored
        parts += [("edge", "within 3 px of a jump of D", near), ("edge", "elsewhere", t.scored & ~near)]
        shiny = t.found.glossy & t.scored
        parts += [("gloss", "glossy", shiny), ("gloss", "matt", t.scored & ~shiny)] if shiny.any() else []
        return [part for part in parts if part[0] == "all" or part[2].sum() >= _LEAST_PIXELS]

    def _by_edges(self) -> Iterator[tuple[str, str, BoolArray]]:
        t = self.truth
        for by, (values, edges, unit) in {
            "depth": (t.depth_m, (0.0, 1.0, 2.0, 3.0, 4.0, np.inf), "m"),
            "elevation": (np.degrees(t.elevation_rad), (-90.0, -30.0, -10.0, 10.0, 30.0, 90.0), "deg"),
            "texture": (t.texture, (0.0, 0.3, 1.0, 3.0, 10.0, np.inf), "of the noise"),
        }.items():
            for low, high in pairwise(edges):
                with np.errstate(invalid="ignore"):
                    yield by, _label(low, high, unit), t.scored & (values >= low) & (values < high)


def _label(low: float, high: float, unit: str) -> str:
    return f"from {low:g} {unit}" if np.isinf(high) else f"{low:g} to {high:g} {unit}"


def _angle(a: Array, b: Array) -> Array:
    """Angle between vectors, shape (N,), accurate for small ones."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b)))


_JUMP, _NEAR_PX = 0.05, 3  # relative, between neighbours


def _near_jumps(depth_m: Array) -> BoolArray:
    """Mask of the pixels within 3 px of a jump of D by 5 % between neighbours."""
    jump, log = np.zeros(depth_m.shape, bool), np.log(depth_m)
    for axis in (0, 1):
        with np.errstate(invalid="ignore"):
            high = np.abs(np.diff(log, axis=axis)) > _JUMP
        for part in (slice(1, None), slice(None, -1)):
            jump[(part, slice(None)) if axis == 0 else (slice(None), part)] |= high
    return np.asarray(binary_dilation(jump, iterations=_NEAR_PX))


def pair_records(
    errors: TruthErrors, answer: DenseAnswer | None, seconds: float, failure: str = "", message: str = ""
) -> pl.DataFrame:
    """Rows of one pair, `COLUMNS`; without an answer no pixel is answered."""
    t = errors.truth
    depth = np.full(t.depth_m.shape, np.nan) if answer is None else depths_of(answer, t.given_rig, t.given_stroke_m)
    sigma = None if answer is None or answer.sigma_depth_m is None else np.asarray(answer.sigma_depth_m, float)
    with np.errstate(invalid="ignore"):
        relative = depth / t.depth_m - 1.0
    disparity = errors.disparity_rad(depth)
    hidden = t.found.of_room & ~t.scored
    rows = []
    for by, label, mask in errors.strata:
        known = mask & np.isfinite(relative)
        row: dict[str, Any] = {"by": by, "label": label, "pixels": int(mask.sum())}
        row["answered"] = float(known.sum() / max(mask.sum(), 1))
        row |= _relative(relative[known], int(mask.sum()))
        row |= _metric(depth[known], t.depth_m[known], disparity[known], errors.true_disparity_rad[known])
        row |= _split(relative[known], errors.calibration[known], errors.central[known])
        row |= {} if sigma is None else _claims(relative[known], (sigma / t.depth_m)[known])
        if by == "all":
            row["hidden_answered"] = float(np.isfinite(depth)[hidden].mean()) if hidden.any() else np.nan
            row["seam_m"] = seam(depth, t)
        rows.append(row)
    shared = {"number": t.number, "sample_id": t.sample_id, "draw": t.draw, "preset": t.preset, "room": t.room}
    shared |= {"stroke_m": t.stroke_m, "seconds": seconds, "failure": failure, "message": message}
    columns = {name: [{**shared, **row}.get(name) for row in rows] for name in COLUMNS}
    return pl.DataFrame(columns, schema=COLUMN_TYPES).with_columns(pl.col(pl.Float64).fill_nan(None))


def _relative(relative: Array, pixels: int) -> dict[str, float]:
    size = np.abs(relative)
    recall = float(np.mean([np.count_nonzero(size <= t) for t in THRESHOLDS]) / max(pixels, 1))
    if not len(relative):
        return {"recall": recall}
    return {
        "median": float(np.median(size)),
        "mean": float(size.mean()),
        "square": float(np.mean(size**2)),
        "p90": float(np.quantile(size, 0.9)),
        "bias": float(np.median(relative)),
        **{f"above_{round(100 * t)}": float(np.mean(size > t)) for t in ABOVE},
        "recall": recall,
    }


def _metric(depth: Array, true: Array, disparity: Array, true_disparity: Array) -> dict[str, float]:
    if not len(depth):
        return {}
    error, angle = depth - true, np.degrees(disparity - true_disparity)
    return {
        "mae_m": float(np.abs(error).mean()),
        "square_m2": float(np.mean(error**2)),
        "disparity_mae_deg": float(np.abs(angle).mean()),
        "disparity_square_deg2": float(np.mean(angle**2)),
        "disparity_mare": float(np.mean(np.abs(disparity / true_disparity - 1.0))),
    }


def _split(relative: Array, calibration: Array, central: Array) -> dict[str, float]:
    if not len(relative):
        return {}
    parts = {"calibration": calibration, "central": central - calibration}
    parts |= {"matching": relative - calibration, "matching_central": relative - central}
    found = {name: float(np.nanmedian(np.abs(part))) for name, part in parts.items() if np.isfinite(part).any()}
    if "central" in found:
        found["central_p90"] = float(np.nanquantile(np.abs(parts["central"]), 0.9))
    return found


def _claims(relative: Array, sigma: Array) -> dict[str, float]:
    if not len(relative):
        return {}
    return {"ause": ause(np.abs(relative), sigma), "coverage": float(np.mean(np.abs(relative) <= NORMAL_95 * sigma))}


def ause(error: Array, sigma: Array) -> float:
    """Area under the sparsification error curve of errors (n,) and what orders them (n,); 0 where all errors are."""
    whole = float(error.mean())
    if whole == 0.0:
        return 0.0
    kept = np.maximum(np.round((1.0 - _REMOVED) * len(error)).astype(int), 1)
    curves = []
    for key in (sigma, error):
        running = np.cumsum(error[np.argsort(key, kind="stable")])
        curves.append(running[kept - 1] / kept / whole)
    return float(np.trapezoid(curves[0] - curves[1], _REMOVED))


def seam(depth_m: Array, truth: DenseTruth) -> float:
    """Left-right consistency error: mean |(D_left - D_right) - (the same of the truth)| across the panorama's seam.

    The seam of the unrolled image is behind the robot, at the azimuth of 180 degrees. Its neighbours are the pixels
    above and below the row in which the sphere's centre lies, on that side; NaN where none of them are known.
    """
    centre = truth.given_rig.camera.project(truth.given_rig.sphere_in_camera_m)
    above = int(np.floor(centre[1]))
    side = truth.found.point_world_m[..., 0] < 0.0
    rows = [above, above + 1]
    both = truth.scored[rows].all(axis=0) & side[rows].all(axis=0) & np.isfinite(depth_m[rows]).all(axis=0)
    if not both.any():
        return float("nan")
    answered, true = (plane[rows][:, both] for plane in (depth_m, truth.depth_m))
    return float(np.abs((answered[0] - answered[1]) - (true[0] - true[1])).mean())
