"""Depth of drawn rigs with mirrors of revolution: nominal, after an outline, and after an outline and four spots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import optimize

from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.bundle import KnownSpot, apparent_outline, calibrate
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, prior_sigmas
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.optics.reflection_point import mirror_points
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import Rig

STROKE = 0.5
DRAWN = {
    **dict.fromkeys(PARAMETERS, 0.0),
    **dict.fromkeys(("decentre_x_m", "decentre_y_m"), 1e-3),
    **dict.fromkeys(("tilt_x_rad", "tilt_y_rad", "mirror_tilt_x_rad", "mirror_tilt_y_rad"), math.radians(0.5)),
    **dict.fromkeys(("cx_px", "cy_px"), 5.0),
    **{"axial_m": 2e-3, "radius_m": 2.5e-4, "focal_relative": 0.003, "rim_radius_m": 5e-5},
}
FOUR = ((1.2, 0.3), (2.0, 1.9), (3.0, 3.4), (4.0, 5.0))
DEPTHS = np.array([1.0, 1.8, 2.6, 3.4, 4.2])


def nominal_of(shape: str) -> Rig:
    """Default rig of a shape; a cone is the wide one, which sees pairs from 3 m on and is not asked here."""
    return build_rig(RigTable.model_validate({"mirror": {"shape": shape}}))


def around(rig: Rig, depth_m: float, azimuth_rad: float) -> Array:
    centre = rig.at(0.0).sphere_centre_m
    return np.array([centre[0] + depth_m * np.cos(azimuth_rad), centre[1] + depth_m * np.sin(azimuth_rad), 0.5])


def pixel(rig: Rig, point: Array, offset_m: float) -> Array:
    """The simulator's pixel of a point."""
    view = rig.at(offset_m)
    found = mirror_points(view, point[None], view.camera_centre_m[None])
    return rig.camera.project(view.T_world_camera.inverse().points(found.points_m))[0]


def seen_place(nominal: Rig, true: Rig) -> Array:
    """Vertex and ellipse, shape (5,), of the nominal mirror whose rim is nearest to the true one in the image.

    Points of both circles, projected and compared all around; least squares by differences, unlike `contour`.
    """
    turn = np.linspace(-np.pi, np.pi, 720, endpoint=False)

    def rim(rig: Rig, at_m: Array) -> Array:
        assert isinstance(rig.mirror, RevolvedMirror)
        profile = rig.mirror.profile
        circle = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1) * profile.rim_radius_m
        circle[:, 2] = profile.depth_m
        return circle @ rig.T_camera_sphere.R.T + at_m

    middle = nominal.outline_px().mean(axis=0)

    def radius(rig: Rig, at_m: Array) -> Array:
        off = rig.camera.project(rim(rig, at_m)) - middle
        angle = np.arctan2(off[:, 1], off[:, 0])
        order = np.argsort(angle)
        return np.interp(turn, angle[order], np.hypot(*off.T)[order], period=2.0 * np.pi)

    wanted = radius(true, true.sphere_in_camera_m)

    def off(x: Array) -> Array:
        return radius(nominal, x[:3]) + x[3] * np.cos(2 * turn) + x[4] * np.sin(2 * turn) - wanted

    start = np.append(nominal.sphere_in_camera_m, [0.0, 0.0])
    return np.asarray(optimize.least_squares(off, start, x_scale=[1e-3, 1e-3, 1e-3, 1.0, 1.0], xtol=1e-12).x)


@dataclass(frozen=True)
class Data:
    """Sigma of what a calibration gets, and whether errors of that sigma are drawn."""

    outline: tuple[float, float, float, float, float]
    pixel: float = 0.0
    depth_m: float = 0.0
    drawn: bool = True


FINE, FRAMES = (2e-6, 2e-6, 1e-5, 5e-3, 5e-3), (5e-6, 5e-6, 2e-5, 0.03, 0.03)
DATA = {
    "outline": Data(FINE, drawn=False),
    "spots, closure": Data(FINE, 1e-3, 1e-4, drawn=False),
    "spots, same sigmas drawn": Data(FINE, 1e-3, 1e-4),
    "spots of frames, D to 1 mm": Data(FRAMES, 0.02, 1e-3),
}


