"""First circle of the mirror in an image: edges, Hough's transform, RANSAC, and the plain fits.

The plain fits are biased: the steepest place of the light is not the limb, because light falls inside it and not
outside. They are the start of the fit of the light across the limb, and a comparison for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy import ndimage
from skimage.feature import canny
from skimage.measure import CircleModel, EllipseModel, block_reduce, ransac
from skimage.transform import hough_circle

from phibench.estimator.calibration.limb_image import Plane
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

Circle = tuple[float, float, float]
_BLOCK_PX, _CANDIDATES = 4, 6
_RADII = (0.7, 1.4)  # of the nominal rig's outline
_LEAST_RADIUS_PX = 30.0
_TURNS = 360
_SEARCH_PX = 12
_MIN_EDGES = 60  # of `_TURNS`


def grey(planes: tuple[Plane, ...]) -> Array:
    """One picture, shape (H, W), for edges: mosaic averaged away, level 1."""
    picture = planes[0].values
    if len(planes) == 3 and planes[0].values is not planes[1].values:
        picture = np.mean([plane.values for plane in planes], axis=0)
    elif len(planes) == 3:
        picture = ndimage.convolve(picture, np.outer([1, 2, 1], [1, 2, 1]) / 16.0, mode="mirror")
    level = np.median(picture[np.isfinite(picture)]) if np.isfinite(picture).any() else 0.0
    if not level > 0.0:
        raise ImageError("an image without a mirror: it is dark")
    return np.nan_to_num(picture / level)


def rough_outlines(picture: Array, rig: Rig) -> Iterator[Array]:
    """Sphere centres in the camera frame, shape (3,), metres, to about a pixel of the outline, the likeliest first.

    Circles of tiles and lamps in the mirror may be stronger than the mirror's own; the fit of the light across them
    tells which is which.

    Raises
    ------
    ImageError
        If no circle of about the expected size is found.
    """
    found = 0
    for circle in [*hough(picture, rig), _nominal(rig)]:
        try:
            points = circle_edges(picture, circle)
        except ImageError:
            continue
        found += 1
        yield sphere_from_rays(rig.camera.rays(points), rig.mirror.radius_m)
    if not found:
        raise ImageError(
            "an image without a mirror: no circle of the outline's size has edges all around; check the picture"
        )


def radii_px(rig: Rig) -> tuple[float, float]:
    """Least and largest radius of the outline that is looked for, pixels.

    Raises
    ------
    ImageError
        If no such outline can be seen in the rig's image.
    """
    camera, radius = rig.camera, _nominal(rig)[2]
    largest = math.hypot(camera.width_px, camera.height_px)
    if not _LEAST_RADIUS_PX <= radius <= largest:
        raise ImageError(
            f"focal length, mirror radius and distance of the rig give an outline with a radius of {radius:.0f} px, in "
            f"an image of {camera.width_px} x {camera.height_px}: check these numbers, {_LEAST_RADIUS_PX:.0f} to "
            f"{largest:.0f} px can be measured"
        )
    return _RADII[0] * radius, _RADII[1] * radius


def hough(picture: Array, rig: Rig) -> list[Circle]:
    """Centre (u, v) and radius of the strongest circles, to some pixels."""
    small = block_reduce(np.log(np.clip(picture, 1e-2, 1e2)), (_BLOCK_PX, _BLOCK_PX), np.mean)  # type: ignore[no-untyped-call]
    edges = canny(small, sigma=1.5)  # type: ignore[no-untyped-call]
    low, high = radii_px(rig)
    radii = np.arange(low / _BLOCK_PX, high / _BLOCK_PX, 1.0).astype(int)
    if edges.sum() < _MIN_EDGES:
        raise ImageError("an image without a mirror: it has no edges")
    space = hough_circle(edges, radii, full_output=True)  # type: ignore[no-untyped-call]
    beyond, circles = int(radii.max()), []  # by which full_output widens the picture
    for _ in range(_CANDIDATES):
        best, v, u = (int(i) for i in np.unravel_index(int(np.argmax(space)), space.shape))
        u_px, v_px = ((x - beyond + 0.5) * _BLOCK_PX - 0.5 for x in (u, v))
        circles.append((u_px, v_px, float(radii[best]) * _BLOCK_PX))
        space[max(0, best - 2) : best + 3, max(0, v - 3) : v + 4, max(0, u - 3) : u + 4] = 0.0
    return circles


def _nominal(rig: Rig) -> Circle:
    outline = rig.outline_px()
    u, v = outline.mean(axis=0)
    return float(u), float(v), 0.5 * float(np.ptp(outline, axis=0).mean())


def circle_edges(picture: Array, circle: Circle, either: bool = False) -> Array:
    """Steepest places of the light on rays from the circle's centre, shape (n, 2), those that RANSAC keeps.

    Light rises outwards at the limb of steel before its own room; with `either` it may fall as well.
    """
    points = _steepest(picture, circle, either=either)
    if len(points) >= _MIN_EDGES:
        model, inliers = ransac(points, CircleModel, 3, 2.0, max_trials=300, rng=np.random.default_rng(0))  # type: ignore[no-untyped-call]
        if model is not None and inliers is not None and inliers.sum() >= _MIN_EDGES:
            centre, radius = np.asarray(model.center, float), float(model.radius)
            again = _steepest(picture, (centre[0], centre[1], radius), 5, either)
            off = np.abs(np.linalg.norm(again - centre, axis=-1) - radius)
            return np.asarray(again[off < 2.0]) if (off < 2.0).sum() >= _MIN_EDGES else points[inliers]
    raise ImageError("no circle has edges all around")


def plain_circle(points_px: Array) -> Circle:
    """Least-squares circle (u, v, radius) through edges, shape (n, 2), pixels."""
    model = CircleModel.from_estimate(points_px)  # type: ignore[no-untyped-call]
    return float(model.center[0]), float(model.center[1]), float(model.radius)


def sphere_from_circle(circle: Circle, camera: Camera, radius_m: float) -> Array:
    """Sphere centre as the plain circle has it: its centre's ray, and |s| = R / sin(radius / f)."""
    u, v, radius = circle
    f = np.sqrt(camera.fx_px * camera.fy_px)
    return np.asarray(camera.rays(np.array([u, v])) * radius_m / np.sin(np.arctan(radius / f)))


