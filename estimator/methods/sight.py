"""One image of a pair with the box in which its spot is: what the built-in methods look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.methods.beam_size import measured_twice
from phibench.estimator.methods.linear import demosaiced, kind_of, linear_planes, redness
from phibench.estimator.methods.locate import locate
from phibench.estimator.methods.red_peak import red_peak
from phibench.estimator.methods.window import around, clipped, cut
from phibench.estimator.seat.pair import Answer, Box, Method, Pair, Spot
from phibench.estimator.simple_spots import SpotPositions
from phibench.estimator.status import Status, describe
from phibench.scenes.frames import Array

LEAST_PX = 5  # side of a box below which there is nothing to measure


@dataclass(frozen=True)
class Sight:
    """One image.

    Attributes
    ----------
    pair : Pair
    position : "down" or "up"
    box : Box
        In the image; from the hint, or from `locate`.
    depth_m : float or None
        Of the spot, where it is known already.
    """

    pair: Pair
    position: str
    box: Box
    depth_m: float | None = None

    @property
    def origin_px(self) -> tuple[int, int]:
        """Image pixel (u, v) of the box's first column and row."""
        return self.box.u0_px, self.box.v0_px

    @property
    def pixels(self) -> NDArray[Any]:
        """Pixels of the box, as the camera delivers them."""
        return cut(self.pair.images[self.position], self.box)

    @property
    def off_pixels(self) -> NDArray[Any] | None:
        """Pixels of the box with the laser off."""
        off = self.pair.images.get(f"{self.position}_off")
        return None if off is None else cut(off, self.box)

    @property
    def planes(self) -> Array:
        """Linear light of the box: `linear.linear_planes`."""
        return linear_planes(self.pixels, self.pair.card, self.origin_px)

    @property
    def picture(self) -> Array:
        """Box as a viewer shows it: R, G, B, shape (h, w, 3), or one plane; raw ones interpolated, not encoded."""
        pixels = self.pixels.astype(float)
        if kind_of(self.pair.card) != "bayer-raw":
            return pixels
        return np.moveaxis(demosaiced(pixels, self.origin_px), 0, -1)

    @property
    def red(self) -> Array:
        """Redness of the box, shape (h, w), the room's taken off where there is a frame with the laser off."""
        red, off = redness(self.planes), self.off_pixels
        return red if off is None else red - redness(linear_planes(off, self.pair.card, self.origin_px))

    def narrowed(self) -> Sight | None:
        """Sight of 15 x 15 pixels around the reddest spot-like place in the box; None if there is none."""
        return self.window_at(red_peak(self.red))

    def window_at(self, peak: tuple[float, float] | None) -> Sight | None:
        """Sight of 15 x 15 pixels around a place (u, v) in the coordinates of the box."""
        if peak is None:
            return None
        uv = (peak[0] + self.box.u0_px, peak[1] + self.box.v0_px)
        return replace(self, box=around(uv, self.pair.images[self.position].shape))


def each_spot(find: Callable[[Sight], Spot]) -> Method:
    """Method that looks at each image by itself, where `locate` sees a spot."""
    return lambda pair: _both(find, pair, locate(pair), None)


def each_spot_twice(find: Callable[[Sight], Spot]) -> Method:
    """The same, and once more with the distance that the first answer gives, for methods that use the beam's size."""

    def method(pair: Pair) -> Answer:
        boxes = locate(pair)
        return measured_twice(lambda depth_m: _both(find, pair, boxes, depth_m), pair)

    return method


def _both(
    find: Callable[[Sight], Spot], pair: Pair, boxes: tuple[Box | None, Box | None], depth_m: float | None
) -> Answer:
    down, up = (_seen(find, pair, name, box, depth_m) for name, box in zip(("down", "up"), boxes, strict=True))
    return Answer(down, up)


def _seen(find: Callable[[Sight], Spot], pair: Pair, position: str, box: Box | None, depth_m: float | None) -> Spot:
    if box is None:
        return Spot.missing("nothing spot-like in the mirror")
    inside = clipped(box, pair.images[position].shape)
    if min(inside.width_px, inside.height_px) < LEAST_PX:
        return Spot.missing("the box lies outside the image")
    return find(Sight(pair, position, inside, depth_m))


def spot_of(found: SpotPositions) -> Spot:
    """Answer for the first of some positions, in the image."""
    status = Status(int(found.status[0]))
    if status is not Status.OK:
        return Spot.missing(describe(status))
    return Spot((float(found.uv_px[0, 0]), float(found.uv_px[0, 1])))
