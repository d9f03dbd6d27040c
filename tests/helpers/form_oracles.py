"""Slow answers for a mirror with a form error, by other mathematics than the package's. Not a test file.

The surface is written with angles and associated Legendre functions; the reflection point is the minimum of the path,
found from values alone, in long double.
"""

from __future__ import annotations

import math

import numpy as np
from helpers.oracles import camera_at, project_cv2
from scipy import optimize

from phibench.scenes.form_error import HARMONICS, Form
from phibench.scenes.revolved_profile import FormedProfile
from phibench.scenes.rig import Rig

# magnitude of each polar factor's peak, from its derivative's zero
_P31 = 16.0 / (3.0 * np.sqrt(np.longdouble(15)))  # sin (5 cos^2 - 1) where sin^2 = 4/15
_P32 = 2.0 / (3.0 * np.sqrt(np.longdouble(3)))  # sin^2 cos where cos^2 = 1/3


def radius_at(n: np.ndarray, radius_m: float, form: Form) -> np.ndarray:
    """Radius in directions, shape (..., 3), long double."""
    x, y, z = np.moveaxis(n, -1, 0)
    polar, turn = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    s, c = np.sin(polar), np.cos(polar)
    waves = {
        "20": (3 * c * c - 1) / 2,
        "21": np.sin(2 * polar),
        "22": s * s,
        "30": (5 * c**3 - 3 * c) / 2,
        "31": s * (5 * c * c - 1) / _P31,
        "32": s * s * c / _P32,
        "33": s**3,
    }
    total = np.full(polar.shape, np.longdouble(radius_m))
    for name, wave in waves.items():
        order = int(name[1])
        total += np.longdouble(getattr(form, f"form_{name}{'c' if order else ''}_m")) * wave * np.cos(order * turn)
        if order:
            total += np.longdouble(getattr(form, f"form_{name}s_m")) * wave * np.sin(order * turn)
    return total


def fermat_on_form(a: np.ndarray, b: np.ndarray, radius_m: float, form: Form) -> np.ndarray:
    """Point, shape (3,), that makes |a P| + |P b| least, sphere's frame: Nelder-Mead, then Newton by differences.

    Differences of fourth order with a step h = 1e-4 rad in long double (eps 5e-20): slopes err by eps / h = 5e-16 and
    h^4 = 1e-16 of the radius, which the curvature of the path, about 2, turns into some 1e-15 rad. Newton's method
    squares what is left, 1e-3 rad of Nelder-Mead's: it is at rest after three of six steps.
    """
    a, b = (np.asarray(x).astype(np.longdouble) for x in (a, b))
    start = a / np.sqrt(a @ a) + b / np.sqrt(b @ b)

    def place(centre: np.ndarray, across: np.ndarray, x: np.ndarray) -> np.ndarray:
        n = centre + x[..., :1] * across[0] + x[..., 1:] * across[1]
        n = n / np.sqrt(np.sum(n * n, axis=-1, keepdims=True))
        return radius_at(n, radius_m, form)[..., None] * n

    def path(x: np.ndarray) -> np.ndarray:
        return _way(place(centre, across, np.asarray(x)), a, b)

    centre = start / np.sqrt(start @ start)
    across = _across(centre)
    found = optimize.minimize(lambda x: float(path(x)), np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-3})
    x = found.x.astype(np.longdouble)
    for _ in range(6):
        centre = place(centre, across, x)
        centre = centre / np.sqrt(centre @ centre)
        across, x = _across(centre), np.zeros(2, np.longdouble)
        slope, curvature = _derivatives(path)
        x = -np.linalg.solve(curvature.astype(float), slope.astype(float)).astype(np.longdouble)
    return place(centre, across, x).astype(float)


