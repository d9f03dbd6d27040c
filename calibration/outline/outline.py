"""Outline of the rig's mirror in an image, whatever its shape.

1. Circles with edges all around are looked for in the picture (`ball_circle`), and the outline through each.
2. From there the light across the outline is fitted, sector by sector: Gauss-Newton with robust weights. What that
   light is, say `sphere_outline` and `rim_outline`.
3. Sectors whose light the model does not describe (lamps, edges of the room) are left out, with their neighbours.
4. The covariance comes from the scatter of the sectors' shifts, with the correlation of neighbours: the room and JPEG's
   blocks err over many pixels together. JPEG's effect is simulated from the frame itself (`outline_result`).
5. Where the fit fails or leaves its edge, and the circle is clear, the circle is the outline, with its own, larger
   covariance.

The place holds for the nominal mirror and camera; `bundle` adds their errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.limb_image import Plane, binned, planes_of
from phibench.calibration.outline.outline_result import (
    MIN_ARC,
    SECTORS,
    Outline,
    binned_rig,
    require_near,
    require_size,
    without_jpeg,
)
from phibench.calibration.outline.outline_start import radii_px
from phibench.calibration.outline.rim_outline import RimOutline, RimSearch
from phibench.calibration.outline.sphere_outline import SphereOutline, SphereSearch
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

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
    small, small_rig = (planes, rig) if block == 1 else (binned(planes, block), binned_rig(rig, block))
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
    change, covariance = (step.move, step.covariance) if again is None else without_jpeg(pixels, step, *again)
    at, blur = at.moved(change[:size]), _blurred(blur, change[size])
    covariance = covariance[:size, :size]
    return here.result(pixels, step, at.place, covariance, blur, again is not None, count)


def _blurred(blur: float, move: float) -> float:
    return float(np.clip(blur + move, *_BLUR_RANGE_PX2))
