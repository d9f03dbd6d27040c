"""Photon transfer of raw frames: gain, noise, fixed pattern, dark current and full well, each with its sigma.

Terms and equations are those of EMVA 1288, release 4.0. The variance from frame to frame of a level against its mean
has the slope K. The variance from pixel to pixel of the mean frame is the fixed pattern, after what temporal noise adds
has been taken off. Three things differ:

* Rounding at a noise below half a code adds neither 1/12 DN^2 nor nothing. Its exact moments are taken: the mean, the
  temporal and the spatial variance of a rounded Gaussian whose place between two codes has the spread of the DSNU.
* Shading of lamp and lens is removed by a mean over 5 x 5 pixels of one filter. Of white noise 24/25 of the variance
  remain.
* Sigmas come from a jackknife over blocks of pixels: everything is estimated again without one block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import root
from scipy.special import ndtr

from phibench.estimator.sensor_fit.capture_folder import Capture, CaptureError, FrameGroup
from phibench.scenes.frames import Array

_BLOCKS = 8  # along each side; sigma of sigma is 1 / sqrt(2 x 63) = 9 %
_BOX = 5  # pixels of one filter
_MARGIN_SIGMAS = 6.0  # a level is used if so many deviations of its noise lie below saturation
_HIDDEN_DN = 0.15  # noise below it leaves too few codes to be told from rounding
_SHAPE = "16 pixels or more of each filter along both sides are needed"


@dataclass(frozen=True)
class BlockSums:
    """Sums over the pixels of one filter of one level: shape (blocks,), or (blocks + 1,) of the jackknife.

    Attributes
    ----------
    pixels : count
    mean : sum of the pixels' means, DN
    temporal : sum of the pixels' variances from frame to frame, DN^2
    spatial : sum of squares of the pixels' means after shading is removed, DN^2
    frames : number of frames
    full : share of values at the last code
    """

    pixels: Array
    mean: Array
    temporal: Array
    spatial: Array
    frames: int
    full: float

    def jackknife(self) -> BlockSums:
        """Totals: first of all blocks, then without each one."""

        def totals(x: Array) -> Array:
            return np.concatenate([[x.sum()], x.sum() - x])

        pixels, mean, temporal, spatial = (totals(x) for x in (self.pixels, self.mean, self.temporal, self.spatial))
        return BlockSums(pixels, mean, temporal, spatial, self.frames, self.full)

    @property
    def mean_dn(self) -> Array:
        """Mean."""
        return self.mean / self.pixels

    @property
    def temporal_dn2(self) -> Array:
        """Variance from frame to frame."""
        return self.temporal / self.pixels

    @property
    def spatial_dn2(self) -> Array:
        """Variance of the fixed pattern."""
        return self.spatial / self.pixels - self.temporal_dn2 / self.frames


def block_sums(frames: NDArray[Any], top_dn: int) -> BlockSums:
    """Sums of one filter's pixels, shape (n, h, w), n >= 2."""
    values = frames.astype(float)
    pixel_mean = values.mean(axis=0)
    # flicker of the lamp moves all pixels of a frame
    values -= (values.mean(axis=(1, 2)) - pixel_mean.mean())[:, None, None]
    temporal = values.var(axis=0, ddof=1)
    rough = pixel_mean - uniform_filter(pixel_mean, _BOX, mode="reflect")
    half, n = _BOX // 2, len(frames)
    inner = (slice(half, -half),) * 2
    spatial = rough[inner] ** 2 / (1.0 - 1.0 / _BOX**2)
    pixels, mean, noise = (_by_blocks(x[inner]) for x in (np.ones_like(pixel_mean), pixel_mean, temporal))
    return BlockSums(pixels, mean, noise, _by_blocks(spatial), n, float((frames >= top_dn).mean()))


def _by_blocks(values: Array) -> Array:
    """Sums over blocks, shape (blocks,), of an image."""
    rows, columns = (np.linspace(0, side, _BLOCKS + 1).astype(int)[:-1] for side in values.shape)
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()


def row_variance(frames: NDArray[Any]) -> tuple[float, float]:
    """Variance of row noise, DN^2, with its sigma: that of row means from frame to frame, less the pixels' share."""
    values = frames.astype(float)
    values = values - values.mean(axis=0)
    values -= values.mean(axis=(1, 2), keepdims=True)
    n, h, w = values.shape
    freedom = n / (n - 1) * h / (h - 1)
    rows = float((values.mean(axis=2) ** 2).mean()) * freedom
    white = float(values.var()) * freedom / w
    return rows - white, rows * float(np.sqrt(2.0 / ((n - 1) * (h - 1))))


# -- rounding --------------------------------------------------------------------------------------------------------


