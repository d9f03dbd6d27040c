"""Edge spread of straight edges: blur, overshoot, and the unsharp mask that makes it; after ISO 12233.

A window holds one straight edge, some degrees away from rows, columns and diagonals. The edge's place in each row gives
its line; every pixel then has a distance from it, finer than the pixels themselves. The values against the distance are
the edge spread function. Measured on it, in codes: the distance from 10 to 90 % of the step, and the overshoot beyond
the plateaus, as a share of the step.

A model is fitted to the same values: a step in linear light, a Gaussian blur (lens and pixel together), bilinear
interpolation of an RGGB mosaic, tone curve, and an unsharp mask; a negative gain is denoising. Where the frames were
scaled after interpolation, its mean over the places of the mosaic is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares
from scipy.special import ndtr

from phibench.calibration.sensor_fit.noise_levels import Curve, decoded_by, encoded_by
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array

_WINDOW = 24  # pixels: an edge with both its plateaus
_STRIDE = 12  # half a window: no edge lies between two
_CONTRAST = 40.0  # codes; smaller steps say little
_LEAST, _MOST = 6.0, 247.0  # codes of plateaus that are surely not cut
_STRAIGHT_PX = 0.2  # rms of the places of rows about the line; sharp edges have steps there
_SLANT_DEG = (2.0, 30.0)  # from rows or columns; nearer, the pixels sample the edge at few distances
_REACH_PX = 7.0  # of the profile: sharpening and denoising of 5 x 5 end before
_PLATEAU_PX = 4.5  # from the edge
_STEP_PX = 0.25  # of the profile's bins
_FINE_PX = 0.08  # of the model's table, that is interpolated linearly
_MOST_EDGES = 60  # more tell no more: the model's own error remains
_BINOMIAL = {0: 0.5, 1: 0.25}
_TAPS = {1: (0.25, 0.5, 0.25), 2: (0.0625, 0.25, 0.375, 0.25, 0.0625)}
_MODEL = (0.008, 0.01, 0.02)
"""Errors of the model, one deviation, from fits of simulated frames: blur, px; gain of the unsharp mask; threshold,
relative. Noise before the tone curve and rounding are not in it."""
_THRESHOLD = (2.0, 500.0)  # codes: beyond, an edge does not tell it


@dataclass(frozen=True)
class Edge:
    """One edge: values against the distance from its line, pixels, positive on the bright side.

    Attributes
    ----------
    distance_px, codes : arrays of the pixels
    low, high : plateaus, codes
    normal : (rows, columns), unit vector towards the bright side
    places : place of each pixel in the mosaic: 2 (row % 2) + column % 2
    """

    distance_px: Array
    codes: Array
    low: float
    high: float
    normal: tuple[float, float]
    places: NDArray[np.int64]

    def profile(self) -> tuple[Array, Array]:
        """Distances and mean values, 0 to 1 between the plateaus, in bins of 1/4 pixel."""
        bins = np.arange(-_REACH_PX, _REACH_PX + 1e-9, _STEP_PX)
        place = np.digitize(self.distance_px, bins) - 1
        inside = (place >= 0) & (place < len(bins) - 1)
        counts = np.bincount(place[inside], minlength=len(bins) - 1)
        sums = np.bincount(place[inside], self.codes[inside], minlength=len(bins) - 1)
        filled = counts > 0
        centre = bins[:-1] + 0.5 * _STEP_PX
        values = (sums[filled] / counts[filled] - self.low) / (self.high - self.low)
        return centre[filled], values


@dataclass(frozen=True)
class EdgeMeasure:
    """Measures of one edge, or means over many with their standard errors.

    Attributes
    ----------
    rise_px : 10 to 90 % of the step
    overshoot, undershoot : beyond the bright and the dark plateau, shares of the step
    """

    rise_px: float
    overshoot: float
    undershoot: float


# -- finding edges ---------------------------------------------------------------------------------------------------


def edges_of(image: Array) -> Iterator[Edge]:
    """Straight edges of an image of codes, shape (h, w); windows without one are passed over."""
    h, w = image.shape
    for top in range(0, h - _WINDOW + 1, _STRIDE):
        for left in range(0, w - _WINDOW + 1, _STRIDE):
            window = image[top : top + _WINDOW, left : left + _WINDOW]
            if window.max() - window.min() < _CONTRAST:
                continue
            if (edge := edge_in(window)) is not None:
                yield edge


def edge_in(window: Array) -> Edge | None:
    """The edge of a window of codes, or None if it is not one straight slanted edge between two even plateaus."""
    steps = [np.abs(np.diff(gaussian_filter1d(window, 0.7, axis=axis), axis=axis)).sum() for axis in (0, 1)]
    turned = bool(steps[0] > steps[1])
    values = window.T if turned else window
    line = _line(values)
    if line is None:
        return None
    slope, at = line
    rows, columns = np.mgrid[0 : values.shape[0], 0 : values.shape[1]]
    distance = (columns - at - slope * rows) / np.hypot(1.0, slope)
    if np.mean(values[distance > 0.0]) < np.mean(values[distance < 0.0]):
        distance = -distance
    sign = 1.0 if distance[0, -1] > distance[0, 0] else -1.0
    across = sign * np.array([-slope, 1.0]) / np.hypot(1.0, slope)
    normal = (across[1], across[0]) if turned else (across[0], across[1])
    near = np.abs(distance) <= _REACH_PX
    dark, bright = (values[near & (side * distance >= _PLATEAU_PX)] for side in (-1.0, 1.0))
    if min(len(dark), len(bright)) < 20:
        return None
    low, high = float(np.mean(dark)), float(np.mean(bright))
    even = max(float(np.std(dark)), float(np.std(bright))) < 0.08 * (high - low)
    if not even or high - low < _CONTRAST or not (_LEAST < low and high < _MOST):
        return None
    places = 2 * (columns % 2) + rows % 2 if turned else 2 * (rows % 2) + columns % 2
    return Edge(distance[near], values[near], low, high, normal, places[near])


def _line(values: Array) -> tuple[float, float] | None:
    """Column = at + slope row of the edge: the middle of the step in each row."""
    smooth = gaussian_filter1d(values, 0.7, axis=1)  # noise would cross the middle several times
    low, high = np.percentile(smooth, (5.0, 95.0))  # both plateaus
    half = 0.5 * (low + high)
    places = []
    for row in smooth:
        crossings = np.flatnonzero((row[:-1] - half) * (row[1:] - half) < 0.0)
        if len(crossings) != 1:
            return None
        k = int(crossings[0])
        places.append(k + (half - row[k]) / (row[k + 1] - row[k]))
    rows = np.arange(len(places))
    slope, at = np.polyfit(rows, places, 1)
    rest = np.array(places) - at - slope * rows
    angle = np.degrees(np.arctan(abs(slope)))
    margin = _PLATEAU_PX + 2.0
    middle = at + slope * (len(places) - 1) / 2.0
    straight = float(np.std(rest)) < _STRAIGHT_PX and _SLANT_DEG[0] <= angle <= _SLANT_DEG[1]
    return (float(slope), float(at)) if straight and margin < middle < values.shape[1] - 1 - margin else None


# -- measures --------------------------------------------------------------------------------------------------------


def measure_edge(edge: Edge) -> EdgeMeasure:
    """Rise and overshoot of one edge."""
    return measure_profile(*edge.profile())


def measure_profile(at: Array, values: Array) -> EdgeMeasure:
    """Rise and overshoot of an edge spread function, 0 to 1 between its plateaus."""
    crossings = []
    for level in (0.1, 0.9):
        above = values >= level
        k = int(np.argmax(above)) if level == 0.1 else int(np.argmax(above & (at > -2.5)))
        k = max(k, 1)
        share = (level - values[k - 1]) / (values[k] - values[k - 1]) if values[k] != values[k - 1] else 0.0
        crossings.append(at[k - 1] + share * (at[k] - at[k - 1]))
    near = np.abs(at) < _PLATEAU_PX
    # means of three bins: the largest of many noisy bins is too large
    smooth = np.convolve(values, np.ones(3) / 3.0, mode="same")
    bright, dark = near & (at > 0.5), near & (at < -0.5)
    return EdgeMeasure(
        float(crossings[1] - crossings[0]), float(smooth[bright].max() - 1.0), float(-smooth[dark].min())
    )


# -- model -----------------------------------------------------------------------------------------------------------


Offsets = list[tuple[int, int, float]]
_TENT: Offsets = [(i, j, _BINOMIAL[abs(i)] * _BINOMIAL[abs(j)]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
_CROSS: Offsets = [(i, j, 0.25) for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1))]
_CORNERS: Offsets = [(i, j, 0.25) for i in (-1, 1) for j in (-1, 1)]
_BESIDE: Offsets = [(0, -1, 0.5), (0, 1, 0.5)]
_ABOVE: Offsets = [(-1, 0, 0.5), (1, 0, 0.5)]
_HERE: Offsets = [(0, 0, 1.0)]
_BY_PLACE = ((_HERE, _CROSS, _CORNERS), (_BESIDE, _HERE, _ABOVE), (_ABOVE, _HERE, _BESIDE), (_CORNERS, _CROSS, _HERE))
"""Where bilinear interpolation takes R, G and B from, by place of the mosaic."""
_MEAN = (_TENT, [*((i, j, 0.5 * w) for i, j, w in _CROSS), (0, 0, 0.5)], _TENT)


@dataclass(frozen=True)
class EdgeModel:
    """Known parts of the chain when edges are fitted.

    Parameters
    ----------
    curve, points : tone curve
    mosaic : "placed" (an RGGB mosaic, red at even row and column), "mean" (its mean over the places) or "none"
    smoothing : denoising that spares edges, or None
    """

    curve: Curve
    points: tuple[tuple[float, float], ...] | None = None
    mosaic: Literal["placed", "mean", "none"] = "placed"
    smoothing: Smoothing | None = None

    def codes(self, edge: Edge, x: EdgeNumbers) -> Array:
        """Codes of the edge's pixels."""
        fine = np.arange(-_REACH_PX - 2.0, _REACH_PX + 2.0, _FINE_PX)
        dark, bright = decoded_by(self.curve, np.array([x.low, x.high]), self.points)
        shares = {(i, j): ndtr((fine + _along(edge, i, j) - x.shift_px) / x.sigma_px) for i, j, _ in _TENT}

        def luma(planes: tuple[Offsets, Offsets, Offsets]) -> Array:
            total = np.zeros_like(fine)
            for weight, offsets in zip(LUMA, planes, strict=True):
                share = sum(w * shares[i, j] for i, j, w in offsets)
                total += weight * encoded_by(self.curve, dark + (bright - dark) * share, self.points)
            return total

        planes = _BY_PLACE if self.mosaic == "placed" else ((_HERE,) * 3 if self.mosaic == "none" else _MEAN,)
        curves = np.stack([luma(each) for each in planes])
        if x.sharpness != 0.0:
            blurred = sum(w * _moved(curves, fine, edge, i, j) for i, j, w in _TENT)
            curves = curves + x.sharpness * (curves - blurred)
        if self.smoothing is not None:
            curves = curves + self.smoothing.share * sum(
                w * _spared(_moved(curves, fine, edge, i, j) - curves, x.threshold_codes)
                for i, j, w in self.smoothing.offsets()
            )
        return _looked_up(curves, edge.places, edge.distance_px)


