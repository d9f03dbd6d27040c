"""Where the sphere is, from the image of its outline.

The outline of a sphere under a pinhole is the cone of rays with the angle a0 = asin(R / |s|) from s. `limb` gives the
light across it; its level, and its slope along and across the limb, are free in every sector of the outline, and so is
the blur. What is left is the centre s: Gauss-Newton with robust weights. The covariance is a sandwich over sectors,
with the correlation of neighbours, because the room behind the limb and JPEG's blocks err over many pixels together.

R and |s| scale together: the outline is that of every sphere with the same R / |s|. s is as wrong as R is:
ds / s = dR / R. The camera's numbers are taken as exact, too; `bundle` puts their errors in.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.calibration.limb import Limb, limb_angle_rad, limb_of
from phibench.estimator.calibration.limb_image import ImageError, Plane, planes_of
from phibench.estimator.calibration.outline_start import grey, rough_outline
from phibench.estimator.calibration.sectors import Sectors, sandwich
from phibench.estimator.reflection import ray_jacobian
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

HALF_WIDTH_PX = 3.0
SECTORS = 120
MIN_ARC = 0.5
"""Part of the outline that must lie in the image."""
_COARSE_HALF_PX, _COARSE_STEPS = 8.0, 6
_STEPS, _REST_M = 25, 1e-8
_MIN_CONTRAST, _MAX_CONTRAST = 0.5, 1.6
_BLUR_RANGE_PX2 = (0.02, 9.0)


@dataclass(frozen=True)
class Outline:
    """What the outline says.

    Attributes
    ----------
    sphere_in_camera_m : shape (3,), s
    covariance_m2 : shape (3, 3)
        For radius and camera as believed.
    arc : float
        Part of the outline that was used.
    contrast : float
        Fall of the light inside the limb over what the steel's reflectance gives; 1 for this mirror.
    blur_px : float
        Standard deviation of the lens's blur that was found.
    residual : float
        Robust standard deviation of the residuals over the light.
    pixels, steps : int
    """

    sphere_in_camera_m: Array
    covariance_m2: Array = field(repr=False)
    arc: float
    contrast: float
    blur_px: float
    residual: float
    pixels: int
    steps: int

    @property
    def sigma_m(self) -> Array:
        """Standard deviations of s, shape (3,)."""
        return np.sqrt(np.diag(self.covariance_m2))

    def rig(self, believed: Rig) -> Rig:
        """The believed rig with the sphere where its outline is."""
        pose = replace(believed.T_camera_sphere, translation_m=as_vector(self.sphere_in_camera_m))
        return replace(believed, T_camera_sphere=pose)


@dataclass(frozen=True)
class _Rays:
    """Pixels around the outline; rows belong together."""

    plane: NDArray[np.int64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    ray: Array
    by_pixel: Array  # d ray / d (u, v), shape (N, 3, 2)
    y: Array

    def __getitem__(self, keep: NDArray[Any]) -> _Rays:
        return _Rays(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class _Place:
    """Distance from the limb of every pixel, its gradients, and where along the limb it is."""

    d_px: Array
    by_s: Array  # (N, 3), pixels per metre
    by_uv: Array  # (N, 2), unit vectors
    turn_rad: Array


def find_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
    """Sphere centre from an image of the mirror, from scratch.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Believed: its camera, radius, steel and blur are used; the outline is looked for with 0.7 to 1.4 times the
        radius that the rig gives it, anywhere in the image.
    card : SensorCard, optional
        Of the image's preset; none for a layer.

    Raises
    ------
    ImageError
        For an image without a mirror, or with less than half of its outline.
    """
    planes = planes_of(image, card)
    _require_size(planes[0].values, rig.camera)
    return fit_outline(planes, rig, rough_outline(grey(planes), rig))


def fit_outline(planes: tuple[Plane, ...], rig: Rig, start_m: Array, half_px: float = HALF_WIDTH_PX) -> Outline:
    """As `find_outline`, from a start within some pixels of the outline."""
    s, blur = np.asarray(start_m, float), rig.camera.blur_sigma_px**2
    s = _approach(planes, rig, s, blur)
    arc = visible_arc(rig, s, half_px)
    if arc < MIN_ARC:
        raise ImageError(
            f"a mirror cut by the frame: {100.0 * arc:.0f} % of its outline lie in the image, {100.0 * MIN_ARC:.0f} % "
            "are needed; move the camera away from the mirror or centre it"
        )
    return _settle(planes, rig, s, blur, half_px)


def visible_arc(rig: Rig, s: Array, margin_px: float = 0.0) -> float:
    """Part of the outline of a sphere at `s` that lies in the image, `margin_px` inside its border."""
    moved = replace(rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(s)))
    uv, camera = moved.outline_px(), rig.camera
    low, high = margin_px - 0.5, np.array([camera.width_px, camera.height_px]) - 0.5 - margin_px
    return float(np.mean(np.all((uv >= low) & (uv <= high), axis=-1)))


def _approach(planes: tuple[Plane, ...], rig: Rig, s: Array, blur: float) -> Array:
    """Come near with a wide band, whose pixels are chosen anew at every step."""
    for _ in range(_COARSE_STEPS):
        rays = _band(planes, rig.camera, s, rig.mirror.radius_m, _COARSE_HALF_PX)
        step = _Step.at(rays, planes, rig, s, blur, SECTORS // 2, _COARSE_HALF_PX)
        s = _moved(s, step.move[:3], rig)
    return s


def _settle(planes: tuple[Plane, ...], rig: Rig, s: Array, blur: float, half_px: float) -> Outline:
    rays = None
    for count in range(1, _STEPS + 1):
        if rays is None or count <= 4:  # later the pixels stay, so that the steps come to rest
            rays = _band(planes, rig.camera, s, rig.mirror.radius_m, half_px)
        step = _Step.at(rays, planes, rig, s, blur, SECTORS, half_px)
        s, blur = _moved(s, step.move[:3], rig), float(np.clip(blur + step.move[3], *_BLUR_RANGE_PX2))
        if count > 4 and np.abs(step.move[:3]).max() < _REST_M:
            break
    else:
        raise ImageError("an image without a mirror: the fit of the outline does not come to rest")
    if not _MIN_CONTRAST < step.contrast < _MAX_CONTRAST:
        raise ImageError(
            f"an image without a mirror: across the outline found, the light falls by {step.contrast:.2f} times what "
            f"polished steel gives; allowed is {_MIN_CONTRAST} to {_MAX_CONTRAST}"
        )
    arc = step.sectors_used / SECTORS
    return Outline(s, step.covariance[:3, :3], arc, step.contrast, blur**0.5, step.residual, len(rays.y), count)


def _moved(s: Array, move: Array, rig: Rig) -> Array:
    """Take a step of at most 3 mm; a centre that runs away is no mirror's."""
    s = s + move * min(1.0, 3e-3 / max(float(np.abs(move).max()), 1e-12))
    if not (np.isfinite(s).all() and s[2] > 1.02 * rig.mirror.radius_m):
        raise ImageError("an image without a mirror: no outline of a sphere fits the light")
    return s


