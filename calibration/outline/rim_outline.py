"""Contour of a mirror of revolution in an image: search, light across it, and a step of the fit of vertex and ellipse.

At a rim the light steps: inside it is the room, reflected at the rim's angle, outside it is the room behind the mirror,
or its holder. Both are free in each sector, with a slope across and along, and so is the blur. The step S(d) is the
integral of the line spread: lens, pixel, and the defocus of the rim itself. A sector in which both sides are alike has
no edge and, through its derivatives, no weight.

Where lines of sight touch the surface instead, the ray goes on undeviated, and the light is that of a sphere's limb
(`limb_image`) with the curvature that the surface has along the line of sight.

d is the distance from the contour, pixels, outwards positive. The vertex holds for the nominal profile, rim and tilt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from phibench.calibration.outline.ball_circle import BallCircle, refined_circle
from phibench.calibration.outline.contour import Contour, contour_of, place_of_outline, place_of_rig
from phibench.calibration.outline.edge_ring import CURVES, TURN_RAD, TURNS
from phibench.calibration.outline.first_circle import circles_by_size, grey
from phibench.calibration.outline.limb_image import STEP_PX, Plane, blurred_light, distances_px, line_spread
from phibench.calibration.outline.limb_sectors import Sectors
from phibench.calibration.outline.outline_least_squares import OutlinePixels, Place, Step, pixels_near, solution_of
from phibench.calibration.outline.outline_result import (
    MIN_ARC,
    SECTORS,
    MirrorOutline,
    Outline,
    OutlineStart,
    edge_shifts_px,
    shared_px2,
)
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

_NARROW_PX = 3.5  # of a band of pixels, to compare with
_LEAST_GAIN = 0.1  # of a variance: by a band of 5 px over one of 3.5 px
_LARGEST_MOVE_M, _LARGEST_ELLIPSE_PX = 3e-3, 3.0  # of a step: beyond it the light is not linear in the place
_MIN_USED, _MARGIN_PX = 0.2, 5.0  # of an edge alone: inside the image's border
_RIM_FLOOR_PX = 0.2  # of an edge's place, all around, besides its scatter
_EDGE_SIGMA_PX = 0.25  # of a sector that has an edge
_LEAST_CONTRAST, _MOST_TRIED, _MOST_OFF = 9.0, 4, 0.06


class RimSearch:
    """Search of the contour of a mirror of revolution in the planes of an image: circles with edges all around."""

    nothing = "an image without a mirror: no circle of the rim's size has edges all around"
    sought = "a rim with a radius of {:.0f} to {:.0f} px, as the rig's focal length, rim and distance say"

    def __init__(self, planes: tuple[Plane, ...], rig: Rig) -> None:
        self.planes, self.rig, self._picture = planes, rig, grey(planes)

    def starts(self) -> Iterator[OutlineStart]:
        """Contours that a picture may show, at most `_MOST_TRIED`: those at about the rig's distance first."""
        rig = self.rig
        rated: list[tuple[bool, float, OutlineStart]] = []
        for found in circles_by_size(self._picture, rig):
            for circle in found:
                if circle.contrast < _LEAST_CONTRAST:
                    continue
                try:
                    place = place_of_outline(rig, circle.points_px, _start(rig, circle), ellipse=False)
                except SceneError:  # no rig has such a contour
                    continue
                rated.append((not _as_far(rig, place), -circle.contrast, OutlineStart(place, circle, circle)))
            if any(not far for far, *_ in rated):
                break
        yield from (start for *_, start in sorted(rated, key=lambda one: one[:2])[:_MOST_TRIED])

    def of_squares(self, outline: Outline, block: int, fit: Callable[[RimOutline], Outline]) -> Outline:
        """Refinement in all pixels, from the contour in squares."""
        place = np.concatenate([outline.sphere_in_camera_m, block * np.array(outline.ellipse_px)])
        return fit(RimOutline(self.planes, self.rig, place))

    def require_seen(self, outline: Outline) -> None:
        """Nothing: lamps do not look like a rim."""

    def by_edge(self, start: OutlineStart) -> Outline | None:
        """Contour by an edge in the picture alone, if that is clear; its covariance is the circle's.

        A circle is looked for in a small picture, and inside the limb of a ball the room is squeezed into parts of a
        pixel. A rim is a plain step, whose place the whole picture tells to a part of a pixel.
        """
        rig, circle = self.rig, start.circle
        try:
            circle.require_clear()
            circle = refined_circle(self._picture, circle, _RIM_FLOOR_PX)
            place = place_of_outline(rig, circle.points_px, _start(rig, circle), ellipse=False)
            at = RimOutline(self.planes, rig, place)
            J = _by_curve(at.contour)
        except (ImageError, SceneError):
            return None
        if at.visible_arc(_MARGIN_PX) < MIN_ARC or not _as_far(rig, place):
            return None
        curve = np.diag(np.append(np.zeros(3), [circle.covariance_px2[2, 2]] * 2))
        curve[:3, :3] = circle.covariance_px2[np.ix_((2, 0, 1), (2, 0, 1))]
        covariance = J @ curve @ J.T
        shifts = edge_shifts_px(circle)
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


