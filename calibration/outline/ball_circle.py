"""Outline of a mirror ball in any photograph: circles by Hough votes, robust fit to edges, or to light across the limb.

1. Edge elements of a small picture vote for the centres along their gradients, for every radius. The radii are
   compared by the votes over those of all places.
2. Around each of the best circles, the strongest edges of every turn are joined: random triples give circles, and that
   with the most edges near it is fitted by robust least squares, with the ellipse of a sphere beside the axis.
3. The curve with the highest `EdgeRing.contrast` is the answer, if it is clear, and clearer than any other one.

The covariance is the jackknife's over twelve sectors: what errs in a part of the outline, such as a foot or a pattern
that follows the rim, errs together. It refers to the visible edge. Long pictures are made smaller first, to at most
1024 px; an edge counts to about a third of such a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from phibench.calibration.outline.edge_ring import (
    CURVES,
    PEAKS,
    TURNS,
    Circle,
    EdgeRing,
    FineRing,
    LimbRing,
    log_colours,
)
from phibench.calibration.outline.limb_circle import limb_circle
from phibench.calibration.outline.limb_image import square_sums
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array

LONGEST_PX = 1024  # long side of the picture in which the outline is looked for
LEAST_CONTRAST = 16.0  # wrong circles give up to 15
LEAST_LEAD = 1.9  # over the next curve
MOST_SIGMA = 0.01  # of the radius
SIZES = (0.14, 0.75)  # radii over the short side
_FLOOR_PX = 0.4  # of an edge's place in the small picture: inside the limb the room is squeezed into fractions of it
_LIMB_FLOOR_PX = (0.1, 0.1, 0.3)  # of u, v, radius: a plate's edge lies a pixel inside the limb, all around
_LIMB_SHARED = 0.6  # part of the scatter of its places that neighbours share
_LIMB_ROUNDS = ((24.0, 1.5), (14.0, 1.0), (8.0, 0.7))  # reach, and how near a limb's place must be to a circle, pixels
# long side of the picture that votes, short side that is enough, circles looked at, and those followed to the end
_VOTE_PX, _LEAST_SIDE, _CANDIDATES, _SETTLED = 256, 16, 30, 6
_ELLIPSE = 0.01  # standard deviation of e1 and e2 over the radius: a sphere 8 degrees off the axis
# triples of edges: with half of all turns on the circle 50 of 400 are wholly of it
_DRAWS, _NEAR_PX, _NEAR_REACH_PX = 400, 1.5, 12.0
_SCALES = (6.0, 3.0, 2.0, 1.5, 1.5, 1.5)  # of the robust weights, in steps
_SECTORS = 12  # of the jackknife: each holds what the room does to one part of the limb
_OVERWHELMING = 2.5  # times the contrast of the next: the others are not followed
_SAME_PX, _SAME = 3.0, 0.04  # pixels, and parts of the radius
_AGREE = 2.0  # standard deviations by which edges and the fall of the light may differ
_OF_EDGES, _OF_FALL = 0.75, 0.25  # of what the two are apart: error of either where it is the answer
_MODEL = 0.003  # of the radius: what the model of the fall errs, by one real ball under 40 lights
_SURE_CONTRAST = 30.0  # of an edge all around, where the fall describes the light no better
_LEAST_GAIN = 0.35  # of the logarithm: by which the fall must describe the light better than the edges
_NO_GAIN = 0.1  # below it the edges are the answer: 0.04 among patterns, 0.14 to 0.42 on a defocused black ball
_BETWEEN = 1.0 / 12.0  # variance over the square of an interval in which all places are alike


@dataclass(frozen=True)
class BallCircle:
    """Outline of a ball in a photograph.

    Attributes
    ----------
    circle_px : centre (u, v) and mean radius
    ellipse_px : e1, e2 of r(t) = r + e1 cos 2t + e2 sin 2t
    covariance_px2 : array, shape (3, 3), of u, v, radius
    contrast, lead : float
        See `EdgeRing.contrast`; and over that of the next curve.
    off_px : array, shape (TURNS,)
        Distances of the edges from the outline, outwards positive; NaN where a turn has none near it.
    """

    circle_px: Circle
    ellipse_px: tuple[float, float]
    covariance_px2: Array = field(repr=False)
    contrast: float
    lead: float
    off_px: Array = field(repr=False)

    @property
    def edges(self) -> float:
        """Part of the turns that have an edge at the outline."""
        return float(np.mean(np.isfinite(self.off_px)))

    @property
    def sigma_px(self) -> Array:
        """Standard deviations of u, v, radius."""
        return np.sqrt(np.diag(self.covariance_px2))

    def require_clear(self) -> None:
        """Raise `ImageError` for a circle that may not be an outline, or is too uncertain."""
        if self.contrast < LEAST_CONTRAST:
            raise ImageError(
                f"no outline of a ball was found: the clearest circle stands out by {self.contrast:.1f} standard "
                f"errors, {LEAST_CONTRAST:.0f} are needed; cut out the part with the ball where it is small"
            )
        if self.lead < LEAST_LEAD:
            raise ImageError(
                f"no outline of a ball was found: the clearest circle stands out {self.lead:.1f} times as much as the "
                f"next, {LEAST_LEAD:g} times are needed; which of them is the ball's cannot be told"
            )
        if self.sigma_px.max() > MOST_SIGMA * self.circle_px[2]:
            raise ImageError(
                f"no outline of a ball was found: the clearest circle is uncertain by {self.sigma_px.max():.1f} px; "
                f"{MOST_SIGMA * self.circle_px[2]:.1f} px are allowed; light what is behind the ball evenly"
            )

    @property
    def points_px(self) -> Array:
        """Points of the outline, shape (TURNS, 2)."""
        u, v, radius = self.circle_px
        r = radius + CURVES[:, 3:] @ np.array(self.ellipse_px)
        return np.stack([u + r * CURVES[:, 1], v + r * CURVES[:, 2]], axis=-1)


def find_circle(light: NDArray[Any], radii_px: tuple[float, float] | None = None) -> BallCircle:
    """Outline of the mirror ball in a photograph.

    Parameters
    ----------
    light : array, shape (H, W) or (H, W, 3), linear
    radii_px : least and largest radius, or None for `SIZES` times the short side

    Raises
    ------
    ImageError
        If there is none, if several curves are as clear, or if its place is too uncertain.
    """
    best = next(possible_circles(light, radii_px), None)
    if best is None:
        raise ImageError("no outline of a ball was found: the picture has no edges on a circle")
    best.require_clear()
    circle = edge_or_limb_circle(light, refined_circle(light, best))
    circle.require_clear()
    return circle


def edge_or_limb_circle(light: NDArray[Any], found: BallCircle) -> BallCircle:
    """The circle by edges, or by the fall of the light where that is another one and describes the light better.

    Where neither describes it clearly better, the middle of the two. What they are apart counts in the covariance.
    """
    block = max(1, math.ceil(max(light.shape[:2]) / LONGEST_PX))
    small = shrunk_picture(light if light.ndim == 2 else light.mean(axis=-1), block)
    u, v, radius = found.circle_px
    near = ((u + 0.5) / block - 0.5, (v + 0.5) / block - 0.5, radius / block)
    limb = limb_circle(small, near, (found.ellipse_px[0] / block, found.ellipse_px[1] / block))
    if limb is None:
        return found
    own = np.array(found.covariance_px2) / block**2
    floor = (_MODEL * near[2]) ** 2 * np.eye(3)
    apart = np.array(limb.circle_px) - np.array(near)
    most = float(np.abs(apart).max())
    if (np.abs(apart) < _AGREE * np.sqrt(np.diag(own + limb.covariance_px2 + floor / 4.0))).all():
        shared = (_OF_EDGES * most) ** 2 * np.eye(3)
        return replace(found, covariance_px2=(own + shared) * block**2)
    if limb.gain < _NO_GAIN:  # the room in the ball is not smooth: its edges are what there is
        shared = (0.0 if found.contrast >= _SURE_CONTRAST else _OF_FALL * most) ** 2 * np.eye(3)
        return replace(found, covariance_px2=(own + shared) * block**2)
    floor += (_MODEL * near[2]) ** 2 * limb.leverage
    if limb.gain < _LEAST_GAIN:
        u, v, radius = np.array(near) + 0.5 * apart
        covariance = (own + limb.covariance_px2) / 4.0 + floor + _BETWEEN * most**2 * np.eye(3)
    else:
        u, v, radius = limb.circle_px
        covariance = limb.covariance_px2 + floor + (_OF_FALL * most) ** 2 * np.eye(3)
    whole = ((float(u) + 0.5) * block - 0.5, (float(v) + 0.5) * block - 0.5, float(radius) * block)
    return replace(found, circle_px=whole, covariance_px2=covariance * block**2)


def refined_circle(light: NDArray[Any], found: BallCircle, floor_px: float = _FLOOR_PX) -> BallCircle:
    """An outline that was found in a picture made smaller, in the squares of one twice as long.

    Finer ones say no more: the pixels of long photographs are finer than what lens and sharpening leave of an edge.
    `floor_px` is what an edge errs all around, in those squares.
    """
    searched, block = (max(1, math.ceil(max(light.shape[:2]) / length)) for length in (LONGEST_PX, 2 * LONGEST_PX))
    if block == searched:
        return found
    return _finer(light[None] if light.ndim == 2 else np.moveaxis(light, -1, 0), found, block, floor_px)


def _finer(channels: NDArray[Any], found: BallCircle, block: int, floor_px: float) -> BallCircle:
    u, v, radius = found.circle_px
    circle = ((u + 0.5) / block - 0.5, (v + 0.5) / block - 0.5, radius / block)
    e = np.array(found.ellipse_px) / block
    curve = np.array([0.0, 0.0, 0.0, *e])
    for _ in range(2):
        ring = FineRing(channels, circle, _NEAR_REACH_PX, block=block, ellipse=(float(curve[3]), float(curve[4])))
        moved, curve = ring.moved(_least_squares(ring, curve, _SCALES)[0])
        circle = moved.circle
    ring = FineRing(channels, circle, _NEAR_REACH_PX, block=block, ellipse=(float(curve[3]), float(curve[4])))
    return _with_covariance(found.contrast, ring, curve, _SCALES, (floor_px,) * 3, block, found.lead)


def possible_circles(
    light: NDArray[Any], radii_px: tuple[float, float] | None = None, count: int = _CANDIDATES
) -> Iterator[BallCircle]:
    """Outlines that a ball may have, the clearest first, clear or not; `count` circles are tried."""
    block = max(1, math.ceil(max(light.shape[:2]) / LONGEST_PX))
    radii = None if radii_px is None else _over(radii_px, block)
    curves = _settled(log_colours(shrunk_picture(light, block)), radii, count)
    for curve in curves:
        others = [other[0] for other in curves if other is not curve]
        yield _measured(_clearer(curve), max(others, default=0.0), block)


def shrunk_picture(light: NDArray[Any], block: int) -> NDArray[Any]:
    """Means over squares of `block` pixels; what is left over at the right and below is cut off."""
    if block == 1:
        return light
    return square_sums(light, block) / block**2


def _over(radii_px: tuple[float, float], block: int) -> tuple[float, float]:
    return radii_px[0] / block, radii_px[1] / block


# Candidates.


def circle_candidates(
    channels: Array, radii_px: tuple[float, float] | None = None, count: int = _CANDIDATES
) -> list[Circle]:
    """Circles with the most votes, the best first."""
    block = max(1, round(max(channels.shape[1:]) / _VOTE_PX))
    small = np.moveaxis(shrunk_picture(np.moveaxis(channels, 0, -1), block), -1, 0)
    rows, columns = small.shape[1:]
    if min(rows, columns) < _LEAST_SIDE:
        return []
    v, u, cosine, sine = _edge_elements(small)
    short = min(rows, columns)
    low, high = (SIZES[0] * short, SIZES[1] * short) if radii_px is None else _over(radii_px, block)
    # steps of 1.5 px: votes are smoothed over about as much
    radii = np.arange(max(low, 4.0), max(high, low + 2.0), 1.5)
    beyond = max(rows, columns) // 4
    size = ((rows + 2 * beyond) // 2 + 1, (columns + 2 * beyond) // 2 + 1)
    space = np.empty((len(radii), *size), np.float32)
    for k, r in enumerate(radii):
        votes = np.zeros(size[0] * size[1])
        for side in (r, -r):
            i = np.rint((v + side * sine + beyond) / 2.0).astype(int)
            j = np.rint((u + side * cosine + beyond) / 2.0).astype(int)
            fits = (i >= 0) & (i < size[0]) & (j >= 0) & (j < size[1])
            votes += np.bincount(i[fits] * size[1] + j[fits], minlength=len(votes))
        space[k] = ndimage.gaussian_filter(votes.reshape(size), 1.0) / r
    # along the radius: a circle between two steps has both's votes
    space = ndimage.gaussian_filter1d(space, 0.7, axis=0)
    # by chance every place gets a share of the votes with a deviation as 1 / sqrt(r)
    space = (space - space.mean(axis=(1, 2), keepdims=True)) * np.sqrt(radii)[:, None, None]
    circles_seen: list[Circle] = []
    for _ in range(count):
        k, i, j = (int(x) for x in np.unravel_index(int(np.argmax(space)), space.shape))
        circles_seen.append(
            ((2 * j - beyond + 0.5) * block - 0.5, (2 * i - beyond + 0.5) * block - 0.5, radii[k] * block)
        )
        # the next one is another circle
        space[max(0, k - 3) : k + 4, max(0, i - 4) : i + 5, max(0, j - 4) : j + 5] = -np.inf
    return circles_seen


def _edge_elements(small: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], Array, Array]:
    """Row, column and unit gradient (cosine, sine) of thinned edges, by the structure tensor of all channels."""
    gx = ndimage.gaussian_filter(small, (0, 1, 1), order=(0, 0, 1))
    gy = ndimage.gaussian_filter(small, (0, 1, 1), order=(0, 1, 0))
    xx, yy, xy = (gx * gx).sum(axis=0), (gy * gy).sum(axis=0), (gx * gy).sum(axis=0)
    root = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    size, angle = np.sqrt(np.maximum(0.5 * (xx + yy + root), 0.0)), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    usual = np.sqrt(ndimage.gaussian_filter(size**2, 12.0)) + 0.02
    y, x = np.mgrid[: size.shape[0], : size.shape[1]]
    c, s = np.cos(angle), np.sin(angle)
    ahead, behind = (
        ndimage.map_coordinates(size, [y + k * s, x + k * c], order=1, mode="nearest") for k in (1.0, -1.0)
    )
    edge = (size >= ahead) & (size >= behind) & (size > 0.5 * usual) & (size > 0.02)
    v, u = np.nonzero(edge)
    return v, u, c[edge], s[edge]


# Curves.

_Curve = tuple[float, EdgeRing, Array]  # contrast, ring around it, curve from there


def _settled(channels: Array, radii_px: tuple[float, float] | None, count: int) -> list[_Curve]:
    """Curves around the best candidates, the clearest first."""
    rough: list[_Curve] = []
    for circle in circle_candidates(channels, radii_px, count):
        ring = EdgeRing(channels, circle, max(12.0, 0.05 * circle[2]), 1.0, 1.5)
        rough.append(_rated(*ring.moved(_climbed(ring, np.zeros(3), (6.0, 3.0)))))
        if len(rough) >= _SETTLED and max(one[0] for one in rough) > _OVERWHELMING * LEAST_CONTRAST:
            break
    rough.sort(key=lambda one: -one[0])
    settled_curves: list[_Curve] = []
    for one in rough[:_SETTLED]:
        # settling makes a curve clearer, but not by that much
        hopeless = settled_curves and one[0] < settled_curves[0][0] / _OVERWHELMING
        settled = one if hopeless else _joined(one[1])
        if settled:
            settled_curves.append(settled)
    settled_curves.sort(key=lambda one: -one[0])
    return [
        one
        for i, one in enumerate(settled_curves)
        if not any(_same(one[1].circle, other[1].circle) for other in settled_curves[:i])
    ]


def _same(a: Circle, b: Circle) -> bool:
    """True for circles that share most of an edge: what lies beside the clearer one is no other outline."""
    return max(abs(x - y) for x, y in zip(a, b, strict=True)) < max(_SAME_PX, _SAME * a[2])


def _rated(ring: EdgeRing, curve: Array) -> _Curve:
    return ring.contrast(curve), ring, curve


def _climbed(ring: EdgeRing, start: Array, widths_px: tuple[float, ...]) -> Array:
    """Curve with the most strength on it, blurred less and less, shape (5,)."""
    curve = start
    for width in widths_px:
        table = ndimage.gaussian_filter1d(ring.strength, width / ring.step_px, axis=1)

        def less(x: Array, table: Array = table) -> float:
            return -float(ring.along(table, CURVES[:, : len(x)] @ x).sum())

        steps = np.diag([width, width, width, 0.5 * width, 0.5 * width][: len(curve)])
        simplex = np.vstack([curve, curve + steps])
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-3, "maxiter": 400}
        curve = optimize.minimize(less, curve, method="Nelder-Mead", options=options).x
    return np.concatenate([curve, np.zeros(5 - len(curve))])


def _joined(ring: EdgeRing) -> _Curve | None:
    """Curve through the strongest edges around a ring, in a reach that narrows."""
    reach = max(16.0, 0.05 * ring.circle[2])
    curve = np.zeros(5)
    for _ in range(3):
        curve_or_none = _consensus(EdgeRing(ring.channels, ring.circle, reach), _NEAR_PX, 0)
        if curve_or_none is None:
            return None
        ring, curve = ring.moved(curve_or_none)
        reach = max(10.0, 0.7 * reach)
    return _rated(ring, curve)


def _clearer(best: _Curve) -> _Curve:
    """The best of a curve's neighbours: other consensus among near edges, and the climbed ones."""
    _, ring, curve = best
    for seed, (reach, near) in enumerate(((12.0, 1.5), (10.0, 1.0), (8.0, 1.0)), start=1):
        other = _consensus(EdgeRing(ring.channels, best[1].circle, reach), near, seed)
        if other is not None:
            best = max(best, _rated(*best[1].moved(other)), key=lambda one: one[0])
    for widths in ((3.0, 1.5), (1.5, 0.8)):
        _, ring, curve = best
        near_ring = EdgeRing(ring.channels, ring.circle, _NEAR_REACH_PX)
        best = max(best, _rated(*ring.moved(_climbed(near_ring, curve, widths))), key=lambda one: one[0])
    return best