@dataclass(frozen=True)
class _Step:
    """One Gauss-Newton step: (x, y, z of s, blur variance), and what is known there."""

    move: Array
    covariance: Array
    contrast: float
    residual: float
    sectors_used: int

    @classmethod
    def at(
        cls, rays: _Rays, planes: tuple[Plane, ...], rig: Rig, s: Array, blur: float, sectors: int, half_px: float
    ) -> _Step:
        place, limb = _place(rays, s, rig.mirror.radius_m), limb_of(rig, s, blur)
        light, slope, curvature = _through_taps(rays, planes, limb, place)
        where = Sectors.of(rays.plane, place.turn_rad, sectors)
        fine = where.offset
        fit = where.fit(rays.y, np.stack([light, light * fine, light * place.d_px / half_px], axis=-1))
        level = fit.model / light
        by_parameters = np.concatenate([place.by_s * slope[:, None], 0.5 * curvature[:, None]], axis=-1)
        J = fit.without_nuisance(by_parameters * level[:, None])
        A = J.T @ (fit.weight[:, None] * J)
        if not np.isfinite(A).all() or np.linalg.matrix_rank(A) < A.shape[0]:
            raise ImageError("an image without a mirror: there is no light across the outline")
        move = np.linalg.solve(A, J.T @ (fit.weight * fit.residual))
        scores = where.summed(J * (fit.weight * fit.residual)[:, None])
        contrast = _contrast(where, rays.y, light, place.d_px / half_px)
        used = int(np.any(scores != 0.0, axis=-1).sum())
        return cls(move, sandwich(A, scores), contrast, fit.relative_residual, used)


