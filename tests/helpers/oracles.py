"""Slow answers by other mathematics than the package's: Fermat's path, Alhazen's quartic, OpenCV.

Not a test file. Lengths in metres, pixels (u, v) at integer pixel centres.
"""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import cv2
import numpy as np
from scipy import optimize

from phibench.estimator.geometry.paper_depth import Published, load_published
from phibench.scenes.camera import Camera
from phibench.scenes.rig import Rig
from phibench.scenes.room import TargetBoard

# depth_m -> azimuth in degrees: one board per depth of the paper
AZIMUTH_DEG = {1.0: 200, 1.975: 100, 2.18: 150, 2.95: 250, 3.18: 310, 3.97: 20, 4.18: 60}
TARGETS = tuple(TargetBoard(f"d{d:.3f}", d, math.radians(a), 0.50) for d, a in AZIMUTH_DEG.items())


def paper_cases() -> list[tuple[Published, np.ndarray]]:
    """The paper's 25 experiments with the world position of their spots."""
    places = {target.depth_m: np.array(target.position_world_m) for target in TARGETS}
    return [(row, places[row.real_depth_m]) for row in load_published()]


# -- reflection points: a and b are the two end points, the sphere's centre is the origin ------------------------


def alhazen_quartic(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Reflection point, shape (3,), from the roots of Alhazen's quartic in the plane of a, b and the centre.

    With the circle scaled to |z| = 1 and a, b complex: conj(ab) z^4 - conj(a + b) z^3 + (a + b) z - ab = 0, which is
    (a - z)(b - z) / z^2 being real. Polished by Newton steps in long double, so good to about 1e-18.
    """
    (A, B), basis = _plane(a, b, radius)
    c = np.array([np.conj(A * B), -np.conj(A + B), 0.0, A + B, -A * B], np.clongdouble)
    roots = np.roots(c.astype(complex)).astype(np.clongdouble)
    for _ in range(5):
        roots = roots - np.polyval(c, roots) / np.polyval(np.polyder(c), roots)
    lit = [z for z in roots if abs(abs(z) - 1) < 1e-9 and _outside(A, z) and _outside(B, z)]
    assert len(lit) == 1, f"{len(lit)} roots face both points"
    z = lit[0]
    return (radius * (z.real * basis[0] + z.imag * basis[1])).astype(float)


def fermat_path(a: np.ndarray, b: np.ndarray, radius: float, digits: int = 60) -> np.ndarray:
    """Reflection point, shape (3,), as the minimum of |a P| + |P b| by golden-section search in decimal arithmetic.

    The position of a minimum is known to the square root of the arithmetic's precision: 1e-30 here. The circle is
    parametrised by the tangent t of the half angle, x = (1 - t^2)/(1 + t^2), y = 2 t/(1 + t^2), so no sine is needed.
    The search interval is the arc that faces both points, where both distances are convex.
    """
    (A, B), basis = _plane(a, b, radius)
    A, B = complex(A), complex(B)  # A lies on the real axis
    low = max(0.0, np.angle(B) - math.acos(1.0 / abs(B)))
    high = min(float(np.angle(B)), math.acos(1.0 / abs(A)))
    with localcontext() as context:
        context.prec = digits
        ax, bx, by = Decimal(A.real), Decimal(B.real), Decimal(B.imag)

        def path(t: Decimal) -> Decimal:
            x, y = (1 - t * t) / (1 + t * t), 2 * t / (1 + t * t)
            return ((x - ax) ** 2 + y * y).sqrt() + ((x - bx) ** 2 + (y - by) ** 2).sqrt()

        t = _golden(path, Decimal(math.tan(low / 2)), Decimal(math.tan(high / 2)), Decimal("1e-25"))
        x, y = float((1 - t * t) / (1 + t * t)), float(2 * t / (1 + t * t))
    return radius * (x * basis[0].astype(float) + y * basis[1].astype(float))


def fermat_on_sphere(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Reflection point, shape (3,), by minimising over the whole sphere (no plane assumed); good to about 1e-7 rad."""
    start = a / np.linalg.norm(a) + b / np.linalg.norm(b)

    def point(x: np.ndarray) -> np.ndarray:
        return radius * (start + x) / np.linalg.norm(start + x)

    def path(x: np.ndarray) -> float:
        return float(np.linalg.norm(point(x) - a) + np.linalg.norm(point(x) - b))

    result = optimize.minimize(path, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-17})
    return point(result.x)


def _plane(a: np.ndarray, b: np.ndarray, radius: float) -> tuple[tuple, tuple[np.ndarray, np.ndarray]]:
    """Points as complex numbers in units of the radius, a on the real axis, and the basis, in long double."""
    a, b = (np.asarray(x).astype(np.longdouble) for x in (a, b))
    e1 = a / np.sqrt(a @ a)
    e2 = b - (b @ e1) * e1
    e2 = e2 / np.sqrt(e2 @ e2)
    flat = tuple(np.clongdouble(complex(0)) + (p @ e1) / radius + 1j * (p @ e2) / radius for p in (a, b))
    return flat, (e1, e2)