def rounded_moments(mean: float, temporal_sd: float, spatial_sd: float) -> Array:
    """(mean, temporal variance, spatial variance), DN, of values rounded to codes.

    A pixel's mean is Gaussian about `mean` with `spatial_sd`; its values are Gaussian about that with `temporal_sd`.
    """
    z = np.linspace(-5.0, 5.0, 201)
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


def before_rounding(sums: BlockSums) -> Array:
    """(mean, temporal variance, spatial variance) of dark frames before rounding, shape (replicates, 3).

    Solved for the whole; the blocks' small changes follow by the derivative.
    """
    seen = np.stack([sums.mean_dn, sums.temporal_dn2, sums.spatial_dn2], axis=1)
    start = np.array([seen[0, 0], max(seen[0, 1] - 1.0 / 12.0, 0.02), max(seen[0, 2], 1e-4)])

    def model(x: Array) -> Array:
        return rounded_moments(x[0], float(np.sqrt(abs(x[1]))), float(np.sqrt(abs(x[2]))))

    solution = root(lambda x: model(x) - seen[0], start, method="hybr", tol=1e-9)
    found = np.abs(solution.x)
    if not solution.success and np.abs(solution.fun).max() > 1e-4:
        found = start
    steps = np.array([1e-3, 1e-3 * max(found[1], 1e-3), 1e-3 * max(found[2], 1e-3)])
    jacobian = np.stack([(model(found + d) - model(found - d)) / (2.0 * d.sum()) for d in np.diag(steps)], axis=1)
    return np.asarray(found + (seen - seen[0]) @ np.linalg.pinv(jacobian).T)


# -- fit -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TransferPoint:
    """One filter of one level, for the photon-transfer plot: signal and temporal variance less the dark's."""

    level: str
    site: str
    signal_dn: float
    variance_dn2: float
    used: bool


@dataclass(frozen=True)
class TransferFit:
    """Numbers of a raw sensor, by their names in `Sensor`, and for each of the others the reason.

    Attributes
    ----------
    values, sigmas : mapping of str to float
    reasons : mapping of str to str
    points : tuple of TransferPoint
    ratios : mean signal of R, G, B over that of G, of the flat's light; empty for pixels without filters
    """

    values: dict[str, float]
    sigmas: dict[str, float]
    reasons: dict[str, str]
    points: tuple[TransferPoint, ...]
    ratios: tuple[float, ...]


@dataclass(frozen=True)
class _Level:
    name: str
    site: str
    sums: BlockSums


def fit_transfer(capture: Capture) -> TransferFit:
    """Fit the raw frames of a capture.

    Raises
    ------
    CaptureError
        If there are no dark frames or no flat frames, or all levels are saturated.
    """
    if capture.dark is None:
        raise CaptureError(f"{capture.folder} has no dark frames: cap the lens and put 16 frames or more into dark/")
    if not capture.flats:
        raise CaptureError(f"{capture.folder} has no flat frames: put frames of an even surface into flat/LEVEL/")
    top = (1 << capture.notes.bits) - 1
    dark_frames = _frames(capture, capture.dark, top)
    levels = [
        _Level(group.name, site, block_sums(part, top).jackknife())
        for group in capture.flats
        for site, part in _sites(_frames(capture, group, top), capture.kind)
    ]
    timed = [
        (float(group.seconds or 0.0), block_sums(_frames(capture, group, top), top).jackknife())
        for group in capture.dark_exposures
    ]
    dark = block_sums(dark_frames, top).jackknife()
    return _Fit(capture, dark, levels, timed, row_variance(dark_frames), top).result()


def _frames(capture: Capture, group: FrameGroup, top: int) -> NDArray[Any]:
    frames = capture.stack(group)
    if int(frames.max()) > top:
        raise CaptureError(
            f"{capture.folder / group.name} has the code {int(frames.max())}, and {capture.notes.bits} bits end at "
            f"{top}: write `bits` into capture.toml, and give codes that are not scaled to 16 bits"
        )
    if min(frames.shape[1:]) < 32:
        raise CaptureError(f"{capture.folder / group.name}: {frames.shape[2]} x {frames.shape[1]} pixels; {_SHAPE}")
    return frames


def _sites(frames: NDArray[Any], kind: str) -> list[tuple[str, NDArray[Any]]]:
    """Pixels of each filter of an RGGB mosaic, or all of them."""
    if kind == "mono-raw":
        return [("mono", frames)]
    names = (("R", 0, 0), ("G1", 0, 1), ("G2", 1, 0), ("B", 1, 1))
    return [(name, frames[:, row::2, column::2]) for name, row, column in names]


