"""Search and fit of the mirror's outline in an image (`find_outline`), for all shapes; classes for a sphere's outline.

1. Circles with edges all around are looked for in the picture (`ball_circle`), and the outline through each.
2. From there the light across the outline is fitted, sector by sector: Gauss-Newton with robust weights. What that
   light is, say `SphereSearch` and `rim_outline`.
3. Sectors whose light the model does not describe (lamps, edges of the room) are left out, with their neighbours.
4. The covariance comes from the scatter of the sectors' shifts, with the correlation of neighbours: the room and JPEG's
   blocks err over many pixels together. JPEG's effect is simulated from the frame itself (`outline_result`).
5. Where the fit fails or leaves its edge, and the circle is clear, the circle is the outline, with its own, larger
   covariance.

The place holds for the nominal mirror and camera; `bundle` adds their errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.calibration.outline.ball_circle import BallCircle, limb_beside_circle
from phibench.calibration.outline.edge_ring import TURNS
from phibench.calibration.outline.first_circle import (
    PICTURE_BLUR_PX2,
    circles_by_size,
    grey,
    radii_px,
    sphere_from_rays,
)
from phibench.calibration.outline.limb_image import Plane, binned_planes, full_pixels, limb_angle_rad, planes_of
from phibench.calibration.outline.outline_jpeg import corrected_for_jpeg
from phibench.calibration.outline.outline_least_squares import OutlinePixels, Step, band, step_from
from phibench.calibration.outline.outline_result import (
    MIN_ARC,
    SECTORS,
    MirrorOutline,
    Outline,
    OutlineStart,
    binned_rig,
    edge_shifts_px,
    require_near,
    require_size,
    require_unlit,
    shared_px2,
)
from phibench.calibration.outline.rim_outline import RimOutline, RimSearch
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

# Outline of a sphere for the fit of `outline`: its centre from the light across the limb.
#
# The outline of a sphere under a pinhole is the cone of pixels with the angle a0 = asin(R / |s|) from s. `limb_image`
# gives the light across it. Its level, its slopes along and across the limb, and the blur are free in the fit. What is
# left is the centre s. Where the light is not as the model has it, in other mirrors or among lamps, the edge in the
# picture is the outline (`ball_circle`); so it is where the fit leaves that edge.
#
# R and |s| scale together: the outline is that of every sphere with the same R / |s|, so that ds / s = dR / R. Radius
# and camera count as exact here.


MIN_USED = 0.6
"""Part of what lies in the image whose light must be as the model has it: with less, the rest is not trusted."""
_MIN_CONTRAST, _MAX_CONTRAST = 0.5, 1.6
_HOPELESS = (6, 0.25, 2.2)  # step at which a fit with a contrast beyond these is given up
_LEAST_CONTRAST = 9.0  # of a circle whose light is worth a fit; patterns and noise give up to 8
_MOST_TRIED = 4  # circles whose light is fitted, which takes seconds where it does not come to rest
_MOST_OFF = 0.06  # of the distance, for an outline by its edge alone: a holder's plates are clear circles, too
_AT_EDGE_PX = 3.0  # of centre and radius, between a limb and the edge that it was looked for from
_MOST_LIT_EDGE = 0.1  # of an edge: it is looked for in full pixels, too
_CLEAR_LIMB = 30.0  # contrast from which no other circle is looked at


class SphereSearch:
    """Search of a sphere's outline in the planes of an image: limbs that circles in the picture lead to."""

    nothing = "an image without a mirror"
    sought = (
        "an outline with a radius of {:.0f} to {:.0f} px, as the rig's focal length, mirror radius and distance say"
    )

    def __init__(self, planes: tuple[Plane, ...], rig: Rig) -> None:
        self.planes, self.rig, self._full = planes, rig, full_pixels(planes)

    def starts(self) -> Iterator[OutlineStart]:
        """Limbs that a picture may show and the edges near them, at most `_MOST_TRIED`.

        Those at about the distance that the rig says come first: a holder's plates are clear circles, too. Then come
        limbs that lie at a clear edge, then the clearest. A limb that was looked for from afar may be that of a lamp
        along the true one: both bend the light alike. Where there is no limb, an edge stands for it.
        """
        rig, full, picture = self.rig, self._full, grey(self.planes)
        blur_px = math.sqrt(rig.camera.blur_sigma_px**2 + PICTURE_BLUR_PX2)
        # the mosaic's mean takes its neighbours in
        unknown = np.where(ndimage.binary_dilation(full), np.nan, picture) if full.any() else picture
        rated: list[tuple[bool, bool, float, OutlineStart]] = []
        seen = False
        for edge in chain.from_iterable(circles_by_size(picture, rig)):
            seen = True
            if edge.contrast < _LEAST_CONTRAST:
                continue
            circle = limb_beside_circle(unknown, edge.circle_px, blur_px) or edge
            start, contrast = OutlineStart(_sphere(rig, circle), circle, edge), circle.contrast
            rated.append((not _as_far(rig, start.place), not _at_edge(circle, edge), -contrast, start))
            if len(rated) == _MOST_TRIED or (_as_far(rig, start.place) and contrast > _CLEAR_LIMB):
                break
        if not seen:
            raise ImageError(
                "an image without a mirror: no circle of the outline's size has edges all around; check the picture"
            )
        yield from (start for *_, start in sorted(rated, key=lambda one: one[:3]))

    def of_squares(self, outline: Outline, block: int, _: Callable[[SphereOutline], Outline]) -> Outline:
        """The same in pixels: light is fitted in squares of them alone."""
        return replace(outline, blur_px=block * outline.blur_px, shifts_px=block * outline.shifts_px)

    def require_seen(self, outline: Outline) -> None:
        """Raise `ImageError` where lamps lie all along the limb."""
        require_unlit(self._full, outline.rig(self.rig).outline_px(), 1.0 - MIN_USED)

    def by_edge(self, start: OutlineStart) -> Outline | None:
        """Outline by the limb or the edge near it."""
        fault: ImageError | None = None
        for curve, most_lit in ((start.circle, 1.0 - MIN_USED), (start.edge, _MOST_LIT_EDGE)):
            if by_edge := _by_edge(self.rig, curve):
                try:
                    require_unlit(self._full, curve.points_px, most_lit)
                    return by_edge
                except ImageError as error:
                    fault = error
        if fault is not None:
            raise fault
        return None


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
    if SphereOutline((), rig, s).visible_arc() < MIN_ARC or circle.edges < MIN_ARC or not _as_far(rig, s):
        return None
    try:
        circle.require_clear()
    except ImageError:
        return None
    J = _by_pixels(rig, s)
    shifts = edge_shifts_px(circle)
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