def sphere_from_ellipse(points_px: Array, camera: Camera, radius_m: float) -> Array:
    """Sphere centre from the least-squares ellipse through edges: the cone over it."""
    model = EllipseModel.from_estimate(points_px)  # type: ignore[no-untyped-call]
    return sphere_from_rays(camera.rays(model.predict_xy(np.linspace(0.0, 2.0 * np.pi, 360))), radius_m)


def sphere_from_rays(rays: Array, radius_m: float) -> Array:
    """Sphere centre, shape (3,), whose limb rays, shape (n, 3), are nearest: ray . s = |s| cos a0 for all of them."""
    x = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]  # x = n / cos a0
    cosine = 1.0 / np.linalg.norm(x)
    if not cosine < 1.0:
        raise ImageError("an image without a mirror: the edges found are no sphere's outline")
    return np.asarray(x * cosine * radius_m / np.sqrt((1.0 - cosine) * (1.0 + cosine)))


def _steepest(picture: Array, circle: Circle, reach_px: int = _SEARCH_PX, either: bool = False) -> Array:
    u0, v0, radius = circle
    turn = np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
    r = radius + np.arange(-reach_px - 1.0, reach_px + 1.5, 0.5)
    u, v = u0 + np.outer(np.cos(turn), r), v0 + np.outer(np.sin(turn), r)
    # mean over 5 px along the outline: the room's own edges are rarely along it
    along = [(u - k * np.sin(turn)[:, None], v + k * np.cos(turn)[:, None]) for k in (-4.0, -2.0, 0.0, 2.0, 4.0)]
    light = np.mean(
        [ndimage.map_coordinates(picture, [b, a], order=1, mode="constant", cval=np.nan) for a, b in along], axis=0
    )
    with np.errstate(all="ignore"):
        rise = np.gradient(np.log(np.clip(light, 1e-3, None)), axis=-1)
    rise = ndimage.gaussian_filter1d(np.nan_to_num(rise), 1.5, axis=-1)
    rise = np.abs(rise) if either else rise
    rise[~np.isfinite(light)] = 0.0
    best = np.argmax(rise, axis=-1)
    rows = np.arange(_TURNS)
    good = (rise[rows, best] > 0.0) & (best > 0) & (best < len(r) - 1) & np.isfinite(light).all(axis=-1)
    return np.stack([u[rows, best], v[rows, best]], axis=-1)[good]
