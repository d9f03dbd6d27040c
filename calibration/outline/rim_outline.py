"""Mirror of revolution from the image of its contour: vertex, and what the rim's ellipse has besides.

1. Circles with edges all around are looked for in the picture (`ball_circle`), and the place of a contour through each.
2. From there the light across the contour is fitted (`rim_fit`), sector by sector, robustly. JPEG's effect is simulated
   from the frame itself, and the covariance comes from the scatter of the sectors, as for a sphere (`sphere_outline`).
3. A contour that leaves its edge, or has too few sectors with an edge, is none. Where the fit fails and the circle is
   clear, the circle is the contour, with its own, larger covariance.

The vertex holds for the nominal profile, rim, tilt and camera; `bundle` adds their errors.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.ball_circle import BallCircle, circles, refined
from phibench.calibration.outline.contour import (
    PLACES,
    Contour,
    contour_of,
    place_of_outline,
    place_of_rig,
)
from phibench.calibration.outline.edge_ring import CURVES, TURN_RAD, TURNS
from phibench.calibration.outline.limb_image import Plane, binned, planes_of
from phibench.calibration.outline.outline_fit import OutlinePixels, Step, pixels_near
from phibench.calibration.outline.outline_result import (
    SECTORS,
    Outline,
    binned_rig,
    require_near,
    require_size,
    shared_px2,
    without_jpeg,
)
from phibench.calibration.outline.outline_start import grey, radii_px
from phibench.calibration.outline.rim_fit import rim_step, sector_sigmas_px
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

# of the band of pixels: in the end, at the start, and to compare with
_HALF_PX, _COARSE_HALF_PX, _NARROW_PX = 5.0, 8.0, 3.5
_LEAST_GAIN = 0.1  # of a variance: by a band of 5 px over one of 3.5 px
_COARSE_STEPS, _CHOOSE, _STEPS = 8, 3, 24  # of the start, those that choose pixels anew, and of the fit
# steps at which the start ends, and at which the fit has come to rest: whichever of the two is longer
_NEAR_M, _REST_M, _REST_SIGMAS = 5e-5, 1e-7, 0.05
_LARGEST_MOVE_M, _LARGEST_ELLIPSE_PX = 3e-3, 3.0  # of a step: beyond it the light is not linear in the place
_BLUR_RANGE_PX2 = (0.02, 9.0)  # of the lens: sharper than a pixel, and three pixels
_MIN_ARC, _MIN_USED = 0.5, 0.2
_RIM_FLOOR_PX = 0.2  # of an edge's place, all around, besides its scatter
_EDGE_SIGMA_PX = 0.25  # of a sector that has an edge
_LEAST_CONTRAST, _MOST_TRIED, _MOST_OFF = 9.0, 4, 0.06
_NEAR_RADII = (0.95, 1.05)
_RADII = (0.7, 1.4)  # of `radii_px`
_FEW, _CANDIDATES = 6, 12
_BINNED_PX = 1000


def find_rim_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
    """Vertex of a mirror of revolution from an image of it, from scratch.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Nominal.
    card : SensorCard, optional

    Raises
    ------
    ImageError
        For an image without a mirror, or with less than half of its contour.
    """
    planes = planes_of(image, card)
    require_size(planes[0].values, rig.camera)
    again = (image, card) if card and card.output == "mjpeg" else None
    block = max(max(rig.camera.width_px, rig.camera.height_px) // _BINNED_PX, 1)
    small = (planes, rig) if block == 1 else (binned(planes, block), binned_rig(rig, block))
    low, high = radii_px(rig)
    fault = ImageError("an image without a mirror: no circle of the rim's size has edges all around")
    picture = grey(planes)
    for place, circle in _clearest(picture, rig):
        try:
            outline = fit_rim(*small, place, again=again if block == 1 else None)
            if block > 1:  # the last refinement alone sees all pixels
                start = np.concatenate([outline.sphere_in_camera_m, block * np.array(outline.ellipse_px)])
                outline = fit_rim(planes, rig, start, again=again, near=True)
            require_near(outline.rig(rig), circle)
            return outline
        except ImageError as error:
            fault = error if "without a mirror" in str(fault) else fault
        if by_edge := _by_edge(rig, picture, circle):
            return by_edge
    if "without a mirror" not in str(fault):
        raise fault
    raise ImageError(
        f"{fault}; looked for was a rim with a radius of {low:.0f} to {high:.0f} px, as the rig's focal length, rim "
        "and distance say: check these numbers, too"
    )


def fit_rim(
    planes: tuple[Plane, ...],
    rig: Rig,
    start: Array,
    again: tuple[NDArray[Any], SensorCard] | None = None,
    near: bool = False,
) -> Outline:
    """As `find_rim_outline`, from a place within some pixels of the contour, or `near` it, within some tenths.

    `again` is frame and card of a JPEG frame.
    """
    place, blur = np.asarray(start, float), rig.camera.blur_sigma_px**2
    place = place if near else _approach(planes, rig, place, blur)
    arc = _visible_arc(rig.camera, _contour(rig, place))
    if arc < _MIN_ARC:
        raise ImageError(
            f"a mirror cut by the frame: {100.0 * arc:.0f} % of its rim lie in the image, {100.0 * _MIN_ARC:.0f} % are "
            "needed; move the camera away from the mirror or centre it"
        )
    return _settle(planes, rig, place, blur, again, arc)


def _clearest(picture: Array, rig: Rig) -> list[tuple[Array, BallCircle]]:
    """Places and circles that a picture may show, at most `_MOST_TRIED`: those at about the rig's distance first."""
    low, high = radii_px(rig)
    near = (low * _NEAR_RADII[0] / _RADII[0], high * _NEAR_RADII[1] / _RADII[1])
    starts: list[tuple[bool, float, Array, BallCircle]] = []
    for radii, count in ((near, _FEW), ((low, high), _CANDIDATES)):
        for circle in circles(picture, radii, count):
            if circle.contrast < _LEAST_CONTRAST:
                continue
            try:
                place = place_of_outline(rig, circle.points_px, _start(rig, circle), ellipse=False)
            except SceneError:  # no rig has such a contour
                continue
            starts.append((not _as_far(rig, place), -circle.contrast, place, circle))
        if any(not far for far, *_ in starts):
            break
    return [one[2:] for one in sorted(starts, key=lambda one: one[:2])[:_MOST_TRIED]]


