"""Statistics of raw frames: mean and noise by blocks with a jackknife, hot pixels, row and frame noise, rounding.

Rounding at a noise below half a code adds neither 1/12 DN^2 nor nothing. Its exact moments are taken: the mean, the
temporal and the spatial variance of a rounded Gaussian whose place between two codes has the spread of the DSNU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import least_squares
from scipy.special import ndtr

from phibench.scenes.frames import Array

_BLOCKS = 8  # along each side; sigma of sigma is 1 / sqrt(2 x 63) = 9 %
_BOX = 5  # pixels of one filter
_FULL_SHARE = 1e-3  # of values at the last code, from which on they take 0.1 % of the noise
_PART, _BRIGHTER, _FALLEN = 8, 1.1, 0.8  # blocks, their signal over the median ones', and the noise of full ones
_DEFECT_SPREADS, _LEAST_SPREAD_DN = 7.0, 0.1  # a Gaussian pixel is so far off once in 4e11
_ROW_SIGMAS = 4.0  # below it row noise is not told from none, and is left out
_DRIFT_FRAMES, _DRIFT_SHARE = 6, 0.75  # of the frames' variance by a line: jitter of 6 frames has it once in 40
_FRAME_SIGMAS = 8.0  # chi-square with 1 degree of freedom exceeds 1 + 8 sqrt 2 once in 2e3, with 15 once in 1e6


@dataclass(frozen=True)
class BlockSums:
    """Sums over the pixels of one filter of one level: shape (blocks,), or (blocks + 1,) of the jackknife.

    Attributes
    ----------
    pixels : count
    mean : sum of the pixels' means, DN
    temporal : sum of the pixels' variances from frame to frame, DN^2
    spatial : sum of squares of the pixels' means after shading is removed, DN^2
    shade : sum of squares of the shading, DN^2
    frames : number of frames
    full : share of values at the last code
    lowest, at_lowest : least code, and the share of values at it
    flicker_dn2 : variance of the mean of all frames, of the scatter of the frames' means
    """

    pixels: Array
    mean: Array
    temporal: Array
    spatial: Array
    shade: Array
    frames: int
    full: float
    lowest: int
    at_lowest: float
    flicker_dn2: float

    def jackknife(self) -> BlockSums:
        """Totals: first of all blocks, then without each one."""

        def totals(x: Array) -> Array:
            return np.concatenate([[x.sum()], x.sum() - x])

        sums = (totals(x) for x in (self.pixels, self.mean, self.temporal, self.spatial, self.shade))
        pixels, mean, temporal, spatial, shade = sums
        return replace(self, pixels=pixels, mean=mean, temporal=temporal, spatial=spatial, shade=shade)

    @property
    def mean_dn(self) -> Array:
        """Mean."""
        return self.mean / self.pixels

    @property
    def temporal_dn2(self) -> Array:
        """Variance from frame to frame."""
        return self.temporal / self.pixels

    @property
    def shade_dn2(self) -> Array:
        """Variance of the shading."""
        return self.shade / self.pixels - self.mean_dn**2

    @property
    def spatial_dn2(self) -> Array:
        """Variance of the fixed pattern."""
        return self.spatial / self.pixels - self.temporal_dn2 / self.frames

    def is_partly_full(self, dark: BlockSums) -> bool:
        """Part of the picture is saturated, at the converter's end or below it, where shading makes that part bright.

        Of the jackknife's totals. Hot pixels are full in the dark, too.
        """
        if self.full > dark.full + _FULL_SHARE:
            return True
        pixels, mean, noise = (x[0] - x[1:] for x in (self.pixels, self.mean, self.temporal))
        order = np.argsort(mean / pixels)
        (usual, bright), (usual_noise, bright_noise) = (
            [x[part].sum() / pixels[part].sum() for part in (order[len(order) // 2 :][:_PART], order[-_PART:])]
            for x in (mean, noise)
        )
        black = float(dark.mean_dn[0])
        return bool(bright - black > _BRIGHTER * (usual - black) and bright_noise < _FALLEN * usual_noise)

    def uneven(self, dark: BlockSums) -> tuple[float, float]:
        """Variance of noise over signal from block to block, relative, less what counting adds; and its own sigma.

        Of the jackknife's totals.
        """
        pixels, mean, noise = (x[0] - x[1:] for x in (self.pixels, self.mean, self.temporal))
        signal, excess = mean / pixels - dark.mean_dn[0], noise / pixels - dark.temporal_dn2[0]
        share = excess / np.maximum(signal, 1e-9)
        usual = float(np.median(share))
        if usual <= 0.0:
            return 0.0, 1.0
        spread = 1.4826 * float(np.median(np.abs(share - usual))) / usual  # no block of defects rules
        freedom = np.maximum(pixels * (self.frames - 1), 1.0)
        counted = float(np.median(2.0 / freedom * (noise / pixels / np.maximum(excess, 1e-9)) ** 2))
        return spread**2 - counted, 0.3 * counted  # of a median absolute deviation of 64: 13 % of sigma


def block_sums(frames: NDArray[Any], top_dn: int, defects: NDArray[np.bool_] | None = None) -> BlockSums:
    """Sums of one filter's pixels, shape (n, h, w), n >= 2, without `defects`, shape (h, w), and this level's own."""
    n = len(frames)
    # flicker of the lamp moves all pixels of a frame
    levels = np.array([float(frame.mean()) for frame in frames])
    total, square = np.zeros(frames.shape[1:]), np.zeros(frames.shape[1:])
    for frame, level in zip(frames, levels, strict=True):
        change = frame - level
        total += change
        square += change * change
    pixel_mean = total / n + levels.mean()
    temporal = (square - total * total / n) / (n - 1)
    own, mended = outliers(pixel_mean, float(np.median(temporal)) / n)
    kept = ~own if defects is None else ~(own | defects)
    pixel_mean = np.where(own, mended, pixel_mean)
    shade = uniform_filter(pixel_mean, _BOX, mode="reflect")
    rough = pixel_mean - shade
    half = _BOX // 2
    inner = (slice(half, -half),) * 2
    rough -= rough[inner].mean()  # shading that bends as much everywhere is no pattern
    spatial = rough[inner] ** 2 / (1.0 - 1.0 / _BOX**2) * kept[inner]
    pixels, mean, noise = (_by_blocks((x * kept)[inner]) for x in (np.ones_like(pixel_mean), pixel_mean, temporal))
    values = max(int(kept.sum()) * n, 1)
    full = sum(int((frame[kept] >= top_dn).sum()) for frame in frames) / values
    lowest = int(frames.min(axis=0)[kept].min(initial=top_dn))
    at_lowest = sum(int((frame[kept] == lowest).sum()) for frame in frames) / values
    flicker = float(levels.var(ddof=1)) / n
    squares = _by_blocks(spatial), _by_blocks((shade**2 * kept)[inner])
    return BlockSums(pixels, mean, noise, *squares, n, full, lowest, at_lowest, flicker)


def outliers(pixel_mean: Array, noise_dn2: float) -> tuple[NDArray[np.bool_], Array]:
    """Hot and dead pixels, and the image with the median of their neighbours in their place.

    Parameters
    ----------
    pixel_mean : array, shape (h, w)
        Means of one filter's pixels.
    noise_dn2 : float
        Variance of a mean by temporal noise.
    """
    rough = pixel_mean - uniform_filter(pixel_mean, _BOX, mode="reflect")
    spread = 1.4826 * float(np.median(np.abs(rough - np.median(rough))))
    least = max(spread, float(np.sqrt(noise_dn2)), _LEAST_SPREAD_DN)
    found, mended = np.zeros(pixel_mean.shape, bool), pixel_mean.copy()
    rows, columns = np.nonzero(np.abs(rough) > _DEFECT_SPREADS / 2 * least)
    reach = np.arange(-(_BOX // 2), _BOX // 2 + 1)
    for at in np.array_split(np.arange(len(rows)), len(rows) // 100_000 + 1):
        v = np.clip(rows[at, None, None] + reach[:, None], 0, pixel_mean.shape[0] - 1)
        u = np.clip(columns[at, None, None] + reach, 0, pixel_mean.shape[1] - 1)
        usual = np.median(pixel_mean[v, u].reshape(len(at), _BOX**2), axis=1)
        bad = np.abs(pixel_mean[rows[at], columns[at]] - usual) > _DEFECT_SPREADS * least
        found[rows[at][bad], columns[at][bad]], mended[rows[at][bad], columns[at][bad]] = True, usual[bad]
    return found, mended


def _by_blocks(values: Array) -> Array:
    """Sums over blocks, shape (blocks,), of an image."""
    rows, columns = (np.linspace(0, side, _BLOCKS + 1).astype(int)[:-1] for side in values.shape)
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()


def jackknife_sigma(replicates: Array) -> float:
    """Standard deviation of an estimate, of its value and those without each block."""
    left_out = replicates[1:]
    n = len(left_out)
    return float(np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)))


@dataclass(frozen=True)
class CommonNoise:
    """Noise that rows, columns or whole frames of dark frames have in common.

    Attributes
    ----------
    row_dn2, row_sigma_dn2 : variance of row noise, with its sigma
    column_dn2, column_sigma_dn2 : the same of columns that jump from frame to frame
    frame_dn2, frame_sigma_dn2 : variance of whole frames' levels, with its sigma if nothing moved them
    drift_dn : half of what their level moves in one direction, from the first to the last frame; 0 where it jitters
    rows : number of rows
    """

    row_dn2: float
    row_sigma_dn2: float
    column_dn2: float
    column_sigma_dn2: float
    frame_dn2: float
    frame_sigma_dn2: float
    drift_dn: float
    rows: int

    @property
    def seen_row_dn2(self) -> float:
        """Variance of row noise, or 0 where it does not stand out."""
        return self.row_dn2 if self.row_dn2 > _ROW_SIGMAS * self.row_sigma_dn2 else 0.0

    @property
    def seen_column_dn2(self) -> float:
        """Variance of column noise, or 0 where it does not stand out."""
        return self.column_dn2 if self.column_dn2 > _ROW_SIGMAS * self.column_sigma_dn2 else 0.0

    @property
    def seen_frame_dn2(self) -> float:
        """Variance of whole frames, or 0 where it does not stand out."""
        return self.frame_dn2 if self.frame_dn2 > _FRAME_SIGMAS * self.frame_sigma_dn2 else 0.0

    @property
    def level_dn2(self) -> float:
        """Variance of one frame's mean that its pixels do not explain."""
        return self.seen_frame_dn2 + self.seen_row_dn2 / self.rows


