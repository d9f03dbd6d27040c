"""Light across the contour of a mirror of revolution, and one Gauss-Newton step of the contour's place.

At a rim the light steps: inside it is the room, reflected at the rim's angle, outside it is the room behind the mirror,
or its holder. Both are free in each sector, with a slope across and along, and so is the blur. The step S(d) is the
integral of the line spread: lens, pixel, and the defocus of the rim itself. A sector in which both sides are alike has
no edge and, through its derivatives, no weight.

Where lines of sight touch the surface instead, the ray goes on undeviated, and the light is that of a sphere's limb
(`limb_image`) with the curvature that the surface has along the line of sight.

d is the distance from the contour, pixels, outwards positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.calibration.outline.contour import Contour
from phibench.calibration.outline.limb_image import STEP_PX, Plane, blurred, distances_px, line_spread
from phibench.calibration.outline.limb_sectors import Sectors
from phibench.calibration.outline.outline_fit import OutlinePixels, Place, Step, solution_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

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
    columns = [blurred(column, kernel) for column in (outside, 1.0 - outside, outside * d, (1.0 - outside) * d)]
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
        columns = [blurred(column, kernel) for column in (sharp, sharp * turn, sharp * turn**2)]
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


def rim_step(
    pixels: OutlinePixels,
    planes: tuple[Plane, ...],
    rig: Rig,
    contour: Contour,
    blur_px2: float,
    sectors: int,
    half_px: float,
    near: bool = False,
) -> Step:
    """Linearise the light around a contour and solve for its place and the blur, robustly; shape (6,).

    `near` leaves out the sectors whose light is not described; far from the contour that is all of them.

    Raises
    ------
    ImageError
        If there is no light across the contour.
    """
    place = contour.place_of(pixels)
    rim = contour.is_rim(place.turn_rad)
    values = np.zeros((pixels.y.size, 3 * _COLUMNS))
    for mask, light in ((rim, rim_light), (~rim, grazing_light)):
        if mask.any():
            part = Place(*(getattr(place, name)[mask] for name in ("d_px", "by_s", "by_uv", "turn_rad")))
            values[mask] = _through_taps(pixels[mask], planes, light(rig, contour, blur_px2), part)
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


def _along(columns: Array, offset: Array) -> Array:
    """Columns, and the first of them with a slope along the sector, shape (N, 6)."""
    return np.concatenate([columns, columns[:, :_ALONG] * offset[:, None]], axis=-1)


def sector_sigmas_px(step: Step) -> Array:
    """Standard deviation of the edge's place in each sector by its pixels' noise, shape (count,); NaN where unused."""
    solution = step.solution
    information = solution.where.summed((solution.weight * solution.shift**2)[:, None])[:, 0]
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(information > 0.0, 1.0 / np.sqrt(information), np.nan))