@dataclass(frozen=True)
class SphereOutline(MirrorOutline):
    """Outline of the rig's sphere with its centre at `place`, shape (3,)."""

    name: ClassVar[str] = "outline"
    coarse_steps: ClassVar[int] = 6
    steps: ClassVar[int] = 30
    near_m: ClassVar[tuple[float, ...]] = (3e-5, 3e-5, 1.2e-4)  # about 0.15 px of the outline

    def visible_arc(self, margin_px: float = 0.0) -> float:
        """Part of the outline that lies in the image, `margin_px` inside its border."""
        pose = replace(self.rig.T_camera_sphere, translation_m=as_vector(self.place))
        return self.visible_part(replace(self.rig, T_camera_sphere=pose).outline_px(), margin_px)

    def pixels(self, half_px: float) -> OutlinePixels:
        """Usable pixels within `half_px` of the limb."""
        return band(self.planes, self.rig.camera, self.place, self.rig.sphere.radius_m, half_px)

    def step(self, pixels: OutlinePixels, blur_px2: float, sectors: int, half_px: float, near: bool = False) -> Step:
        """Step of centre and blur, shape (4,)."""
        return step_from(pixels, self.planes, self.rig, self.place, blur_px2, sectors, half_px, near=near)

    def is_hopeless(self, count: int, step: Step) -> bool:
        """A fit that goes to polished steel is near it by now; others go round for all steps."""
        return count == _HOPELESS[0] and not _HOPELESS[1] < step.contrast < _HOPELESS[2]

    def moved(self, move: Array) -> Self:
        """The same after a step of at most 3 mm; a centre that runs away is no mirror's."""
        s = self.place + move * min(1.0, 3e-3 / max(float(np.abs(move).max()), 1e-12))  # no move: no division by 0
        if not (np.isfinite(s).all() and s[2] > 1.02 * self.rig.sphere.radius_m):
            raise ImageError("an image without a mirror: no outline of a sphere fits the light")
        return replace(self, place=s)

    def require_light(self, step: Step, arc: float) -> None:
        """Raise `ImageError` where the light does not fall as steel's does, or in too few sectors."""
        if not _MIN_CONTRAST < step.contrast < _MAX_CONTRAST:
            raise ImageError(
                f"an image without a mirror: across the outline found, the light falls by {step.contrast:.2f} times "
                f"what polished steel gives; allowed is {_MIN_CONTRAST} to {_MAX_CONTRAST}"
            )
        used = step.sectors_used / SECTORS
        if used < MIN_USED * arc:
            raise ImageError(
                f"lamps or edges of the room along the mirror's outline: {100.0 * used / arc:.0f} % of it are "
                f"usable, {100.0 * MIN_USED:.0f} % are needed; switch lamps off, or move the robot"
            )

    def result(
        self,
        pixels: OutlinePixels,
        step: Step,
        place: Array,
        covariance: Array,
        blur_px2: float,
        jpeg: bool,
        count: int,
    ) -> Outline:
        """Outline at a place after the last step, number `count`, with the covariance of the sectors' scatter."""
        left = pixels.y - step.model
        shifts, J = step.solution.sector_shifts(left), _by_pixels(self.rig, place)
        covariance = covariance + shared_px2(shifts, step.solution.scatter(left), jpeg) * J @ J.T
        arc, size = step.sectors_used / SECTORS, len(pixels.y)
        return Outline(place, covariance, arc, step.contrast, blur_px2**0.5, step.residual, size, count, shifts)