def common_noise(frames: NDArray[Any]) -> CommonNoise:
    """Common noise of dark frames, shape (n, h, w): that of row means and frame means, less the pixels' share."""
    n, h, w = frames.shape
    mean = np.zeros((h, w))
    for frame in frames:
        mean += frame / n
    rows = columns = square = 0.0
    for frame in frames:
        change = frame - mean
        change -= change.mean()
        rows += float((change.mean(axis=1) ** 2).mean()) / n
        columns += float((change.mean(axis=0) ** 2).mean()) / n
        square += float((change * change).mean()) / n
    own = rows * n / (n - 1) / (h - 1)  # of a frame's mean, where nothing moves whole frames
    rows, columns, square = rows * n / (n - 1) * h / (h - 1), columns * n / (n - 1) * w / (w - 1), square * n / (n - 1)
    levels = np.array([float(frame.mean()) for frame in frames])
    frame_dn2, own_sigma = float(levels.var(ddof=1)) - own, own * float(np.sqrt(2.0 / (n - 1)))
    at = np.arange(n) - (n - 1) / 2.0
    slope = float(at @ levels) / float(at @ at)
    steady = n >= _DRIFT_FRAMES and (slope * at).var() > _DRIFT_SHARE * levels.var()
    return CommonNoise(
        rows - square / w * h / (h - 1),
        rows * float(np.sqrt(2.0 / ((n - 1) * (h - 1)))),
        columns - square / h * w / (w - 1),
        columns * float(np.sqrt(2.0 / ((n - 1) * (w - 1)))),
        frame_dn2,
        own_sigma,
        abs(slope) * (n - 1) / 2.0 if steady and frame_dn2 > _FRAME_SIGMAS * own_sigma else 0.0,
        h,
    )