def _outside(point: complex, z: complex) -> bool:
    return ((point - z) * np.conj(z)).real > 0


def _golden(f, low: Decimal, high: Decimal, tolerance: Decimal) -> Decimal:
    ratio = (Decimal(5).sqrt() - 1) / 2
    x1, x2 = high - ratio * (high - low), low + ratio * (high - low)
    f1, f2 = f(x1), f(x2)
    while high - low > tolerance:
        if f1 < f2:
            high, x2, f2 = x2, x1, f1
            x1 = high - ratio * (high - low)
            f1 = f(x1)
        else:
            low, x1, f1 = x1, x2, f2
            x2 = low + ratio * (high - low)
            f2 = f(x2)
    return (low + high) / 2


# -- cameras -----------------------------------------------------------------------------------------------------


def camera_matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])


def distortion(camera: Camera) -> np.ndarray:
    """Coefficients in OpenCV's order."""
    return np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])


def project_cv2(camera: Camera, points_camera_m: np.ndarray) -> np.ndarray:
    """Pixels, shape (N, 2), of points (N, 3) in the camera frame, by OpenCV."""
    zero = np.zeros(3)
    pixels, _ = cv2.projectPoints(
        points_camera_m.reshape(-1, 1, 3), zero, zero, camera_matrix(camera), distortion(camera)
    )
    return pixels.reshape(-1, 2)


def undistort_cv2(camera: Camera, uv_px: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates, shape (N, 2), of pixels (N, 2), by OpenCV."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    solve = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4 and 5
    xy = solve(uv_px.reshape(-1, 1, 2), camera_matrix(camera), distortion(camera), R=None, P=None, criteria=criteria)
    return xy.reshape(-1, 2)


# -- spots in images ---------------------------------------------------------------------------------------------


def camera_at(rig: Rig, offset_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Lens centre, shape (3,), and camera axes as columns, shape (3, 3), with the motion at every offset but 0."""
    centre, axes = rig.T_world_camera.t + offset_m * np.array(rig.stroke_axis_world), rig.T_world_camera.R
    if rig.motion is None or offset_m == 0.0:
        return centre, axes
    return centre + rig.motion.translation_m, np.array(rig.motion.rotation) @ axes


def true_reflection(rig: Rig, offset_m: float, spot_world_m: np.ndarray, solve=alhazen_quartic) -> np.ndarray:
    """Reflection point in the world, shape (3,)."""
    camera, axes = camera_at(rig, offset_m)
    centre = camera + axes @ rig.T_camera_sphere.t
    return centre + solve(camera - centre, spot_world_m - centre, rig.sphere.radius_m)


def true_pixel(rig: Rig, offset_m: float, spot_world_m: np.ndarray, solve=alhazen_quartic) -> np.ndarray:
    """Pixel of a world point seen in the mirror, shape (2,)."""
    P = true_reflection(rig, offset_m, spot_world_m, solve)
    camera, axes = camera_at(rig, offset_m)
    return project_cv2(rig.camera, (axes.T @ (P - camera))[None])[0]


def random_rig(rng: np.random.Generator) -> Rig:
    """A misaligned rig with distortion: tilt to 3 deg, decentre to 10 mm, z_c 0.25 to 0.6 m, stroke axis to 2 deg."""
    from phibench.scenes.frames import Pose, rotation_xyz

    tilt = rng.uniform(-0.05, 0.05, 3)
    camera = Camera(k1=-0.026, k2=1.06, k3=-3.40, p1=rng.uniform(-1e-3, 1e-3), p2=rng.uniform(-1e-3, 1e-3))
    sphere = (rng.uniform(-0.01, 0.01), rng.uniform(-0.01, 0.01), rng.uniform(0.25, 0.6))
    return Rig(
        camera=camera,
        T_world_camera=Pose("world", "camera", (0.02, -0.01, rng.uniform(0.4, 0.6)), rotation_xyz(*tilt)),
        T_camera_sphere=Pose("camera", "sphere", sphere),
        stroke_axis_world=(rng.uniform(-0.035, 0.035), rng.uniform(-0.035, 0.035), 1.0),
    )


def random_spot(rng: np.random.Generator) -> np.ndarray:
    """A world point 0.8 to 5 m from the axis, 0.1 to 2 m above the floor."""
    depth, azimuth = rng.uniform(0.8, 5.0), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([depth * np.cos(azimuth), depth * np.sin(azimuth), rng.uniform(0.1, 2.0)])
