"""Outline of a sphere for the fit of `outline`: its centre from the light across the limb.

The outline of a sphere under a pinhole is the cone of pixels with the angle a0 = asin(R / |s|) from s. `limb_image`
gives the light across it. Its level, its slopes along and across the limb, and the blur are free in the fit. What is
left is the centre s. Where the light is not as the model has it, in other mirrors or among lamps, the edge in the
picture is the outline (`ball_circle`); so it is where the fit leaves that edge.

R and |s| scale together: the outline is that of every sphere with the same R / |s|, so that ds / s = dR / R. Radius and
camera count as exact here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar, Self

import numpy as np
from scipy import ndimage

from phibench.calibration.outline.ball_circle import BallCircle, on_limb
from phibench.calibration.outline.edge_ring import TURNS
from phibench.calibration.outline.limb_image import Plane, full_pixels, limb_angle_rad
from phibench.calibration.outline.outline_fit import OutlinePixels, Step, band, step_from
from phibench.calibration.outline.outline_result import (
    MIN_ARC,
    SECTORS,
    MirrorOutline,
    Outline,
    OutlineStart,
    edge_shifts_px,
    require_unlit,
    shared_px2,
)
from phibench.calibration.outline.outline_start import PICTURE_BLUR_PX2, circles_by_size, grey, sphere_from_rays
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

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
            circle = on_limb(unknown, edge.circle_px, blur_px) or edge
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
