"""Depth from two angles by the paper's equations, sphere or mirror of revolution; predicted errors; published results.

"Depth estimation for mobile robot using single omnidirectional camera system", sections 3 and 4. Symbols are the
paper's: phi_1 (down) and phi_2 (up), h stroke, R mirror radius, D depth, lambda, epsilon; see docs/paper.md. Leading
axes of all arguments broadcast together. `published.csv` has Tables 1 to 4.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.status import (
    DepthEstimate,
    Status,
    StatusArray,
    first_fault,
    flag,
    keep,
    propagate,
    stroke_status,
)
from phibench.scenes.frames import Array
from phibench.scenes.revolved_profile import Profile

# Sine of the disparity below which two rays count as parallel: the depth would be more than 1e8 strokes.
PARALLEL_SINE = 1e-9
ON_AXIS_SINE = 1e-9  # of an angle below which a ray is on the axis, where the azimuth is not defined


@dataclass(frozen=True)
class _Angles:
    """Sine and cosine of phi_1, phi_2 (s, c), of 2 phi_1, 2 phi_2 (S, C) and of the disparity 2 phi_1 - 2 phi_2."""

    s1: Array
    c1: Array
    S1: Array
    C1: Array
    s2: Array
    c2: Array
    S2: Array
    C2: Array
    sin_disparity: Array
    cos_disparity: Array


def depth_paper(
    phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike, radius_m: float, covariance_rad2: Array | None = None
) -> DepthEstimate:
    """Depth by eqs. (1) to (4).

    Eq. (4) is multiplied by cos 2phi_1 cos 2phi_2, top and bottom. That changes no value, and the result is
    regular where 2 phi passes 90 degrees (the point is level with the mirror) and the tangents are infinite.

    Parameters
    ----------
    phi1_rad, phi2_rad : array, shape (...)
        At the down and the up position.
    stroke_m : array, shape (...)
        Stroke h.
    radius_m : float
        R.
    covariance_rad2 : array, shape (..., 2, 2)
        Covariance of (phi1, phi2), optional.

    Returns
    -------
    DepthEstimate
        D with its standard deviation to first order, and a status.
    """
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    R = radius_m
    with np.errstate(all="ignore"):
        a = _angles(phi1, phi2)
        lam = R * (a.c2 - a.c1)  # eq. (3): H2 = H1 + h - lambda
        D = ((h - lam) * a.S1 * a.S2 + R * (a.s2 * a.C2 * a.S1 - a.s1 * a.C1 * a.S2)) / a.sin_disparity  # eq. (4)
        ahead = (D > R * a.s1) & (D > R * a.s2)  # D_i = D - R sin(phi_i) of eqs. (1), (2) lies on the ray
        status = first_fault(_status(phi1, phi2, h, a), flag((~ahead, Status.DIVERGING)))
        sigma = propagate(_paper_gradient(a, D, h, lam, R), covariance_rad2)
    return DepthEstimate(keep(D, status), keep(sigma, status), status)


def depth_revolved(
    phi1_rad: ArrayLike,
    phi2_rad: ArrayLike,
    stroke_m: ArrayLike,
    profile: Profile,
    covariance_rad2: Array | None = None,
) -> DepthEstimate:
    """Depth by eq. (4) for a mirror of revolution.

    The paper takes phi for the normal's angle as well, so that the mirror's slope at the reflection point is tan phi.
    With r and z the radius and height of that place of the profile, the two rays meet where

        D = ((h + z2 - z1) S1 S2 + r2 C2 S1 - r1 C1 S2) / sin(2 phi1 - 2 phi2),    S, C = sin, cos of 2 phi.

    On a sphere r = R sin phi and z = -R cos phi, and this is eq. (4). A cone has one slope: there is no depth.

    Parameters and result as for `depth_paper`; OUT_OF_RANGE where the profile has no such slope.
    """
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        a = _angles(phi1, phi2)
        one, two = _place(phi1, profile), _place(phi2, profile)
        D = _revolved_depth(a, h, one, two)
        ahead = (D > one.r) & (D > two.r)
        has_places = np.isfinite(one.r) & np.isfinite(two.r)
        status = first_fault(
            _status(phi1, phi2, h, a), flag((~has_places, Status.OUT_OF_RANGE), (~ahead, Status.DIVERGING))
        )
        sigma = propagate(_revolved_gradient(a, D, h, one, two), covariance_rad2)
    return DepthEstimate(keep(D, status), keep(sigma, status), status)


def revolved_gradient(phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike, profile: Profile) -> Array:
    """dD/d(phi1, phi2) of `depth_revolved`, shape (..., 2), metres per radian, analytic."""
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        a, one, two = _angles(phi1, phi2), _place(phi1, profile), _place(phi2, profile)
        return _revolved_gradient(a, _revolved_depth(a, h, one, two), h, one, two)


def depth_approx(
    phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike, covariance_rad2: Array | None = None
) -> DepthEstimate:
    """Depth by eq. (5) with its sign corrected (plus): eq. (4) for a mirror of radius 0.

    Parameters and result as for `depth_paper`.
    """
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        a = _angles(phi1, phi2)
        D = h * a.S1 * a.S2 / a.sin_disparity  # eq. (5)
        status = first_fault(_status(phi1, phi2, h, a), flag((~(D > 0.0), Status.DIVERGING)))
        sigma = propagate(_paper_gradient(a, D, h, 0.0, 0.0), covariance_rad2)
    return DepthEstimate(keep(D, status), keep(sigma, status), status)


def paper_gradient(phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike, radius_m: float) -> Array:
    """dD/d(phi1, phi2) of eq. (4), shape (..., 2), metres per radian, analytic; of eq. (5) for radius 0."""
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        a, D = _angles(phi1, phi2), depth_paper(phi1, phi2, h, radius_m).depth_m
        return _paper_gradient(a, D, h, radius_m * (a.c2 - a.c1), radius_m)


def error_eq6(depth_m: ArrayLike, phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike) -> Array:
    """|dD/d disparity|, metres per radian, by eq. (6) corrected: D / (h s) sqrt(D^2 - (h s)^2).

    Holds s = sin 2phi1 sin 2phi2 constant, which is itself an approximation. NaN where D < h s: the
    disparity is beyond 90 degrees.
    """
    D, hs = _depth_and_hs(depth_m, phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        return np.asarray(D / hs * np.sqrt((D - hs) * (D + hs)))  # eq. (6)


def error_eq7(depth_m: ArrayLike, phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike) -> Array:
    """|dD/d disparity|, metres per radian, by eq. (7): D^2 / (h sin 2phi1 sin 2phi2), for h << D."""
    D, hs = _depth_and_hs(depth_m, phi1_rad, phi2_rad, stroke_m)
    with np.errstate(all="ignore"):
        return np.asarray(D * D / hs)  # eq. (7)


def _inputs(phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike) -> tuple[Array, Array, Array]:
    phi1, phi2, h = np.broadcast_arrays(*(np.asarray(x, float) for x in (phi1_rad, phi2_rad, stroke_m)))
    return phi1, phi2, h


def _angles(phi1: Array, phi2: Array) -> _Angles:
    s1, c1, S1, C1, s2, c2, S2, C2, sin_disparity, cos_disparity = (
        f(x) for x in (phi1, 2.0 * phi1, phi2, 2.0 * phi2, 2.0 * (phi1 - phi2)) for f in (np.sin, np.cos)
    )
    return _Angles(s1, c1, S1, C1, s2, c2, S2, C2, sin_disparity, cos_disparity)


def _status(phi1: Array, phi2: Array, h: Array, a: _Angles) -> StatusArray:
    phis = np.stack([phi1, phi2])
    angles = flag(
        (~np.isfinite(phis).all(axis=0), Status.NOT_FINITE),
        (((phis < 0.0) | (phis > np.pi / 2.0)).any(axis=0), Status.OUT_OF_RANGE),
        (np.minimum(np.abs(a.S1), np.abs(a.S2)) < ON_AXIS_SINE, Status.ON_AXIS),
        (np.abs(a.sin_disparity) < PARALLEL_SINE, Status.PARALLEL),
    )
    return first_fault(angles, stroke_status(h))


def _paper_gradient(a: _Angles, D: Array, h: Array, lam: Array | float, R: float) -> Array:
    """dD/d(phi1, phi2), shape (..., 2), of D = N / sin(disparity)."""
    reach = h - lam
    dN1 = (2.0 * reach * a.C1 - R * a.s1 * a.S1) * a.S2 + R * (
        2.0 * a.s2 * a.C2 * a.C1 - a.c1 * a.C1 * a.S2 + 2.0 * a.s1 * a.S1 * a.S2
    )
    dN2 = (2.0 * reach * a.C2 + R * a.s2 * a.S2) * a.S1 + R * (
        a.c2 * a.C2 * a.S1 - 2.0 * a.s2 * a.S2 * a.S1 - 2.0 * a.s1 * a.C1 * a.C2
    )
    turn = 2.0 * a.cos_disparity * D
    return np.stack([dN1 - turn, dN2 + turn], -1) / a.sin_disparity[..., None]


@dataclass(frozen=True)
class _Place:
    """Radius and height on a profile where the normal has an angle, and their derivatives by it."""

    r: Array
    z: Array
    r1: Array
    z1: Array


def _place(phi: Array, profile: Profile) -> _Place:
    slope = np.tan(phi)
    r = profile.radius_at_slope(slope)
    sag = profile.sag(r * r)
    r1 = (1.0 + slope * slope) / (2.0 * sag.slope_per_m + 4.0 * r * r * sag.bend_per_m3)
    return _Place(r, sag.z_m, r1, slope * r1)


def _revolved_depth(a: _Angles, h: Array, one: _Place, two: _Place) -> Array:
    return np.asarray(((h + two.z - one.z) * a.S1 * a.S2 + two.r * a.C2 * a.S1 - one.r * a.C1 * a.S2) / a.sin_disparity)


def _revolved_gradient(a: _Angles, D: Array, h: Array, one: _Place, two: _Place) -> Array:
    """dD/d(phi1, phi2), shape (..., 2), of D = N / sin(disparity)."""
    reach, turn = h + two.z - one.z, 2.0 * a.cos_disparity * D
    dN1 = (2.0 * reach * a.C1 - one.z1 * a.S1) * a.S2 + 2.0 * two.r * a.C2 * a.C1
    dN1 += (2.0 * one.r * a.S1 - one.r1 * a.C1) * a.S2
    dN2 = (2.0 * reach * a.C2 + two.z1 * a.S2) * a.S1 - 2.0 * one.r * a.C1 * a.C2
    dN2 += (two.r1 * a.C2 - 2.0 * two.r * a.S2) * a.S1
    return np.stack([dN1 - turn, dN2 + turn], -1) / a.sin_disparity[..., None]


def _depth_and_hs(
    depth_m: ArrayLike, phi1_rad: ArrayLike, phi2_rad: ArrayLike, stroke_m: ArrayLike
) -> tuple[Array, Array]:
    phi1, phi2, h = _inputs(phi1_rad, phi2_rad, stroke_m)
    return np.asarray(depth_m, float), h * np.sin(2.0 * phi1) * np.sin(2.0 * phi2)


# -- published results -------------------------------------------------------------------------------------------------

PUBLISHED_CSV = Path(__file__).with_name("published.csv")
_SAME_M = 1e-6  # the tables are printed to millimetres: depths closer than this are the same number


@dataclass(frozen=True)
class Published:
    """One column of one of the paper's tables, metres; `baseline_m` has the misprint of Table 1 corrected."""

    experiment: str
    real_depth_m: float
    baseline_printed_m: float
    baseline_m: float
    estimated_depth_m: float

    @property
    def error_m(self) -> float:
        """Published estimate minus real depth."""
        return self.estimated_depth_m - self.real_depth_m


def load_published() -> tuple[Published, ...]:
    """Read the 25 published results in the order of the tables."""
    lines = (line for line in PUBLISHED_CSV.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return tuple(_row(record) for record in csv.DictReader(lines))


def find_published(experiment: str, depth_m: float, stroke_m: float) -> Published | None:
    """Return the published result of an experiment ("table1" to "table4"), or None if the paper has none."""
    matches = (
        row
        for row in load_published()
        if row.experiment == experiment
        and abs(row.real_depth_m - depth_m) < _SAME_M
        and abs(row.baseline_m - stroke_m) < _SAME_M
    )
    return next(matches, None)


def _row(record: dict[str, str]) -> Published:
    lengths = {name: float(text) for name, text in record.items() if name != "table"}
    return Published(f"table{record['table']}", **lengths)