class _Fit:
    """One fit; arrays have one entry for the whole and one for each block left out."""

    def __init__(
        self,
        capture: Capture,
        dark: BlockSums,
        levels: list[_Level],
        timed: list[tuple[float, BlockSums]],
        row: tuple[float, float],
        top: int,
    ) -> None:
        self.notes, self.folder, self.top = capture.notes, capture.folder, top
        self.dark, self.levels, self.timed, self.row = dark, levels, timed, row
        moments = before_rounding(dark)
        self.black, self.dark_dn2, self.offset_dn2 = moments.T
        self.values: dict[str, Array] = {}
        self.extra: dict[str, float] = {}
        self.reasons: dict[str, str] = {}

    def result(self) -> TransferFit:
        used = self._usable()
        gain = self._gain(used)
        self.values["gain_dn_per_e"] = gain / self.notes.analogue_gain
        dark_rate = self._dark_current(gain)
        self._noise(gain, dark_rate)
        self._prnu(used)
        self._full_well(gain)
        points = tuple(self._point(level, level in used) for level in self.levels)
        sigmas = {name: jackknife_sigma(x) for name, x in self.values.items()} | self.extra
        return TransferFit(
            {name: float(x[0]) for name, x in self.values.items()}, sigmas, self.reasons, points, self._ratios(used)
        )

    def _usable(self) -> list[_Level]:
        ceiling = self._ceiling()
        used = [one for one in self.levels if self._reach(one) < ceiling and self._signal(one)[0] > 0.0]
        if not used:
            raise CaptureError(
                f"{self.folder}: every level of flat/ is saturated or dark; take levels from 5 to 90 % of full scale"
            )
        return used

    def _signal(self, one: _Level) -> Array:
        return one.sums.mean_dn - self.dark.mean_dn

    def _reach(self, one: _Level) -> float:
        s = one.sums
        return float(s.mean_dn[0] + _MARGIN_SIGMAS * np.sqrt(s.temporal_dn2[0] + max(s.spatial_dn2[0], 0.0)))

    def _plateau(self) -> list[_Level]:
        """Levels at which the wells are full: hardly more noise than in the dark, below the last code."""
        ratios = [
            (one.sums.temporal_dn2[0] - self.dark.temporal_dn2[0]) / self._signal(one)[0]
            for one in self.levels
            if self._signal(one)[0] > 0.0
        ]
        usual = float(np.max(ratios)) if ratios else 0.0
        return [
            one
            for one in self.levels
            if one.sums.temporal_dn2[0] - self.dark.temporal_dn2[0] < 0.02 * usual * self._signal(one)[0]
            and one.sums.full == 0.0
            and self._signal(one)[0] > 0.0
            and len(self.levels) > 1
        ]

    def _ceiling(self) -> float:
        flat = [float(one.sums.mean_dn[0]) for one in self._plateau()]
        return min([float(self.top), *flat])

    def _gain(self, used: list[_Level]) -> Array:
        """K: slope of the temporal variance against the mean, through the dark frames' point."""
        signal = np.stack([self._signal(one) for one in used])
        spread = [float(np.sqrt(max(one.sums.spatial_dn2[0], 0.0))) for one in used]
        seen = np.stack([one.sums.temporal_dn2 for one in used])
        rounding = np.full(len(used), 1.0 / 12.0)
        weights = (seen[:, :1] ** -2.0) * np.array([[one.sums.pixels[0] * (one.sums.frames - 1)] for one in used])
        for _ in range(4):
            excess = seen - rounding[:, None] - self.dark_dn2
            gain = np.sum(weights * signal * excess, axis=0) / np.sum(weights * signal**2, axis=0)
            model = np.sqrt(np.maximum(gain[0] * signal[:, 0] + self.dark_dn2[0], 0.0))
            rounding = np.array(
                [
                    rounding_variance(float(one.sums.mean_dn[0]), s, d)
                    for one, s, d in zip(used, model, spread, strict=True)
                ]
            )
        if gain[0] <= 0.0:
            raise CaptureError(f"{self.folder}: the noise of flat/ does not grow with its level; are these raw frames?")
        return np.asarray(gain)

    def _dark_current(self, gain: Array) -> Array:
        """Dark current, electrons per second; 0 where no series tells."""
        at = self.notes.exposure_s
        self.values["black_level_dn"] = self.black
        times = [seconds for seconds, _ in self.timed] + ([at] if at is not None else [])
        if len(set(times)) < 2:
            self.reasons["dark_e_per_s"] = "needs dark-exposure/SECONDS with two exposure times or more"
            return np.zeros_like(gain)
        series = [before_rounding(sums) for _, sums in self.timed] + (
            [np.stack([self.black, self.dark_dn2, self.offset_dn2], axis=1)] if at is not None else []
        )
        counts = [sums.pixels[0] * sums.frames for _, sums in self.timed] + [self.dark.pixels[0] * self.dark.frames]
        weights = np.array([n / s[0, 1] for n, s in zip(counts, series, strict=False)])[:, None]
        t, means = np.array(times)[:, None], np.stack([s[:, 0] for s in series])
        centre = (weights * t).sum() / weights.sum()
        slope = np.sum(weights * (t - centre) * means, axis=0) / np.sum(weights * (t - centre) * t)
        rate = slope / gain
        self.values["dark_e_per_s"] = rate
        self.values["black_level_dn"] = np.sum(weights * (means - slope * t), axis=0) / weights.sum()
        return np.asarray(rate)

    def _noise(self, gain: Array, dark_rate: Array) -> None:
        if self.dark_dn2[0] < _HIDDEN_DN**2:
            reason = f"below {_HIDDEN_DN} DN: rounding hides it; take dark frames at a higher gain"
            self.reasons |= {"read_noise_e": reason, "dsnu_e": reason, "row_noise_e": reason}
            return
        row, row_sigma = self.row
        share = row if row > 4.0 * row_sigma else 0.0
        if share:
            self.values["row_noise_e"] = np.sqrt(share) / gain
            self.extra["row_noise_e"] = 0.5 * row_sigma / float(np.sqrt(share)) / float(gain[0])
        seconds = self.notes.exposure_s or 0.0
        square = (self.dark_dn2 - share) / gain**2 - dark_rate * seconds
        self.values["read_noise_e"] = np.sqrt(np.maximum(square, 0.0))
        pattern = self.offset_dn2 / gain**2
        if pattern[0] > 3.0 * jackknife_sigma(pattern):
            self.values["dsnu_e"] = np.sqrt(np.maximum(pattern, 0.0))
        else:
            self.reasons["dsnu_e"] = "lost in temporal noise and rounding: take more dark frames, at a higher gain"

    def _prnu(self, used: list[_Level]) -> None:
        signal = np.stack([self._signal(one) for one in used])
        pattern = np.stack([one.sums.spatial_dn2 for one in used]) - self.dark.spatial_dn2
        temporal = np.array([one.sums.temporal_dn2[0] / one.sums.frames for one in used])
        weights = (signal[:, 0] ** 2 / (np.maximum(pattern[:, 0], 0.0) + temporal)) ** 2
        square = np.sum(weights[:, None] * pattern / signal**2, axis=0) / weights.sum()
        if square[0] > 3.0 * jackknife_sigma(square):
            self.values["prnu"] = np.sqrt(np.maximum(square, 0.0))
        else:
            self.reasons["prnu"] = "lost in temporal noise: take more frames of the brighter levels"

    def _full_well(self, gain: Array) -> None:
        plateau = self._plateau()
        if plateau:
            level = np.mean([one.sums.mean_dn for one in plateau], axis=0)
            self.values["full_well_e"] = (level - self.dark.mean_dn) / gain
            return
        end_e = (self.top - float(self.black[0])) / float(gain[0])
        self.reasons["full_well_e"] = (
            f"the converter ends first, at {end_e:.0f} electrons"
            if any(one.sums.full > 0.0 for one in self.levels)
            else f"no level of flat/ is saturated; above {self._largest_e(gain):.0f} electrons"
        )

    def _largest_e(self, gain: Array) -> float:
        return max(float(self._signal(one)[0] / gain[0]) for one in self.levels)

    def _ratios(self, used: list[_Level]) -> tuple[float, ...]:
        of_site = {
            site: [float(self._signal(one)[0]) for one in used if one.site == site] for site in ("R", "G1", "G2", "B")
        }
        names = {one.name for one in used}
        whole = [n for n in names if sum(one.name == n for one in used) == len(of_site)]
        if not whole:
            return ()
        best = max(whole, key=lambda n: sum(float(self._signal(one)[0]) for one in used if one.name == n))
        level = {one.site: float(self._signal(one)[0]) for one in used if one.name == best}
        green = 0.5 * (level["G1"] + level["G2"])
        return level["R"] / green, 1.0, level["B"] / green

    def _point(self, one: _Level, used: bool) -> TransferPoint:
        excess = float(one.sums.temporal_dn2[0] - self.dark.temporal_dn2[0])
        return TransferPoint(one.name, one.site, float(self._signal(one)[0]), excess, used)


def jackknife_sigma(replicates: Array) -> float:
    """Standard deviation of an estimate, of its value and those without each block."""
    left_out = replicates[1:]
    n = len(left_out)
    return float(np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)))