def _contrast(where: Sectors, y: Array, light: Array, d: Array) -> float:
    """Median over sectors of the steel's fall of light, in units of itself, with level and slope free."""
    fit = where.fit(y, np.stack([np.ones_like(y), d, light - 1.0], axis=-1))
    with np.errstate(all="ignore"):
        ratio = fit.coefficients[:, 2] / fit.coefficients[:, 0]
    good = ratio[np.isfinite(ratio)]
    return float(np.median(good)) if good.size else 0.0


def _band(planes: tuple[Plane, ...], camera: Camera, s: Array, radius_m: float, half_px: float) -> _Rays:
    """Usable pixels within `half_px` of the outline."""
    height, width = planes[0].values.shape
    v, u = np.mgrid[:height, :width]
    ring = _ring(camera, s, radius_m, half_px, (height, width))
    u, v = u[ring], v[ring]
    uv = np.stack([u, v], axis=-1).astype(float)
    ray, by_pixel = camera.rays(uv), ray_jacobian(camera, uv)
    near = np.abs(_place_of(ray, by_pixel, s, radius_m).d_px) < half_px
    inside = (u >= 2) & (v >= 2) & (u < width - 2) & (v < height - 2)
    parts = []
    for number, plane in enumerate(planes):
        keep = near & inside & plane.usable[v, u]
        y = plane.values[v[keep], u[keep]]
        parts.append(_Rays(np.full(y.size, number), u[keep], v[keep], ray[keep], by_pixel[keep], y))
    return _Rays(*(np.concatenate([getattr(p, name) for p in parts]) for name in _Rays.__dataclass_fields__))


def _ring(camera: Camera, s: Array, radius_m: float, half_px: float, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels that may be within `half_px`, by a mask around the outline's pixels: quick, and distorted as the lens."""
    mark = Rig(camera=camera)
    uv = replace(
        mark,
        mirror=replace(mark.mirror, radius_m=radius_m),
        T_camera_sphere=replace(mark.T_camera_sphere, translation_m=as_vector(s)),
    ).outline_px(4000)
    mask = np.zeros(size, bool)
    cells = np.rint(uv).astype(int)
    good = np.all((cells >= 0) & (cells < np.array(size)[::-1]), axis=-1)
    mask[cells[good, 1], cells[good, 0]] = True
    return np.asarray(ndimage.distance_transform_edt(~mask) < half_px + 2.5)


def _place(rays: _Rays, s: Array, radius_m: float) -> _Place:
    return _place_of(rays.ray, rays.by_pixel, s, radius_m)


def _place_of(ray: Array, by_pixel: Array, s: Array, radius_m: float) -> _Place:
    """With n = s / |s| and cos a = ray . n: d a = -n . d ray / sin a, and d a / d s = -(ray - n cos a) / (|s| sin a)."""
    distance = float(np.linalg.norm(s))
    n, a0 = s / distance, limb_angle_rad(s, radius_m)
    across = ray - (ray @ n)[:, None] * n
    sine = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(sine, ray @ n)
    by_uv = -np.einsum("i,nij->nj", n, by_pixel) / sine[:, None]
    scale = 1.0 / np.linalg.norm(by_uv, axis=-1)  # pixels per radian across the limb
    by_s = -across / (sine * distance)[:, None] + np.tan(a0) * n / distance
    turn = np.arctan2(across[:, 1], across[:, 0])
    return _Place((angle - a0) * scale, by_s * scale[:, None], by_uv * scale[:, None], turn)


def _through_taps(rays: _Rays, planes: tuple[Plane, ...], limb: Limb, place: _Place) -> tuple[Array, Array, Array]:
    """Light, slope and curvature for every pixel, summed over its taps."""
    sums = np.zeros((3, rays.y.size))
    parity = 2 * (rays.v % 2) + rays.u % 2
    for number, plane in enumerate(planes):
        for kind in range(4):
            rows = np.flatnonzero((rays.plane == number) & (parity == kind))
            for tap in plane.taps[kind]:
                d = place.d_px[rows] + place.by_uv[rows] @ np.array([tap.du_px, tap.dv_px], float)
                for k, table in enumerate((limb.light, limb.slope_per_px, limb.curvature_per_px2)):
                    sums[k, rows] += tap.weight * limb.at(table, tap.filter_index, d)
    return sums[0], sums[1], sums[2]


def _require_size(image: Array, camera: Camera) -> None:
    if image.shape != (camera.height_px, camera.width_px):
        raise ImageError(
            f"an image of {image.shape[1]} x {image.shape[0]} pixels for a camera of {camera.width_px} x "
            f"{camera.height_px}: give a whole frame of this camera"
        )