@dataclass(frozen=True)
class Smoothing:
    """Denoising of Y' as noise has told it: share, reach and share along columns of the binomial blur."""

    share: float
    reach_px: int = 1
    vertical: float = 1.0

    def offsets(self) -> Offsets:
        """Rows and columns of the neighbours, and their weights."""
        across = np.array(_TAPS[self.reach_px])
        alone = np.zeros(len(across))
        alone[self.reach_px] = 1.0
        down = self.vertical * across + (1.0 - self.vertical) * alone
        reach = range(-self.reach_px, self.reach_px + 1)
        weights = np.outer(down, across)
        return [(i, j, float(weights[i + self.reach_px, j + self.reach_px])) for i in reach for j in reach if i or j]


@dataclass(frozen=True)
class EdgeNumbers:
    """Numbers of one edge: blur, gain of the unsharp mask, plateaus, place; threshold of denoising, codes."""

    sigma_px: float
    sharpness: float
    low: float
    high: float
    shift_px: float
    threshold_codes: float = np.inf


def _spared(difference: Array, threshold_codes: float) -> Array:
    return np.asarray(difference * np.exp(-0.5 * (difference / threshold_codes) ** 2))


def _moved(curves: Array, fine: Array, edge: Edge, rows: int, columns: int) -> Array:
    """Curves of the neighbours of each place."""
    at = fine + _along(edge, rows, columns)
    if len(curves) == 1:
        return np.interp(at, fine, curves[0])[None]
    return np.stack([np.interp(at, fine, curves[_neighbour(place, rows, columns)]) for place in range(4)])