def _start(rig: Rig, circle: BallCircle) -> Array:
    """Place with about this circle: the rig's own, as far away as the radius says, along the ray of the centre."""
    u, v, radius = circle.circle_px
    own = place_of_rig(rig)
    points = rig.outline_px(TURNS)
    nominal_px = 0.5 * float(np.ptp(points, axis=0).mean())
    depth = own[2] * nominal_px / radius
    middle = points.mean(axis=0)
    shift = (np.array([u, v]) - middle) / np.array([rig.camera.fx_px, rig.camera.fy_px]) * depth
    return np.concatenate([own[:2] * depth / own[2] + shift, [depth, 0.0, 0.0]])


def _as_far(rig: Rig, place: Array) -> bool:
    expected = rig.sphere_in_camera_m[2]
    return abs(float(place[2]) - expected) <= _MOST_OFF * expected


def _visible_arc(camera: Camera, contour: Contour) -> float:
    low, high = _HALF_PX - 0.5, np.array([camera.width_px, camera.height_px]) - 0.5 - _HALF_PX
    return float(np.mean(np.all((contour.points_px() >= low) & (contour.points_px() <= high), axis=-1)))


def _contour(rig: Rig, place: Array) -> Contour:
    try:
        return contour_of(rig, place)
    except SceneError as error:
        raise ImageError(f"an image without a mirror: {error}") from error


def _pixels(planes: tuple[Plane, ...], rig: Rig, contour: Contour, half_px: float) -> OutlinePixels:
    return pixels_near(planes, rig.camera, contour.points_px(), half_px, lambda rays: contour.place_of(rays).d_px)