def _consensus(ring: EdgeRing, near_px: float, seed: int) -> Array | None:
    """Robust fit from the circle through three edges that most edges are near, shape (5,)."""
    place, weight = ring.peaks
    have = np.flatnonzero(weight[:, 0] > 0.0)
    if len(have) < TURNS // 12:
        return None
    rng = np.random.default_rng(seed)  # part of the search, not noise: the same picture has the same answer
    turns = np.sort(rng.choice(have, (_DRAWS, 3)), axis=1)
    # a turn without an edge has no weight
    share = np.cumsum(weight, axis=1) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    which = np.minimum((rng.random((_DRAWS, 3, 1)) > share[turns]).sum(axis=-1), PEAKS - 1)
    gaps = np.diff(np.concatenate([turns, turns[:, :1] + TURNS], axis=1), axis=1)
    turns, which = (x[(gaps.max(axis=1) <= 0.75 * TURNS) & (gaps.min(axis=1) >= 0.04 * TURNS)] for x in (turns, which))
    if not len(turns):
        return None
    circles = np.linalg.solve(CURVES[turns, :3], place[turns, which][..., None])[..., 0]
    # a circle that leaves the ring has no edges there
    circles = circles[np.abs(circles).max(axis=1) <= 1.2 * ring.reach_px]
    best, most = None, -1.0
    for circle in circles:
        off = (place - (CURVES[:, :3] @ circle)[:, None]) / (2.0 * near_px)
        count = float((np.maximum(1.0 - off**2, 0.0) * weight).max(axis=1).sum())
        if count > most:
            best, most = circle, count
    if best is None:
        return None
    scales = tuple(near_px * k for k in (3.0, 2.0, 2.0, 1.0, 1.0, 1.0))
    return _least_squares(ring, np.concatenate([best, np.zeros(2)]), scales)[0]


