"""Sphere centre from the image of the mirror's outline.

The outline of a sphere under a pinhole is the cone of pixels with the angle a0 = asin(R / |s|) from s. `limb_image`
gives the light across it. Its level, its slopes along and across the limb, and the blur are free in the fit. What is
left is the centre s: Gauss-Newton with robust weights, sector by sector.

* Sectors whose light the model does not describe (lamps, edges of the room) are left out, with their neighbours.
* The covariance comes from the scatter of the sectors' shifts, with the correlation of neighbours: the room and JPEG's
  blocks err over many pixels together.
* The effect of JPEG on the limb is simulated from the frame itself (`outline_result`).
* Where the light is not as the model has it, in other mirrors or among lamps, the edge in the picture is the outline
  (`ball_circle`), with its own, larger covariance; so it is where the fit leaves that edge.

R and |s| scale together: the outline is that of every sphere with the same R / |s|, so that ds / s = dR / R. Radius and
camera count as exact here; `bundle` adds their errors.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.calibration.outline.ball_circle import BallCircle, on_limb
from phibench.calibration.outline.edge_ring import TURNS
from phibench.calibration.outline.limb_image import Plane, binned, full_pixels, limb_angle_rad, planes_of
from phibench.calibration.outline.outline_fit import band, step_from
from phibench.calibration.outline.outline_result import (
    SECTORS,
    Outline,
    binned_rig,
    require_near,
    require_size,
    require_unlit,
    shared_px2,
    without_jpeg,
)
from phibench.calibration.outline.outline_start import (
    PICTURE_BLUR_PX2,
    grey,
    radii_px,
    rough_outlines,
    sphere_from_rays,
)
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.rig import Rig

HALF_WIDTH_PX = 5.0  # of the band of pixels along the limb
MIN_ARC = 0.5
"""Part of the outline that must lie in the image."""
MIN_USED = 0.6
"""Part of that whose light must be as the model has it: with less, the rest is not to be trusted either."""
_COARSE_HALF_PX, _COARSE_STEPS = 8.0, 6  # the start is some pixels off
_NEAR_M = (3e-5, 3e-5, 1.2e-4)  # about 0.15 px of the outline
_CHOOSE = 3  # steps that choose their pixels anew
# at rest: a step below 0.1 um or a twentieth of sigma; without rest: one above 1 um and sigma
_STEPS, _REST_M, _REST_SIGMAS, _UNREST_M = 30, 1e-7, 0.05, 1e-6
_MIN_CONTRAST, _MAX_CONTRAST = 0.5, 1.6
_BINNED_PX = 1000
"""Long side from twice which on the light is fitted in squares of pixels. What tells the limb is the root that the
light follows over some 15 degrees of turn: 5 squares of 4 px reach as far as 5 px of a small picture do, 5 px of a
large one do not."""
_HOPELESS = (6, 0.25, 2.2)  # step at which a fit with a contrast beyond these is given up
_BLUR_RANGE_PX2 = (0.02, 9.0)  # of the lens: sharper than a pixel, and three pixels
_LEAST_CONTRAST = 9.0  # of a circle whose light is worth a fit; patterns and noise give up to 8
_MOST_TRIED = 4  # circles whose light is fitted, which takes seconds where it does not come to rest
_MOST_OFF = 0.06  # of the distance, for an outline by its edge alone: a holder's plates are clear circles, too
_AT_EDGE_PX = 3.0  # of centre and radius, between a limb and the edge that it was looked for from
_MOST_LIT_EDGE = 0.1  # of an edge: it is looked for in full pixels, too
_CLEAR_LIMB = 30.0  # contrast from which no other circle is looked at


def find_sphere_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
    """Sphere centre from an image of the mirror, from scratch.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Nominal: its camera, radius, steel and blur are used; the outline is looked for with 0.7 to 1.4 times the
        radius that the rig gives it, anywhere in the image.
    card : SensorCard, optional
        Of the image's preset; none for a layer.

    Raises
    ------
    ImageError
        For an image without a mirror, or with less than half of its outline.
    """
    planes = planes_of(image, card)
    require_size(planes[0].values, rig.camera)
    again = (image, card) if card and card.output == "mjpeg" else None
    block = max(max(rig.camera.width_px, rig.camera.height_px) // _BINNED_PX, 1)
    small = (planes, rig) if block == 1 else (binned(planes, block), binned_rig(rig, block))
    low, high = radii_px(rig)
    fault = ImageError("an image without a mirror")
    full = full_pixels(planes)
    for start, circle, edge in _clearest(grey(planes), full, rig):
        try:
            outline = fit_outline(*small, start, again=again if block == 1 else None)
            require_near(outline.rig(rig), circle)
            require_unlit(full, outline.rig(rig).outline_px(), 1.0 - MIN_USED)
            return replace(outline, blur_px=block * outline.blur_px, shifts_px=block * outline.shifts_px)
        except ImageError as error:
            # that it is cut, or lit badly, says more than that the last circle tried was none
            fault = error if "without a mirror" in str(fault) else fault
        for curve, most_lit in ((circle, 1.0 - MIN_USED), (edge, _MOST_LIT_EDGE)):
            if by_edge := _by_edge(rig, curve):
                try:
                    require_unlit(full, curve.points_px, most_lit)
                    return by_edge
                except ImageError as error:
                    fault = error
    if "without a mirror" not in str(fault):
        raise fault
    raise ImageError(
        f"{fault}; looked for was an outline with a radius of {low:.0f} to {high:.0f} px, as the rig's focal length, "
        "mirror radius and distance say: check these numbers, too"
    )


def _clearest(picture: Array, full: BoolArray, rig: Rig) -> list[tuple[Array, BallCircle, BallCircle]]:
    """Sphere centres, limbs and the edges near them that a picture may show, at most `_MOST_TRIED`.

    Those at about the distance that the rig says come first: a holder's plates are clear circles, too. Then come limbs
    that lie at a clear edge, then the clearest. A limb that was looked for from afar may be that of a lamp along the
    true one: both bend the light alike. Where there is no limb, an edge stands for it.
    """
    blur_px = math.sqrt(rig.camera.blur_sigma_px**2 + PICTURE_BLUR_PX2)
    # the mosaic's mean takes its neighbours in
    unknown = np.where(ndimage.binary_dilation(full), np.nan, picture) if full.any() else picture
    starts: list[tuple[bool, bool, float, Array, BallCircle, BallCircle]] = []
    for _, edge in rough_outlines(picture, rig):
        if edge.contrast < _LEAST_CONTRAST:
            continue
        circle = on_limb(unknown, edge.circle_px, blur_px) or edge
        s = _sphere(rig, circle)
        starts.append((not _as_far(rig, s), not _at_edge(circle, edge), -circle.contrast, s, circle, edge))
        if len(starts) == _MOST_TRIED or (_as_far(rig, s) and circle.contrast > _CLEAR_LIMB):
            break
    return [one[3:] for one in sorted(starts, key=lambda one: one[:3])]


def _at_edge(limb: BallCircle, edge: BallCircle) -> bool:
    """Tell a limb that lies at a clear edge."""
    try:
        edge.require_clear()
    except ImageError:
        return False
    return max(abs(a - b) for a, b in zip(limb.circle_px, edge.circle_px, strict=True)) <= _AT_EDGE_PX


def _sphere(rig: Rig, circle: BallCircle) -> Array:
    return sphere_from_rays(rig.camera.rays(circle.points_px), rig.sphere.radius_m)


def _as_far(rig: Rig, s: Array) -> bool:
    expected = float(np.linalg.norm(rig.sphere_in_camera_m))
    return abs(float(np.linalg.norm(s)) - expected) <= _MOST_OFF * expected


def _by_edge(rig: Rig, circle: BallCircle) -> Outline | None:
    """Outline by a limb or an edge in the picture alone, if that is clear; its covariance is the circle's."""
    s = _sphere(rig, circle)
    if visible_arc(rig, s) < MIN_ARC or circle.edges < MIN_ARC or not _as_far(rig, s):
        return None
    try:
        circle.require_clear()
    except ImageError:
        return None
    J = _by_pixels(rig, s)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a sector without an edge
        shifts = np.nanmean(np.roll(circle.off_px, TURNS // 2).reshape(SECTORS, -1), axis=1)
    covariance = J @ circle.covariance_px2 @ J.T
    return Outline(s, covariance, circle.edges, math.nan, math.nan, math.nan, TURNS, 0, shifts, by_edge=True)


def _by_pixels(rig: Rig, s: Array) -> Array:
    """d s / d (u, v, r) of the outline's centre and radius r = f tan a0, shape (3, 3), metres per pixel.

    |s| = R / sin a0: d |s| / |s| = -d a0 / tan a0 = -cos^2 a0 d r / r. Near the axis, where the outline is a circle.
    """
    camera, a0 = rig.camera, limb_angle_rad(s, rig.sphere.radius_m)
    r = math.sqrt(camera.fx_px * camera.fy_px) * math.tan(a0)
    across = np.diag([s[2] / camera.fx_px, s[2] / camera.fy_px, 0.0])[:, :2]
    return np.column_stack([across, -s * math.cos(a0) ** 2 / r])


def fit_outline(
    planes: tuple[Plane, ...],
    rig: Rig,
    start_m: Array,
    half_px: float = HALF_WIDTH_PX,
    again: tuple[NDArray[Any], SensorCard] | None = None,
) -> Outline:
    """As `find_outline`, from a start within some pixels of the outline. `again` is frame and card of a JPEG frame."""
    s, blur = np.asarray(start_m, float), rig.camera.blur_sigma_px**2
    s = _approach(planes, rig, s, blur)
    arc = visible_arc(rig, s, half_px)
    if arc < MIN_ARC:
        raise ImageError(
            f"a mirror cut by the frame: {100.0 * arc:.0f} % of its outline lie in the image, {100.0 * MIN_ARC:.0f} % "
            "are needed; move the camera away from the mirror or centre it"
        )
    settled = _settle(planes, rig, s, blur, half_px, again)
    if settled.arc < MIN_USED * arc:
        raise ImageError(
            f"lamps or edges of the room along the mirror's outline: {100.0 * settled.arc / arc:.0f} % of it are "
            f"usable, {100.0 * MIN_USED:.0f} % are needed; switch lamps off, or move the robot"
        )
    return settled


def visible_arc(rig: Rig, s: Array, margin_px: float = 0.0) -> float:
    """Part of the outline of a sphere at `s` that lies in the image, `margin_px` inside its border."""
    moved = replace(rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(s)))
    uv, camera = moved.outline_px(), rig.camera
    low, high = margin_px - 0.5, np.array([camera.width_px, camera.height_px]) - 0.5 - margin_px
    return float(np.mean(np.all((uv >= low) & (uv <= high), axis=-1)))


def _approach(planes: tuple[Plane, ...], rig: Rig, s: Array, blur: float) -> Array:
    """Come near with a wide band, whose pixels are chosen anew at every step."""
    for _ in range(_COARSE_STEPS):
        pixels = band(planes, rig.camera, s, rig.sphere.radius_m, _COARSE_HALF_PX)
        step = step_from(pixels, planes, rig, s, blur, SECTORS // 2, _COARSE_HALF_PX)
        s = _moved(s, step.move[:3], rig)
        if np.all(np.abs(step.move[:3]) < _NEAR_M):
            break
    return s


def _settle(
    planes: tuple[Plane, ...],
    rig: Rig,
    s: Array,
    blur: float,
    half_px: float,
    again: tuple[NDArray[Any], SensorCard] | None,
) -> Outline:
    for count in range(1, _STEPS + 1):
        if count <= _CHOOSE:  # later the pixels stay, so that the steps come to rest
            pixels = band(planes, rig.camera, s, rig.sphere.radius_m, half_px)
        step = step_from(pixels, planes, rig, s, blur, SECTORS, half_px, near=True)
        # weights that are cut off can take turns for ever: shorter steps end between them
        move = step.move * min(1.0, 6.0 / count)
        sigma = np.sqrt(np.diag(step.covariance)[:3]) if count >= _CHOOSE else np.zeros(3)
        if count >= _CHOOSE and np.all(np.abs(move[:3]) < np.maximum(_REST_M, _REST_SIGMAS * sigma)):
            break
        if count == _HOPELESS[0] and not _HOPELESS[1] < step.contrast < _HOPELESS[2]:
            break  # a fit that goes to polished steel is near it by now; others go round for all steps
        s, blur = _moved(s, move[:3], rig), float(np.clip(blur + move[3], *_BLUR_RANGE_PX2))
    if count > _HOPELESS[0] and np.any(np.abs(move[:3]) > np.maximum(_UNREST_M, sigma)):
        raise ImageError("an image without a mirror: the fit of the outline does not come to rest")
    if not _MIN_CONTRAST < step.contrast < _MAX_CONTRAST:
        raise ImageError(
            f"an image without a mirror: across the outline found, the light falls by {step.contrast:.2f} times what "
            f"polished steel gives; allowed is {_MIN_CONTRAST} to {_MAX_CONTRAST}"
        )
    arc = step.sectors_used / SECTORS
    change, covariance = (step.move, step.covariance) if again is None else without_jpeg(pixels, step, *again)
    s, blur = _moved(s, change[:3], rig), float(np.clip(blur + change[3], *_BLUR_RANGE_PX2))
    left = pixels.y - step.model
    shifts, J = step.solution.sector_shifts(left), _by_pixels(rig, s)
    shared = shared_px2(shifts, step.solution.scatter(left), again is not None)
    covariance = covariance[:3, :3] + shared * J @ J.T
    return Outline(s, covariance, arc, step.contrast, blur**0.5, step.residual, len(pixels.y), count, shifts)


def _moved(s: Array, move: Array, rig: Rig) -> Array:
    """Take a step of at most 3 mm; a centre that runs away is no mirror's."""
    s = s + move * min(1.0, 3e-3 / max(float(np.abs(move).max()), 1e-12))  # no move: no division by 0
    if not (np.isfinite(s).all() and s[2] > 1.02 * rig.sphere.radius_m):
        raise ImageError("an image without a mirror: no outline of a sphere fits the light")
    return s