def _approach(planes: tuple[Plane, ...], rig: Rig, place: Array, blur: float) -> Array:
    """Come near with a wide band, whose pixels are chosen anew at every step, without the ellipse."""
    for _ in range(_COARSE_STEPS):
        contour = _contour(rig, place)
        pixels = _pixels(planes, rig, contour, _COARSE_HALF_PX)
        step = rim_step(pixels, planes, rig, contour, blur, SECTORS // 2, _COARSE_HALF_PX)
        place = _moved(place, np.append(step.move[:3], [0.0, 0.0]))
        if np.all(np.abs(step.move[:3]) < _NEAR_M):
            break
    return place


def _settle(
    planes: tuple[Plane, ...],
    rig: Rig,
    place: Array,
    blur: float,
    again: tuple[NDArray[Any], SensorCard] | None,
    arc: float,
) -> Outline:
    for count in range(1, _STEPS + 1):
        contour = _contour(rig, place)
        if count <= _CHOOSE:  # later the pixels stay, so that the steps come to rest
            pixels = _pixels(planes, rig, contour, _HALF_PX)
        step = rim_step(pixels, planes, rig, contour, blur, SECTORS, _HALF_PX, near=True)
        # after six steps shorter ones: a fit that goes round in circles comes to rest
        move = step.move * min(1.0, 6.0 / count)
        sigma = np.sqrt(np.diag(step.covariance)[:PLACES]) if count >= _CHOOSE else np.zeros(PLACES)
        if count >= _CHOOSE and np.all(np.abs(move[:3]) < np.maximum(_REST_M, _REST_SIGMAS * sigma[:3])):
            break
        place = _moved(place, move[:PLACES])
        blur = float(np.clip(blur + move[PLACES], *_BLUR_RANGE_PX2))
    else:
        if np.any(np.abs(move[:3]) > np.maximum(1e-6, sigma[:3])):  # a step of a sigma or a micrometre is good enough
            raise ImageError("an image without a mirror: the fit of the rim does not come to rest")
    _require_edges(step, arc)
    change, covariance = (step.move, step.covariance) if again is None else without_jpeg(pixels, step, *again)
    place, blur = _moved(place, change[:PLACES]), float(np.clip(blur + change[PLACES], *_BLUR_RANGE_PX2))
    left = pixels.y - step.model
    with np.errstate(invalid="ignore"):
        clear = sector_sigmas_px(step) < _EDGE_SIGMA_PX
    shifts = np.where(clear, step.solution.sector_shifts(left), np.nan)
    by_curve = _by_curve(contour)
    shared = shared_px2(shifts, step.solution.scatter(left), again is not None)
    covariance = covariance[:PLACES, :PLACES] + shared * by_curve @ by_curve.T
    covariance = covariance + _by_band(planes, rig, contour, blur, pixels, step)
    return Outline(
        place[:3],
        covariance[:3, :3],
        float(np.mean(clear)),
        math.nan,
        blur**0.5,
        step.residual,
        len(pixels.y),
        count,
        shifts,
        ellipse_px=(float(place[3]), float(place[4])),
        covariance=covariance,
    )


def _by_band(
    planes: tuple[Plane, ...], rig: Rig, contour: Contour, blur: float, pixels: OutlinePixels, step: Step
) -> Array:
    """Covariance, shape (5, 5), by what a narrower band has otherwise.

    Where a wall ends, its edge is reflected along the rim. Within some pixels of it, the edge looks like a rim that is
    displaced, in many sectors alike, which their scatter does not show. The narrower the band, the less of it is seen.
    A narrower band has more noise, too. Of an efficient fit and another the difference has the variance of the one less
    that of the other (Hausman, Econometrica 46, 1251, 1978): only what is beyond it counts.
    """
    narrow = pixels[np.abs(contour.place_of(pixels).d_px) < _NARROW_PX]
    other = rim_step(narrow, planes, rig, contour, blur, SECTORS, _NARROW_PX, near=True)
    change = other.move[:PLACES] - step.move[:PLACES]
    own = np.diag(step.covariance)[:PLACES]
    # the scatter of either is uncertain: the difference may come out too small, or below 0
    expected = np.maximum(np.diag(other.covariance)[:PLACES] - own, _LEAST_GAIN * own)
    beyond = max(1.0 - 1.0 / float(np.mean(change**2 / expected)), 0.0)
    return np.asarray(beyond * np.outer(change, change))


def _require_edges(step: Step, arc: float) -> None:
    """Raise `ImageError` where too few sectors have an edge, or light that is described."""
    with np.errstate(invalid="ignore"):
        clear = float(np.mean(sector_sigmas_px(step) < _EDGE_SIGMA_PX))
    if clear < _MIN_USED * arc:
        raise ImageError(
            f"no edge along the mirror's rim: {100.0 * clear / arc:.0f} % of it differ clearly from what is behind it, "
            f"{100.0 * _MIN_USED:.0f} % are needed; put a sheet of another brightness above the mirror, switch lamps "
            "off, or move the robot"
        )


def _by_curve(contour: Contour) -> Array:
    """Derivatives of the place by (dr, du, dv, e1, e2) of a curve, shape (5, 5)."""
    return np.asarray(np.linalg.lstsq(contour.by_place(TURN_RAD), CURVES, rcond=None)[0])


def _by_edge(rig: Rig, picture: Array, circle: BallCircle) -> Outline | None:
    """Contour by an edge in the picture alone, if that is clear; its covariance is the circle's.

    A circle is looked for in a small picture, and inside the limb of a ball the room is squeezed into parts of a pixel.
    A rim is a plain step, whose place the whole picture tells to a part of a pixel.
    """
    try:
        circle.require_clear()
        circle = refined(picture, circle, _RIM_FLOOR_PX)
        place = place_of_outline(rig, circle.points_px, _start(rig, circle), ellipse=False)
        contour = _contour(rig, place)
    except (ImageError, SceneError):
        return None
    if _visible_arc(rig.camera, contour) < _MIN_ARC or not _as_far(rig, place):
        return None
    curve = np.diag(np.append(np.zeros(3), [circle.covariance_px2[2, 2]] * 2))
    curve[:3, :3] = circle.covariance_px2[np.ix_((2, 0, 1), (2, 0, 1))]
    J = _by_curve(contour)
    covariance = J @ curve @ J.T
    off = np.roll(circle.off_px, TURNS // 2).reshape(SECTORS, -1)
    seen = np.isfinite(off)
    shifts = np.where(seen.any(axis=1), np.nansum(off, axis=1) / np.maximum(seen.sum(axis=1), 1), np.nan)
    return Outline(
        place[:3],
        covariance[:3, :3],
        circle.edges,
        math.nan,
        math.nan,
        math.nan,
        TURNS,
        0,
        shifts,
        by_edge=True,
        ellipse_px=circle.ellipse_px,
        covariance=covariance,
    )


def _moved(place: Array, move: Array) -> Array:
    """Take a step of at most 3 mm and 3 px."""
    size = max(np.abs(move[:3]).max() / _LARGEST_MOVE_M, np.abs(move[3:]).max() / _LARGEST_ELLIPSE_PX, 1.0)
    place = place + move / size
    if not np.isfinite(place).all():
        raise ImageError("an image without a mirror: no contour of this mirror fits the light")
    return np.asarray(place)