def _least_squares(
    ring: EdgeRing, curve: Array, scales_px: tuple[float, ...], used: Array | None = None
) -> tuple[Array, Array]:
    """Curve through the edges near it, with Tukey's weights, and their distances from it, NaN for none."""
    place, weight = ring.peaks
    # the circle is free, the ellipse small
    prior = np.diag([1e-9, 1e-9, 1e-9, *[(_ELLIPSE * ring.circle[2]) ** -2] * 2])
    rows, w = np.arange(TURNS), np.zeros(TURNS)
    for scale in scales_px:
        off = place - (CURVES @ curve)[:, None]
        near = np.maximum(1.0 - (off / (2.0 * scale)) ** 2, 0.0) ** 2 * weight
        # the room is squeezed to edges inside the limb, not outside it: of edges alike, the outer one
        alike = near >= ring.alike * near.max(axis=1, keepdims=True)
        best = np.argmax(np.where(alike & (near > 0.0), place, -np.inf), axis=1)
        w = near[rows, best] if used is None else near[rows, best] * used
        curve = np.linalg.solve((CURVES.T * w) @ CURVES + prior, CURVES.T @ (w * place[rows, best]))
    return curve, np.where(w > 0.0, place[rows, best] - CURVES @ curve, np.nan)


def _measured(best: _Curve, next_contrast: float, block: int) -> BallCircle:
    """The curve by least squares, with the jackknife's covariance, in pixels of the whole picture."""
    contrast, ring, curve = best
    for _ in range(2):
        near = EdgeRing(ring.channels, ring.circle, _NEAR_REACH_PX)
        ring, curve = ring.moved(_least_squares(near, curve, _SCALES)[0])
    near = EdgeRing(ring.channels, ring.circle, _NEAR_REACH_PX)
    return _with_covariance(
        contrast, near, curve, _SCALES, (_FLOOR_PX,) * 3, block, contrast / max(next_contrast, 1e-9)
    )