def fermat_on_disc(a: np.ndarray, b: np.ndarray, surface: FormedProfile) -> np.ndarray:
    """Point, shape (3,), that makes |a P| + |P b| least, frame of a mirror of revolution, as `fermat_on_form`.

    The search is in x and y over the rim's radius. The surface is written with Noll's sums of factorials.
    """
    a, b, rim = a.astype(np.longdouble), b.astype(np.longdouble), np.longdouble(surface.rim_radius_m)

    def place(xy: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(rim * xy, -1, 0)
        return np.stack([x, y, disc_height(x, y, surface)], axis=-1)

    def path(xy: np.ndarray) -> np.ndarray:
        return _way(place(middle + np.asarray(xy)), a, b)

    middle = np.zeros(2, np.longdouble)
    with np.errstate(invalid="ignore"):  # the search may pass the equator
        start = optimize.minimize(
            lambda x: float(path(x)), np.full(2, 1e-3), method="Nelder-Mead", options={"xatol": 1e-7}
        )
    middle = start.x.astype(np.longdouble)
    for _ in range(6):
        slope, curvature = _derivatives(path)
        middle = middle - np.linalg.solve(curvature.astype(float), slope.astype(float)).astype(np.longdouble)
    return place(middle).astype(float)


def _way(P: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a P| + |P b|, shape (...), of places (..., 3)."""
    return sum(np.sqrt(np.sum((P - end) ** 2, axis=-1)) for end in (a, b))


def disc_height(x: np.ndarray, y: np.ndarray, surface: FormedProfile) -> np.ndarray:
    """z of a mirror of revolution with a form error, shape of x and y."""
    profile, r, turn = surface.ideal, np.hypot(x, y), np.arctan2(y, x)
    R, A = np.longdouble(profile.vertex_radius_m), 1 + np.longdouble(profile.conic)
    w = np.sqrt(R * R - A * r * r)
    z, slope = r * r / (R + w), r / w
    for i, c in enumerate(profile.even_terms, start=2):
        z, slope = z + c * r ** (2 * i), slope + 2 * i * c * r ** (2 * i - 1)
    h = np.longdouble(0)
    for name in HARMONICS:
        degree, order = int(name[5]), int(name[6])
        wave = np.sin(order * turn) if "s_m" in name else np.cos(order * turn)
        h += np.longdouble(getattr(surface.form, name)) * _radial(2 * degree - order, order, r / surface.disc_m) * wave
    return z - h * np.sqrt(1 + slope * slope)


def _radial(n: int, m: int, rho: np.longdouble) -> np.longdouble:
    """Zernike's radial polynomial (R. J. Noll, J. Opt. Soc. Am. 66, 207, 1976, eq. 2)."""
    f = math.factorial
    return sum(
        (-1) ** s * f(n - s) / (f(s) * f((n + m) // 2 - s) * f((n - m) // 2 - s)) * rho ** (n - 2 * s)
        for s in range((n - m) // 2 + 1)
    )


def form_pixel(rig: Rig, offset_m: float, spot_world_m: np.ndarray) -> np.ndarray:
    """Pixel of a world point seen in the mirror of a rig, shape (2,)."""
    camera, axes = camera_at(rig, offset_m)
    centre, turned = camera + axes @ rig.T_camera_sphere.t, axes @ rig.T_camera_sphere.R
    assert rig.sphere.form is not None
    P = fermat_on_form(
        turned.T @ (camera - centre), turned.T @ (spot_world_m - centre), rig.sphere.radius_m, rig.sphere.form
    )
    return project_cv2(rig.camera, (axes.T @ (turned @ P + centre - camera))[None])[0]


def _across(n: np.ndarray) -> np.ndarray:
    """Two unit vectors across a direction, as rows."""
    first = np.cross(n, np.eye(3, dtype=np.longdouble)[np.argmin(np.abs(n))])
    first = first / np.sqrt(first @ first)
    return np.stack([first, np.cross(n, first)])


_AROUND = (-2, -1, 1, 2)


def _derivatives(f) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (2,) and second derivatives (2, 2) at 0 by five-point stencils."""
    h = np.longdouble(1e-4)
    along = [[(k, 0) for k in _AROUND], [(0, k) for k in _AROUND]]
    values = f(h * np.array([(0, 0), *along[0], *along[1], (1, 1), (1, -1), (-1, 1), (-1, -1)]))
    centre, sides, corners = values[0], values[1:9].reshape(2, 4), values[9:]
    slope, curvature = np.zeros(2, np.longdouble), np.zeros((2, 2), np.longdouble)
    for i, (far_back, back, ahead, far_ahead) in enumerate(sides):
        slope[i] = (8 * (ahead - back) - (far_ahead - far_back)) / (12 * h)
        curvature[i, i] = (ahead - 2 * centre + back) / h**2
    curvature[0, 1] = curvature[1, 0] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * h**2)
    return slope, curvature