HALF_WIDTH_PX, _COARSE_HALF_PX = 5.0, 8.0  # of the band of pixels along the outline; at the start, some pixels off
_CHOOSE = 3  # steps that choose their pixels anew
# at rest: a step below 0.1 um or a twentieth of sigma; without rest: one above 1 um and sigma
_REST_M, _REST_SIGMAS, _UNREST_M = 1e-7, 0.05, 1e-6
_WHOLE_STEPS = 6.0  # later ones are shorter: weights that are cut off can take turns for ever
_BLUR_RANGE_PX2 = (0.02, 9.0)  # of the lens: sharper than a pixel, and three pixels
_BINNED_PX = 1000
"""Long side from twice which on the light is fitted in squares of pixels. What tells the limb is the root that the
light follows over some 15 degrees of turn: 5 squares of 4 px reach as far as 5 px of a small picture do, 5 px of a
large one do not."""


def find_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
    """Place of the mirror from an image of it, from scratch: of a sphere its centre, else the vertex.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Nominal: its camera, mirror and blur are used; the outline is looked for with 0.7 to 1.4 times the radius that
        the rig gives it, anywhere in the image.
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
    small, small_rig = (planes, rig) if block == 1 else (binned_planes(planes, block), binned_rig(rig, block))
    low, high = radii_px(rig)
    search = (RimSearch if rig.mirror.has_rim else SphereSearch)(planes, rig)
    fault = ImageError(search.nothing)
    for start in search.starts():
        try:
            outline = fit_outline(outline_at(small, small_rig, start.place), again if block == 1 else None)
            if block > 1:
                outline = search.of_squares(outline, block, lambda at: fit_outline(at, again, near=True))
            require_near(outline.rig(rig), start.circle)
            search.require_seen(outline)
            return outline
        except ImageError as error:
            # that it is cut, or lit badly, says more than that the last circle tried was none
            fault = error if "without a mirror" in str(fault) else fault
        try:
            if by_edge := search.by_edge(start):
                return by_edge
        except ImageError as error:
            fault = error
    if "without a mirror" not in str(fault):
        raise fault
    raise ImageError(f"{fault}; looked for was {search.sought.format(low, high)}: check these numbers, too")


_Shaped = SphereOutline | RimOutline


def outline_at(planes: tuple[Plane, ...], rig: Rig, place: Array) -> _Shaped:
    """Outline of the rig's mirror in an image, at a place of shape (3,), or (5,) for one with a rim."""
    return (RimOutline if rig.mirror.has_rim else SphereOutline)(planes, rig, np.asarray(place, float))