# -- rounding --------------------------------------------------------------------------------------------------------


def rounded_moments(mean: float, temporal_sd: float, spatial_sd: float) -> Array:
    """(mean, temporal variance, spatial variance), DN, of values rounded to codes.

    A pixel's mean is Gaussian about `mean` with `spatial_sd`; its values are Gaussian about that with `temporal_sd`.
    """
    z = np.linspace(-5.0, 5.0, 201)  # a normal law: 6e-7 lies beyond
    weights = np.exp(-0.5 * z * z)
    weights /= weights.sum()
    centre = mean + max(spatial_sd, 1e-9) * z
    s = max(temporal_sd, 1e-6)
    codes = np.arange(np.floor(centre.min() - 6.0 * s), np.ceil(centre.max() + 6.0 * s) + 1.0)
    upper = ndtr((codes[None] + 0.5 - centre[:, None]) / s)
    chance = np.diff(np.concatenate([np.zeros((len(z), 1)), upper], axis=1), axis=1)
    chance[:, -1] += 1.0 - upper[:, -1]
    first = chance @ (codes - mean)
    second = chance @ (codes - mean) ** 2
    total = float(weights @ first)
    return np.array([mean + total, float(weights @ (second - first**2)), float(weights @ (first - total) ** 2)])


def rounding_variance(mean: float, temporal_sd: float, spatial_sd: float) -> float:
    """Temporal variance that rounding adds, DN^2; 1/12 where the noise is above 0.7 codes."""
    if temporal_sd > 0.7:  # exp(-2 pi^2 0.49) = 6e-5 of a code^2 is left
        return 1.0 / 12.0
    return float(rounded_moments(mean, temporal_sd, spatial_sd)[1]) - temporal_sd**2


