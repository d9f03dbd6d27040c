"""Sphere centre from the image of the mirror's outline.

The outline of a sphere under a pinhole is the cone of pixels with the angle a0 = asin(R / |s|) from s. `limb_image`
gives the light across it. Its level, its slopes along and across the limb, and the blur are free in the fit. What is
left is the centre s: Gauss-Newton with robust weights, sector by sector.

* Sectors whose light the model does not describe (lamps, edges of the room) are left out, with their neighbours.
* The covariance comes from the scatter of the sectors' shifts, with the correlation of neighbours: the room and JPEG's
  blocks err over many pixels together.
* The effect of JPEG on the limb is simulated from the frame itself (`outline_jpeg`).
* Where the light is not as the model has it, in other mirrors or among lamps, the edge in the picture is the outline
  (`ball_circle`), with its own, larger covariance; so it is where the fit leaves that edge.

R and |s| scale together: the outline is that of every sphere with the same R / |s|, so that ds / s = dR / R. Radius and
camera count as exact here; `bundle` adds their errors.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.outline.ball_circle import BallCircle, on_limb
from phibench.estimator.outline.edge_ring import TURNS
from phibench.estimator.outline.limb_image import Measured, Plane, binned, full_pixels, limb_angle_rad, planes_of
from phibench.estimator.outline.outline_fit import OutlinePixels, Step, band, step_from
from phibench.estimator.outline.outline_jpeg import JpegAgain
from phibench.estimator.outline.outline_start import (
    PICTURE_BLUR_PX2,
    grey,
    radii_px,
    rough_outlines,
    sphere_from_rays,
)
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, BoolArray, as_vector
from phibench.scenes.rig import Rig

HALF_WIDTH_PX = 5.0
SECTORS = 120
MIN_ARC = 0.5
"""Part of the outline that must lie in the image."""
MIN_USED = 0.6
"""Part of that whose light must be as the model has it: with less, the rest is not to be trusted either."""
JPEG_DRAWS = (2, 8)
"""Draws of noise and JPEG from which the change of an outline by JPEG is taken, in a first and a second round."""
_COARSE_HALF_PX, _COARSE_STEPS = 8.0, 6
_NEAR_M = (3e-5, 3e-5, 1.2e-4)  # about 0.15 px of the outline
_CHOOSE = 3  # steps that choose their pixels anew
_STEPS, _REST_M, _REST_SIGMAS, _UNREST_M = 30, 1e-7, 0.05, 1e-6
_MIN_CONTRAST, _MAX_CONTRAST = 0.5, 1.6
_BINNED_PX = 1000
"""Long side from twice which on the light is fitted in squares of pixels. What tells the limb is the root that the
light follows over some 15 degrees of turn: 5 squares of 4 px reach as far as 5 px of a small picture do, 5 px of a
large one do not."""
_HOPELESS = (6, 0.25, 2.2)  # step at which a fit with a contrast beyond these is given up
_BLUR_RANGE_PX2 = (0.02, 9.0)
_LEAST_CONTRAST = 9.0  # of a circle whose light is worth a fit; patterns and noise give up to 8
_MOST_TRIED = 4  # circles whose light is fitted, which takes seconds where it does not come to rest
_MOST_OFF = 0.06  # of the distance, for an outline by its edge alone: a holder's plates are clear circles, too
_AT_EDGE_PX = 3.0  # of centre and radius, between a limb and the edge that it was looked for from
_FROM_EDGE_PX = 1.0  # the steepest place of the light is some tenths of a pixel inside the limb
_SHARED = 0.55
_SMOOTH, _SMOOTH_JPEG = 2.5, 10.0
_BESIDE_LAMP_PX, _FEWEST_FULL = 4.0, 2  # pixels on both sides of an outline, and of 9 places there
_MOST_LIT_EDGE = 0.1  # of an edge: it is looked for in full pixels, too
_CLEAR_LIMB = 30.0  # contrast from which no other circle is looked at


@dataclass(frozen=True)
class Outline:
    """Sphere centre from an outline, with its quality.

    Attributes
    ----------
    sphere_in_camera_m : shape (3,), s
    covariance_m2 : shape (3, 3)
        For exact radius and camera.
    arc : float
        Part of the outline that was used.
    contrast : float
        Fall of the light inside the limb over what the steel's reflectance gives; 1 for this mirror.
    blur_px : float
        Standard deviation of the lens's blur that was found.
    residual : float
        Robust standard deviation of the residuals over the light.
    pixels, steps : int
        Squares of pixels in long pictures.
    by_edge : bool
        The light is not as the model has it: the outline is the edge in the picture. Contrast, blur and residual are
        NaN.
    shifts_px : shape (SECTORS,)
        Shift of the limb that the fit leaves in each sector, outwards positive, pixels; NaN where it is not used.
        Sector k begins at the angle -pi + 2 pi k / SECTORS about the sphere's direction, from the camera's x to y.
    """

    sphere_in_camera_m: Array
    covariance_m2: Array = field(repr=False)
    arc: float
    contrast: float
    blur_px: float
    residual: float
    pixels: int
    steps: int
    shifts_px: Array = field(default_factory=lambda: np.zeros(SECTORS), repr=False)
    by_edge: bool = False

    @property
    def sigma_m(self) -> Array:
        """Standard deviations of s, shape (3,)."""
        return np.sqrt(np.diag(self.covariance_m2))

    @property
    def shift_rms_px(self) -> float:
        """Root mean square of the sectors' shifts."""
        return float(np.sqrt(np.nanmean(np.square(self.shifts_px))))

    def widened(self, factor: float) -> Outline:
        """The same with a standard deviation `factor` times as large.

        Raises
        ------
        ImageError
            If the factor is not above 0.
        """
        if not 0.0 < factor < np.inf:
            raise ImageError(f"the factor of the outline's standard deviation is {factor:g}: it must be above 0")
        return replace(self, covariance_m2=self.covariance_m2 * factor**2)

    def rig(self, nominal: Rig) -> Rig:
        """The nominal rig with the sphere where its outline is."""
        pose = replace(nominal.T_camera_sphere, translation_m=as_vector(self.sphere_in_camera_m))
        return replace(nominal, T_camera_sphere=pose)