@dataclass(frozen=True)
class RimOutline(MirrorOutline):
    """Contour of the rig's mirror at a `place`, shape (5,): x, y, z of the vertex, e1, e2 (`contour`)."""

    name: ClassVar[str] = "rim"
    coarse_steps: ClassVar[int] = 8
    steps: ClassVar[int] = 24
    near_m: ClassVar[tuple[float, ...]] = (5e-5, 5e-5, 5e-5)

    @cached_property
    def contour(self) -> Contour:
        """The curve with its derivatives; raises `ImageError` where there is no such rig."""
        try:
            return contour_of(self.rig, self.place)
        except SceneError as error:
            raise ImageError(f"an image without a mirror: {error}") from error

    def visible_arc(self, margin_px: float) -> float:
        """Part of the contour that lies in the image, `margin_px` inside its border."""
        return self.visible_part(self.contour.points_px(), margin_px)

    def pixels(self, half_px: float) -> OutlinePixels:
        """Usable pixels within `half_px` of the contour."""
        at = self.contour
        return pixels_near(self.planes, self.rig.camera, at.points_px(), half_px, lambda rays: at.place_of(rays).d_px)

    def step(self, pixels: OutlinePixels, blur_px2: float, sectors: int, half_px: float, near: bool = False) -> Step:
        """Step of place and blur, shape (6,); raises `ImageError` if there is no light across the contour."""
        place = self.contour.place_of(pixels)
        rim = self.contour.is_rim(place.turn_rad)
        values = np.zeros((pixels.y.size, 3 * _COLUMNS))
        for mask, light in ((rim, rim_light), (~rim, grazing_light)):
            if mask.any():
                part = Place(*(getattr(place, name)[mask] for name in ("d_px", "by_s", "by_uv", "turn_rad")))
                values[mask] = _through_taps(pixels[mask], self.planes, light(self.rig, self.contour, blur_px2), part)
        where = Sectors.of(pixels.plane, place.turn_rad, sectors)
        basis, slope, curvature = (_along(part, where.offset) for part in np.split(values, 3, axis=-1))
        fit = where.fit(pixels.y, basis)
        each = fit.coefficients[where.group]
        by_d = np.einsum("nm,nm->n", each, slope)
        by_blur = 0.5 * np.einsum("nm,nm->n", each, curvature)
        by_parameters = np.column_stack([place.by_s * by_d[:, None], by_blur])
        columns = fit.without_nuisance(np.column_stack([by_parameters, by_d]))
        trust = where.described(pixels.y, fit.residual, _USUAL) if near else np.ones(sectors)
        solution = solution_of(where, fit, columns, trust)
        move = solution.move(fit.residual)
        depth = place.d_px / half_px
        return Step(move, fit.relative_residual, pixels.y, fit.model, basis[:, 0], depth, by_parameters, solution)

    def is_hopeless(self, count: int, step: Step) -> bool:
        """No: edges of all contrasts are rims."""
        return False

    def moved(self, move: Array) -> Self:
        """The same after a step of at most 3 mm and 3 px."""
        size = max(np.abs(move[:3]).max() / _LARGEST_MOVE_M, np.abs(move[3:]).max() / _LARGEST_ELLIPSE_PX, 1.0)
        place = self.place + move / size
        if not np.isfinite(place).all():
            raise ImageError("an image without a mirror: no contour of this mirror fits the light")
        return replace(self, place=np.asarray(place))

    def require_light(self, step: Step, arc: float) -> None:
        """Raise `ImageError` where too few sectors have an edge, or light that is described."""
        with np.errstate(invalid="ignore"):
            clear = float(np.mean(sector_sigmas_px(step) < _EDGE_SIGMA_PX))
        if clear < _MIN_USED * arc:
            raise ImageError(
                f"no edge along the mirror's rim: {100.0 * clear / arc:.0f} % of it differ clearly from what is behind "
                f"it, {100.0 * _MIN_USED:.0f} % are needed; put a sheet of another brightness above the mirror, switch "
                "lamps off, or move the robot"
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
        """Contour at a place after the last step, number `count`, with the covariance of the sectors' scatter."""
        left = pixels.y - step.model
        with np.errstate(invalid="ignore"):
            clear = sector_sigmas_px(step) < _EDGE_SIGMA_PX
        shifts = np.where(clear, step.solution.sector_shifts(left), np.nan)
        by_curve = _by_curve(self.contour)
        shared = shared_px2(shifts, step.solution.scatter(left), jpeg)
        covariance = covariance + shared * by_curve @ by_curve.T
        covariance = covariance + self._by_band(blur_px2, pixels, step)
        return Outline(
            place[:3],
            covariance[:3, :3],
            float(np.mean(clear)),
            math.nan,
            blur_px2**0.5,
            step.residual,
            len(pixels.y),
            count,
            shifts,
            ellipse_px=(float(place[3]), float(place[4])),
            covariance=covariance,
        )

    def _by_band(self, blur: float, pixels: OutlinePixels, step: Step) -> Array:
        """Covariance, shape (5, 5), by what a narrower band has otherwise.

        Where a wall ends, its edge is reflected along the rim. Within some pixels of it, the edge looks like a rim that
        is displaced, in many sectors alike, which their scatter does not show. The narrower the band, the less of it is
        seen. A narrower band has more noise, too. Of an efficient fit and another the difference has the variance of
        the one less that of the other (Hausman, Econometrica 46, 1251, 1978): only what is beyond it counts.
        """
        narrow = pixels[np.abs(self.contour.place_of(pixels).d_px) < _NARROW_PX]
        other = self.step(narrow, blur, SECTORS, _NARROW_PX, near=True)
        change = other.move[:-1] - step.move[:-1]
        own = np.diag(step.covariance)[:-1]
        # the scatter of either is uncertain: the difference may come out too small, or below 0
        expected = np.maximum(np.diag(other.covariance)[:-1] - own, _LEAST_GAIN * own)
        beyond = max(1.0 - 1.0 / float(np.mean(change**2 / expected)), 0.0)
        return np.asarray(beyond * np.outer(change, change))


def _by_curve(contour: Contour) -> Array:
    """Derivatives of the place by (dr, du, dv, e1, e2) of a curve, shape (5, 5)."""
    return np.asarray(np.linalg.lstsq(contour.by_place(TURN_RAD), CURVES, rcond=None)[0])


# -- light across a contour --------------------------------------------------------------------------------------------

_COLUMNS = 4  # of the light across a contour, before those along it
_ALONG = 2  # of them change along the sector, too
_USUAL = 0.4  # quantile of the sectors whose misfit is the noise's: in a room full of things there are few


@dataclass(frozen=True)
class EdgeLight:
    """Tables of the light across a contour.

    Attributes
    ----------
    tables : shape (3, n, 3 columns x 4)
        By filter and distance: the columns, their first and their second derivatives by d.
    """

    tables: Array

    def at(self, filter_index: int, d_px: Array) -> Array:
        """Values at distances (N,), shape (N, 12), linear between the table's rows."""
        table = self.tables[filter_index]
        at = np.clip((d_px - distances_px()[0]) / STEP_PX, 0.0, len(table) - 1.001)
        row = at.astype(np.intp)
        fraction = (at - row)[:, None]
        return np.asarray(table[row] * (1.0 - fraction) + table[row + 1] * fraction)


def rim_light(rig: Rig, contour: Contour, blur_px2: float) -> EdgeLight:
    """Light across a rim: 1 outside, 1 inside, and d on either side."""
    d = distances_px()
    kernel = line_spread(rig.camera, contour.depth_m, blur_px2)
    outside = np.where(np.abs(d) < 0.25 * STEP_PX, 0.5, (d > 0.0).astype(float))  # the middle of a step is half of it
    columns = [blurred_light(column, kernel) for column in (outside, 1.0 - outside, outside * d, (1.0 - outside) * d)]
    return EdgeLight(np.broadcast_to(_with_derivatives(columns), (3, len(d), 3 * _COLUMNS)))


def grazing_light(rig: Rig, contour: Contour, blur_px2: float) -> EdgeLight:
    """Light across a contour that is no rim: the reflectance, and that times the mirror's turn and its square."""
    d, camera = distances_px(), rig.camera
    kernel = line_spread(camera, contour.depth_m, blur_px2)
    angle = np.clip(-d, 0.0, None) / np.sqrt(camera.fx_px * camera.fy_px)
    cos_i = np.minimum(np.sqrt(2.0 * contour.bend * angle), 1.0)
    turn, tables = 2.0 * np.arcsin(cos_i), []
    for wavelength_nm in camera.detector.band_wavelength_nm:
        sharp = np.where(d < 0.0, rig.mirror.reflectance(cos_i, wavelength_nm), 1.0)
        columns = [blurred_light(column, kernel) for column in (sharp, sharp * turn, sharp * turn**2)]
        tables.append(_with_derivatives([*columns, np.zeros_like(d)]))
    return EdgeLight(np.stack(tables))


def _with_derivatives(columns: list[Array]) -> Array:
    light = np.stack(columns, axis=-1)
    slope = np.gradient(light, STEP_PX, axis=0)
    return np.concatenate([light, slope, np.gradient(slope, STEP_PX, axis=0)], axis=-1)


def _through_taps(pixels: OutlinePixels, planes: tuple[Plane, ...], light: EdgeLight, place: Place) -> Array:
    """Values of all columns for every pixel, summed over its taps, shape (N, 12)."""
    sums = np.zeros((pixels.y.size, 3 * _COLUMNS))
    parity = 2 * (pixels.v % 2) + pixels.u % 2
    for number, plane in enumerate(planes):
        for kind in range(4):
            rows = np.flatnonzero((pixels.plane == number) & (parity == kind))
            for tap in plane.taps[kind]:
                d = place.d_px[rows] + place.by_uv[rows] @ np.array([tap.du_px, tap.dv_px], float)
                sums[rows] += tap.weight * light.at(tap.filter_index, d)
    return sums


def _along(columns: Array, offset: Array) -> Array:
    """Columns, and the first of them with a slope along the sector, shape (N, 6)."""
    return np.concatenate([columns, columns[:, :_ALONG] * offset[:, None]], axis=-1)


def sector_sigmas_px(step: Step) -> Array:
    """Standard deviation of the edge's place in each sector by its pixels' noise, shape (count,); NaN where unused."""
    solution = step.solution
    information = solution.where.summed((solution.weight * solution.shift**2)[:, None])[:, 0]
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(information > 0.0, 1.0 / np.sqrt(information), np.nan))