def _with_covariance(
    contrast: float,
    ring: EdgeRing,
    curve: Array,
    scales_px: tuple[float, ...],
    floor_px: tuple[float, float, float],
    block: int,
    lead: float,
) -> BallCircle:
    curve, off = _least_squares(ring, curve, scales_px)
    left: list[Array] = []
    for sector in range(_SECTORS):
        used = np.ones(TURNS)
        used[sector * TURNS // _SECTORS : (sector + 1) * TURNS // _SECTORS] = 0.0
        left.append(_least_squares(ring, curve, scales_px[1:], used)[0])
    spread = np.array(left)[:, [1, 2, 0]]
    spread = spread - spread.mean(axis=0)
    covariance = (_SECTORS - 1) / _SECTORS * spread.T @ spread + np.diag(floor_px) ** 2
    ring, curve = ring.moved(curve)
    u, v, radius = ring.circle
    whole = ((u + 0.5) * block - 0.5, (v + 0.5) * block - 0.5, radius * block)
    ellipse = (float(curve[3]) * block, float(curve[4]) * block)
    return BallCircle(whole, ellipse, covariance * block**2, contrast, lead, off * block)


# Limbs.


def limb_beside_circle(light: NDArray[Any], near: Circle, blur_px: float) -> BallCircle | None:
    """The limb of a reflection beside a circle, where the room's edges inside it may be the clearer ones.

    Long pictures are made smaller first, to at most 2048 px.

    Parameters
    ----------
    light : array, shape (H, W) or (H, W, 3), linear
        NaN where pixels are full.
    near : Circle
        Within 24 px of the limb.
    blur_px : float
        As `LimbRing.blur_px`.
    """
    block = max(1, math.ceil(max(light.shape[:2]) / (2 * LONGEST_PX)))
    # squares of pixels blur as a square of their side does; the pixel's own 1/12 is in both
    blur_px = math.sqrt(blur_px**2 / block**2 + (1.0 - 1.0 / block**2) / 12.0)
    small = shrunk_picture(light, block)
    channels = small[None] if small.ndim == 2 else np.moveaxis(small, -1, 0)
    u, v, radius = near
    start = ((u + 0.5) / block - 0.5, (v + 0.5) / block - 0.5, radius / block)
    ring, curve = LimbRing(channels, start, blur_px=blur_px), np.zeros(5)
    for seed, (reach, px) in enumerate(_LIMB_ROUNDS):
        ring = LimbRing(channels, ring.circle, reach, blur_px=blur_px)
        consensus = _consensus(ring, px, seed)
        if consensus is None:
            return None
        ring, curve = ring.moved(consensus, blur_px=blur_px)
    last = LimbRing(channels, ring.circle, reach, blur_px=blur_px)
    scales = (2.0 * px, px, px)
    limb = _with_covariance(ring.contrast(curve), last, curve, scales, _LIMB_FLOOR_PX, block, math.inf)
    if not limb.edges:
        return None
    shared = _LIMB_SHARED * float(np.nanstd(limb.off_px))
    return replace(limb, covariance_px2=limb.covariance_px2 + shared**2 * np.eye(3))