def _along(edge: Edge, rows: int, columns: int) -> float:
    return rows * edge.normal[0] + columns * edge.normal[1]


def _neighbour(place: int, rows: int, columns: int) -> int:
    return 2 * ((place // 2 + rows) % 2) + (place + columns) % 2


def _looked_up(curves: Array, places: NDArray[np.int64], at: Array) -> Array:
    """Values of the curve of each pixel's place, by straight lines."""
    t = np.clip((at + _REACH_PX + 2.0) / _FINE_PX, 0.0, curves.shape[1] - 1.001)
    k = t.astype(np.int64)
    which = places if len(curves) > 1 else np.zeros_like(places)
    share = t - k
    return np.asarray((1.0 - share) * curves[which, k] + share * curves[which, k + 1])


@dataclass(frozen=True)
class EdgeFit:
    """Blur and sharpening over many edges.

    Attributes
    ----------
    sigma_px, sharpness : means, with standard errors over the frames' edges
    measure, measure_sigma : means of rise and overshoot, with standard errors
    edges : number of edges
    profile : mean edge spread function: distances, values
    threshold_codes : of denoising, with its standard error; None without `EdgeModel.smoothing`, and where denoising
        spares no edge
    """

    sigma_px: float
    sigma_sigma_px: float
    sharpness: float
    sharpness_sigma: float
    measure: EdgeMeasure
    measure_sigma: EdgeMeasure
    edges: int
    profile: tuple[Array, Array]
    threshold_codes: tuple[float, float] | None = None


def fit_edges(edges: list[Edge], model: EdgeModel, sharpness: float | None = None) -> EdgeFit | str:
    """Blur and sharpening of all edges, or the reason why they do not tell.

    Parameters
    ----------
    sharpness : float, optional
        Gain of the unsharp mask, if noise has told it; free otherwise.
    """
    if len(edges) < 5:
        return f"{len(edges)} straight slanted edges found, 5 are needed: turn a printed edge by 5 to 10 degrees"
    # evenly out of all, so that every frame has its share
    chosen = [edges[k] for k in np.unique(np.linspace(0, len(edges) - 1, _MOST_EDGES).astype(int))]
    fits = np.array([_fit_one(edge, model, sharpness) for edge in chosen])
    good = np.isfinite(fits).all(axis=1)
    fits = fits[good]
    if len(fits) < 5:
        return "the edges found do not follow the model of a blurred step"
    measures = np.array([tuple(vars(measure_edge(edge)).values()) for edge in edges])
    centre, error = _robust(fits)
    mean, spread = _robust(measures)
    return EdgeFit(
        float(centre[0]),
        float(np.hypot(error[0], _MODEL[0])),
        float(centre[1]),
        float(np.hypot(error[1], _MODEL[1])),
        EdgeMeasure(*map(float, mean)),
        EdgeMeasure(*map(float, spread)),
        len(fits),
        _mean_profile(edges),
        _threshold(fits[:, 2:], centre, error),
    )


def _threshold(each: Array, centre: Array, error: Array) -> tuple[float, float] | None:
    """Threshold with its standard error; None if it lies beyond what edges tell."""
    if each.size == 0 or float(np.median(each)) > 0.5 * _THRESHOLD[1]:
        return None
    return float(centre[2]), float(np.hypot(error[2], _MODEL[2] * centre[2]))


def _fit_one(edge: Edge, model: EdgeModel, sharpness: float | None) -> tuple[float, ...]:
    """Blur, sharpness, and threshold of one edge; NaN where the fit ends at a bound."""
    free = sharpness is None
    start = [0.8, edge.low, edge.high, 0.0, *((0.0,) if free else ()), *((np.log(25.0),) if model.smoothing else ())]

    def numbers(x: Array) -> EdgeNumbers:
        threshold = float(np.exp(x[-1])) if model.smoothing else np.inf
        return EdgeNumbers(x[0], x[4] if sharpness is None else sharpness, x[1], x[2], x[3], threshold)

    def residuals(x: Array) -> Array:
        return model.codes(edge, numbers(x)) - edge.codes

    low, high = [0.15, 0.0, 0.0, -1.5], [4.0, 255.0, 255.0, 1.5]
    scale = [0.1, 1.0, 1.0, 0.1]
    for used, bounds, unit in ((free, (-1.0, 4.0), 0.1), (model.smoothing is not None, np.log(_THRESHOLD), 0.2)):
        if used:
            low.append(float(bounds[0]))
            high.append(float(bounds[1]))
            scale.append(unit)
    first = np.clip(np.array(start, float), low, high)
    done = least_squares(residuals, first, bounds=(low, high), x_scale=scale, max_nfev=25, loss="soft_l1")
    fitted = numbers(done.x)
    wanted = [fitted.sigma_px, fitted.sharpness]
    at_end = not 0.16 < fitted.sigma_px < 3.9 or abs(fitted.shift_px) > 1.4  # a fit at a bound says nothing
    if model.smoothing is not None:
        wanted.append(fitted.threshold_codes)
        at_end = at_end or fitted.threshold_codes < 1.01 * _THRESHOLD[0]
    return (np.nan,) * len(wanted) if at_end else tuple(map(float, wanted))


def _robust(values: Array) -> tuple[Array, Array]:
    """Means without what lies beyond 3.5 robust deviations, with their standard errors."""
    middle = np.median(values, axis=0)
    spread = 1.4826 * np.median(np.abs(values - middle), axis=0) + 1e-9  # equal values lie within
    inside = np.all(np.abs(values - middle) < 3.5 * spread, axis=1)
    kept = values[inside] if inside.sum() >= 5 else values
    return kept.mean(axis=0), kept.std(axis=0, ddof=1) / np.sqrt(len(kept))


def _mean_profile(edges: list[Edge]) -> tuple[Array, Array]:
    at = np.arange(-_REACH_PX + _STEP_PX, _REACH_PX - _STEP_PX / 2.0, _STEP_PX)
    return at, np.mean([np.interp(at, *edge.profile()) for edge in edges], axis=0)