def rounding_doubt(temporal_sd: float, spatial_sd: float) -> float:
    """Standard deviation of `rounding_variance` over all places of a mean within a code: shading takes it to many."""
    if temporal_sd > 0.7:
        return 0.0
    ends = [rounding_variance(place, temporal_sd, spatial_sd) for place in (0.0, 0.5)]
    return abs(ends[1] - ends[0]) / 8.0**0.5  # a cosine's, of this height from end to end


def before_rounding(sums: BlockSums, frame_dn2: float = 0.0) -> Array:
    """(mean, temporal variance, spatial variance) of dark frames before rounding, shape (replicates, 3).

    Solved for the whole; the blocks' small changes follow by the derivative. Whole frames that jitter, `frame_dn2`
    after rounding, move across codes: they are put back into the noise, and taken off behind the solution.
    """
    seen = np.stack([sums.mean_dn, sums.temporal_dn2 + frame_dn2, sums.spatial_dn2], axis=1)
    start = np.array([seen[0, 0], max(seen[0, 1] - 1.0 / 12.0, 0.02), max(seen[0, 2], 1e-4)])  # inside the bounds

    def model(x: Array) -> Array:
        return rounded_moments(x[0], float(np.sqrt(x[1])), float(np.sqrt(x[2])))

    # a pattern that sampling noise takes below 0 has no solution: the nearest one is taken
    low = [-np.inf, 1e-6, 0.0]
    moments = least_squares(
        lambda x: model(x) - seen[0], start, bounds=(low, np.inf), x_scale=[1.0, 0.1, 0.1], xtol=1e-12
    ).x
    steps = np.diag([1e-3, 1e-3 * max(moments[1], 1e-3), 1e-3 * max(moments[2], 1e-3)])
    lower = np.maximum(moments - steps, low)
    jacobian = np.stack(
        [
            (model(moments + d) - model(least)) / (moments + d - least).sum()
            for d, least in zip(steps, lower, strict=True)
        ],
        axis=1,
    )
    replicates = moments + (seen - seen[0]) @ np.linalg.pinv(jacobian).T
    replicates[:, 1] -= frame_dn2 / jacobian[0, 0] ** 2  # rounding passes on less, or more, of a small shift
    return np.asarray(replicates)