def fit_outline(start: _Shaped, again: tuple[NDArray[Any], SensorCard] | None = None, near: bool = False) -> Outline:
    """As `find_outline`, from within some pixels of the outline, or `near` it, within some tenths.

    `again` is frame and card of a JPEG frame.
    """
    blur = start.rig.camera.blur_sigma_px**2
    at = start if near else _approach(start, blur)
    arc = at.visible_arc(HALF_WIDTH_PX)
    if arc < MIN_ARC:
        raise ImageError(
            f"a mirror cut by the frame: {100.0 * arc:.0f} % of its {at.name} lie in the image, {100.0 * MIN_ARC:.0f} "
            "% are needed; move the camera away from the mirror or centre it"
        )
    return _settle(at, blur, again, arc)


def _approach(at: _Shaped, blur: float) -> _Shaped:
    """Come near with a wide band, whose pixels are chosen anew at every step, without what is beside the place."""
    for _ in range(at.coarse_steps):
        pixels = at.pixels(_COARSE_HALF_PX)
        move = at.step(pixels, blur, SECTORS // 2, _COARSE_HALF_PX).move[:3]
        at = at.moved(np.pad(move, (0, len(at.place) - 3)))
        if np.all(np.abs(move) < at.near_m):
            break
    return at


def _settle(at: _Shaped, blur: float, again: tuple[NDArray[Any], SensorCard] | None, arc: float) -> Outline:
    size = len(at.place)
    for count in range(1, at.steps + 1):
        here = at
        if count <= _CHOOSE:  # later the pixels stay, so that the steps come to rest
            pixels = here.pixels(HALF_WIDTH_PX)
        step = here.step(pixels, blur, SECTORS, HALF_WIDTH_PX, near=True)
        move = step.move * min(1.0, _WHOLE_STEPS / count)
        sigma = np.sqrt(np.diag(step.covariance)[:3]) if count >= _CHOOSE else np.zeros(3)
        if count >= _CHOOSE and np.all(np.abs(move[:3]) < np.maximum(_REST_M, _REST_SIGMAS * sigma)):
            break
        if here.is_hopeless(count, step):
            break
        at, blur = here.moved(move[:size]), _blurred(blur, move[size])
    else:
        if np.any(np.abs(move[:3]) > np.maximum(_UNREST_M, sigma)):
            raise ImageError(f"an image without a mirror: the fit of the {at.name} does not come to rest")
    here.require_light(step, arc)
    change, covariance = (step.move, step.covariance) if again is None else corrected_for_jpeg(pixels, step, *again)
    at, blur = at.moved(change[:size]), _blurred(blur, change[size])
    covariance = covariance[:size, :size]
    return here.result(pixels, step, at.place, covariance, blur, again is not None, count)


def _blurred(blur: float, move: float) -> float:
    return float(np.clip(blur + move, *_BLUR_RANGE_PX2))