def find_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
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
    _require_size(planes[0].values, rig.camera)
    again = (image, card) if card and card.output == "mjpeg" else None
    block = max(max(rig.camera.width_px, rig.camera.height_px) // _BINNED_PX, 1)
    small = (planes, rig) if block == 1 else (binned(planes, block), binned_rig(rig, block))
    low, high = radii_px(rig)
    fault = ImageError("an image without a mirror")
    full = full_pixels(planes)
    for start, circle, edge in _clearest(grey(planes), full, rig):
        try:
            found = fit_outline(*small, start, again=again if block == 1 else None)
            require_near(found.rig(rig), circle)
            require_unlit(full, found.rig(rig).outline_px(), 1.0 - MIN_USED)
            return replace(found, blur_px=block * found.blur_px, shifts_px=block * found.shifts_px)
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


def binned_rig(rig: Rig, block: int) -> Rig:
    """Rig whose pixels are squares of `block` of the camera's."""
    camera = rig.camera
    lengths = {name: getattr(camera, name) / block for name in ("fx_px", "fy_px", "blur_sigma_px")}
    centre = {name: (getattr(camera, name) + 0.5) / block - 0.5 for name in ("cx_px", "cy_px")}
    size = {name: getattr(camera, name) // block for name in ("width_px", "height_px")}
    return replace(
        rig, camera=replace(camera, pixel_pitch_um=camera.pixel_pitch_um * block, **size, **lengths, **centre)
    )


def require_unlit(full: BoolArray, outline_px: Array, most: float) -> None:
    """Raise `ImageError` if more than a part of an outline, shape (n, 2), lies beside full pixels.

    A lamp in the mirror fills the pixels that its blur reaches: before a dark plate the edge of what is full lies some
    pixels outside the limb, and that of a lamp all along the limb as many inside.
    """
    middle = outline_px.mean(axis=0)
    away = outline_px - middle
    reach = 1.0 + _BESIDE_LAMP_PX * np.linspace(-1.0, 1.0, 9) / np.linalg.norm(away, axis=1)[:, None]
    u, v = (np.rint(middle[k] + reach * away[:, k, None]).astype(np.intp) for k in (0, 1))
    seen = (u >= 0) & (v >= 0) & (u < full.shape[1]) & (v < full.shape[0])
    lit = (full[np.clip(v, 0, full.shape[0] - 1), np.clip(u, 0, full.shape[1] - 1)] & seen).sum(axis=1) >= _FEWEST_FULL
    part = float(lit[seen.any(axis=1)].mean()) if seen.any() else 0.0
    if part > most:
        raise ImageError(
            f"lamps fill the pixels along {100.0 * part:.0f} % of the mirror's outline: where the limb is cannot be "
            "seen there; take the picture with a shorter exposure, or switch lamps off"
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
    found: list[tuple[bool, bool, float, Array, BallCircle, BallCircle]] = []
    for _, edge in rough_outlines(picture, rig):
        if edge.contrast < _LEAST_CONTRAST:
            continue
        circle = on_limb(unknown, edge.circle_px, blur_px) or edge
        s = _sphere(rig, circle)
        found.append((not _as_far(rig, s), not _at_edge(circle, edge), -circle.contrast, s, circle, edge))
        if len(found) == _MOST_TRIED or (_as_far(rig, s) and circle.contrast > _CLEAR_LIMB):
            break
    return [one[3:] for one in sorted(found, key=lambda one: one[:3])]


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


def require_near(rig: Rig, circle: BallCircle) -> None:
    """Raise `ImageError` if a fit of the light has left the edge that it began at."""
    u, v, _ = circle.circle_px
    outline, edge = rig.outline_px(TURNS) - (u, v), circle.points_px - (u, v)
    turn, order = np.arctan2(edge[:, 1], edge[:, 0]), np.argsort(np.arctan2(edge[:, 1], edge[:, 0]))
    there = np.interp(
        np.arctan2(outline[:, 1], outline[:, 0]), turn[order], np.hypot(*edge.T)[order], period=2.0 * np.pi
    )
    off = float(np.abs(np.hypot(*outline.T) - there).max())
    allowed = _FROM_EDGE_PX + 3.0 * float(circle.sigma_px.max())
    if off > allowed:
        raise ImageError(
            f"an image without a mirror: the light of polished steel fits best {off:.1f} px from the edge that is "
            f"there; {allowed:.1f} px are allowed"
        )


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
    found = _settle(planes, rig, s, blur, half_px, again)
    if found.arc < MIN_USED * arc:
        raise ImageError(
            f"lamps or edges of the room along the mirror's outline: {100.0 * found.arc / arc:.0f} % of it are usable, "
            f"{100.0 * MIN_USED:.0f} % are needed; switch lamps off, or move the robot"
        )
    return found


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
        step = step_from(pixels, planes, rig, s, blur, SECTORS, half_px, again is not None, near=True)
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
    shared = _shared_px2(shifts, step.solution.scatter(left), again is not None)
    covariance = covariance[:3, :3] + shared * J @ J.T
    return Outline(s, covariance, arc, step.contrast, blur**0.5, step.residual, len(pixels.y), count, shifts)


def _shared_px2(shifts_px: Array, scatter: float, jpeg: bool) -> float:
    """Variance of centre and radius by what errs alike in all sectors, which their scatter does not show.

    The edges of a room lie at one height all around. The share of the sectors' scatter was measured in 60 rooms; a
    scatter of a few times the pixels' noise is JPEG's, and of rooms without edges.
    """
    usual = 1.4826 * float(np.nanmedian(np.abs(shifts_px)))
    return float((_SHARED * usual) ** 2 * max(1.0 - (_SMOOTH_JPEG if jpeg else _SMOOTH) / scatter, 0.0))


def without_jpeg(pixels: OutlinePixels, step: Step, frame: NDArray[Any], card: SensorCard) -> tuple[Array, Array]:
    """Last step of the fit of a JPEG frame, shape (4,), and its covariance, less what JPEG does to the fit.

    The model of the light is drawn through the camera's noise and JPEG, and the fit's answer compared with what was
    put in: first with the blur that was found, which JPEG has made wider, then with the blur that this leaves.
    """
    again, change = JpegAgain(frame, pixels, card), step.move
    for draws in JPEG_DRAWS:
        off = np.mean(again.drawn(step.model + step.by_parameters @ change, draws), axis=0) - step.model
        change = step.move - (step.solution.move(off) - change)
    # the draws' own mean is left in the scatter: what is large there was not drawn from quite the true light
    return change, step.solution.covariance(pixels.y - step.model)


def _moved(s: Array, move: Array, rig: Rig) -> Array:
    """Take a step of at most 3 mm; a centre that runs away is no mirror's."""
    s = s + move * min(1.0, 3e-3 / max(float(np.abs(move).max()), 1e-12))
    if not (np.isfinite(s).all() and s[2] > 1.02 * rig.sphere.radius_m):
        raise ImageError("an image without a mirror: no outline of a sphere fits the light")
    return s


def _require_size(image: Array, camera: Camera) -> None:
    if image.shape != (camera.height_px, camera.width_px):
        raise ImageError(
            f"an image of {image.shape[1]} x {image.shape[0]} pixels for a camera of {camera.width_px} x "
            f"{camera.height_px}: give a whole frame of this camera"
        )


def mean_outline(outlines: Sequence[Outline]) -> Measured:
    """Weighted mean of sphere centres, see `mean_measured`."""
    return mean_measured([Measured(outline.sphere_in_camera_m, outline.covariance_m2) for outline in outlines])


def mean_measured(parts: Sequence[Measured]) -> Measured:
    """Weighted mean of vectors; their scatter widens the covariance where it is larger than they claim."""
    weights = np.array([np.linalg.inv(part.covariance) for part in parts])
    covariance = np.linalg.inv(weights.sum(axis=0))
    values = np.array([part.value for part in parts])
    mean = covariance @ np.einsum("kij,kj->i", weights, values)
    off = values - mean
    degrees = values.shape[1] * (len(parts) - 1)
    chi2 = float(np.einsum("ki,kij,kj->", off, weights, off))
    return Measured(mean, covariance * max(1.0, chi2 / degrees if degrees else 1.0))