def errors_of(shape: str, k: int, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Relative errors of D, nominal and after each calibration, and the calibrated ones over their sigma."""
    nominal, rng, sigmas = nominal_of(shape), generator("clos", shape, k), prior_sigmas(DRAWN)
    true = changed_rig(nominal, rng.normal(0.0, sigmas))
    points = [around(true, depth, rng.uniform(0.0, 2.0 * np.pi)) for depth in DEPTHS]
    uv = [np.array([pixel(true, point, h) for point in points]) for h in (0.0, STROKE)]
    seen, errors, pulls = seen_place(nominal, true), [depth_exact(nominal, STROKE, *uv).depth_m / DEPTHS - 1.0], []
    for name in names:
        data, noise = DATA[name], rng.standard_normal if DATA[name].drawn else np.zeros
        outline = PoseMeasurement(seen + np.array(data.outline) * noise(5), np.diag(np.square(data.outline)))
        spots = []
        for depth, azimuth in FOUR if data.pixel else ():
            down, up = (pixel(true, around(true, depth, azimuth), h) + data.pixel * noise(2) for h in (0.0, STROKE))
            C = data.pixel**2 * np.eye(2)
            spots.append(KnownSpot(down, up, C, C, STROKE, depth + data.depth_m * float(noise(1)[0]), data.depth_m))
        bundle, C = calibrate(nominal, outline, spots, sigmas=sigmas), 1e-6 * np.eye(2)
        errors.append(depth_exact(bundle.rig, STROKE, *uv).depth_m / DEPTHS - 1.0)
        found = depth_general(bundle.rig, STROKE, *uv, C, C, bundle.covariance)
        pulls.append((found.depth_m - DEPTHS) / found.sigma_m)
    return np.array(errors), np.array(pulls)


@pytest.mark.slow
def test_accuracy_of_depth_of_a_revolved_rig() -> None:
    """Two paraboloids: per cents with the nominal rig, and 0.2 % after outline and four spots without errors.

    The closure's own error is 0.005 %; a bundle that took the tilt for none would leave some tenths of a per cent.
    """
    errors = np.array([errors_of("paraboloid", k, ("spots, closure",))[0] for k in range(2)])
    nominal, closed = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    print(f"nominal {nominal:.4f}, closure {closed:.6f}")
    assert nominal > 0.005
    assert closed < 0.0005


@pytest.mark.study
@pytest.mark.slow
@pytest.mark.parametrize("shape", ["paraboloid", "hyperboloid", "ellipsoid"])
def test_accuracy_of_depth_over_revolved_rigs(shape: str) -> None:
    """The table of docs/measurements/calibration.md."""
    found = [errors_of(shape, k, tuple(DATA)) for k in range(6)]
    errors, pulls = (np.array([one[i] for one in found]) for i in (0, 1))
    rms = 100.0 * np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    pull = np.sqrt(np.mean(np.square(pulls), axis=(0, 2)))
    for name, value, p in zip(("nominal", *DATA), rms, (np.nan, *pull), strict=True):
        print(f"{shape}, {name}: {value:.4f} %, pull {p:.2f}")
    assert rms[0] > 1.0
    assert rms[2] < 0.02
    assert rms[3] < 0.1
    assert rms[4] < 0.3


def test_accuracy_of_a_tilts_sign() -> None:
    """An ellipse of a tilt of one degree about y: both signs are in the answer, and none about x.

    The tilt is known but for its sign, so that its standard deviation is its size; one hill alone has a fifth of it.
    """
    nominal, sigmas = nominal_of("hyperboloid"), prior_sigmas(DRAWN | {"tilt_x_rad": 0.0, "tilt_y_rad": 0.0})
    sigmas[[PARAMETERS.index(name) for name in ("decentre_x_m", "decentre_y_m")]] = 1e-4  # the line of sight is known
    true = changed_rig(nominal, np.where(np.array(PARAMETERS) == "mirror_tilt_y_rad", math.radians(1.0), 0.0))
    sigma = np.array([1e-2, 1e-2, 1e-2, 2e-3, 2e-3])  # 10 mm: the vertex tells nothing of the tilt
    bundle = calibrate(nominal, PoseMeasurement(seen_place(nominal, true), np.diag(sigma**2)), sigmas=sigmas)
    about_x, about_y = (math.degrees(bundle.sigmas[f"mirror_tilt_{axis}_rad"]) for axis in "xy")
    assert about_y == pytest.approx(1.0, rel=0.1)  # the prior of half a degree draws it nearer
    assert about_x < 0.2
    assert abs(bundle.values[PARAMETERS.index("mirror_tilt_y_rad")]) < math.radians(0.05)


@pytest.mark.slow
def test_accuracy_of_moments_given_an_ellipse() -> None:
    """Mean and covariance of all parameters against weighted draws, with errors of vertex and ellipse correlated.

    3000 draws of the fit without the ellipse, weighted by the ellipse of each, leave some 700. The standard error of a
    weighted mean m is sqrt(sum w^2 (x - m)^2), that of a deviation s is sqrt(sum w^2 ((x - m)^2 - s^2)^2) / (2 s): few
    draws with large weights count by themselves. Means are within 5 of them, false alarms 2e-5. Deviations may differ
    by 10 % more: the fit's moments are linear in the deviations, the draws' outlines are not. 16 000 draws found its
    deviations to be 0.935 to 1.091 of theirs, +-0.011. The draws come by Cholesky's factor, which is unique:
    eigenvectors are not, and gave other draws on other processors.
    """
    nominal, rng, sigmas = nominal_of("hyperboloid"), generator("moments"), prior_sigmas(DRAWN)
    true = changed_rig(nominal, rng.normal(0.0, sigmas))
    sigma, mixed = np.array([2e-4, 2e-4, 5e-4, 0.01, 0.01]), np.eye(5)
    mixed[0, 3] = mixed[3, 0] = 0.8
    C = mixed * np.outer(sigma, sigma)
    place = seen_place(nominal, true) + np.array([1e-4, 0.0, 0.0, 0.006, 0.004])
    found = calibrate(nominal, PoseMeasurement(place, C), sigmas=sigmas)
    wide = C.copy()
    wide[3:], wide[:, 3:] = 0.0, 0.0
    wide[3, 3] = wide[4, 4] = 1e4
    without = calibrate(nominal, PoseMeasurement(place, wide), sigmas=sigmas)
    free = np.flatnonzero(sigmas)
    draws = np.tile(without.values, (3000, 1))
    draws[:, free] = rng.multivariate_normal(
        without.values[free], without.covariance[np.ix_(free, free)], 3000, method="cholesky"
    )
    off = np.array([apparent_outline(nominal, changed_rig(nominal, draw)) for draw in draws]) - place
    B = np.linalg.solve(C[:3, :3], C[:3, 3:]).T
    left = off[:, 3:] - off[:, :3] @ B.T
    weight = np.exp(-0.5 * np.sum(left * np.linalg.solve(C[3:, 3:] - B @ C[:3, 3:], left.T).T, axis=1))
    weight /= weight.sum()
    mean = weight @ draws[:, free]
    spread = np.sqrt(weight @ (draws[:, free] - mean) ** 2)
    count = 1.0 / np.sum(weight**2)
    ratio = np.sqrt(np.diag(found.covariance)[free]) / spread
    print(f"{count:.0f} draws count; sigmas over theirs {ratio.min():.3f} to {ratio.max():.3f}")
    assert count > 300
    apart = draws[:, free] - mean
    of_mean = np.sqrt(weight**2 @ apart**2)
    of_ratio = np.sqrt(weight**2 @ (apart**2 - spread**2) ** 2) / (2.0 * spread**2)
    assert of_ratio.max() < 0.1  # or nothing is shown
    assert (np.abs(found.values[free] - mean) < 5.0 * of_mean).all()
    assert (np.abs(ratio - 1.0) < 0.1 + 5.0 * of_ratio).all()
    turns = [PARAMETERS.index(f"mirror_tilt_{axis}_rad") for axis in "xy"]
    before = np.sqrt(np.diag(without.covariance)[turns])
    assert (np.sqrt(np.diag(found.covariance)[turns]) < 0.95 * before).any()  # the ellipse told something
