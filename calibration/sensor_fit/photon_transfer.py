"""Photon transfer of raw frames: gain, noise, fixed pattern, dark current and full well, each with its sigma.

Terms and equations are those of EMVA 1288, release 4.0. The variance from frame to frame of a level against its mean
has the slope K. The variance from pixel to pixel of the mean frame is the fixed pattern, after what temporal noise adds
has been taken off. Five things differ:

* Whether the line is straight is asked, and a response that bends is fitted: see `response_fit`.
* Rounding at a noise below half a code has its exact moments: see `block_sums`.
* Shading of lamp and lens is removed by a mean over 5 x 5 pixels of one filter; 24/25 of white noise remain.
* Sigmas come from a jackknife over blocks of pixels: all is estimated again without one.
* Whether the frames are raw ones is asked: see `noise_likeness`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from phibench.calibration.sensor_fit.block_sums import (
    BlockSums,
    CommonNoise,
    before_rounding,
    block_sums,
    common_noise,
    jackknife_sigma,
)
from phibench.calibration.sensor_fit.capture_folder import Capture, CaptureError, FrameGroup, of_filters, raw_frames
from phibench.calibration.sensor_fit.noise_likeness import NoiseLikeness, noise_likeness, raw_noise
from phibench.calibration.sensor_fit.response_fit import (
    LightLevel,
    NoiseOfLevel,
    Response,
    fit_linearity,
    fit_response,
    intercept,
)
from phibench.scenes.frames import Array

_MARGIN_SIGMAS = 6.0  # a level is used if so many deviations of its noise lie below saturation
_ONE_CODE = 0.999  # of the dark values
_HIDDEN_DN = 0.15  # noise below it leaves too few codes to be told from rounding
_NARROW_DN = 0.4  # noise below it does not smooth the steps of codes: 1 % of a code is left of them
_THIRD_CODE = 30.0  # values of a third code, below which the noise is that of any width
_ROUNDING_DN = 12.0**-0.5  # of a level that rounding hides
_CUT = 1e-3  # of dark values at the converter's lower end: below, their variance lacks less than 1 %
_DARKER, _DARKER_DN = 0.005, 1.0  # of the range: dark levels move by less
_FAINT = 0.02  # of the range: below, a level's noise over its signal says nothing
_BY_GAIN = ("gain_dn_per_e", "dark_e_per_s", "read_noise_e", "row_noise_e", "dsnu_e", "full_well_e")


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
    response : Response
    measured : mapping of str to (value, sigma, unit)
        Quantities that are no number of `Sensor`.
    findings : mapping of str to str
        Sentences about what does not agree with a straight sensor.
    """

    values: dict[str, float]
    sigmas: dict[str, float]
    reasons: dict[str, str]
    points: tuple[TransferPoint, ...]
    ratios: tuple[float, ...]
    response: Response
    measured: dict[str, tuple[float | list[float], float | list[float], str]]
    findings: dict[str, str]


@dataclass(frozen=True)
class _Level:
    name: str
    site: str
    sums: BlockSums
    light: tuple[float, str] | None = None  # photons or seconds
    seconds: float | None = None
    likeness: NoiseLikeness | None = None


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
    dark_frames = raw_frames(capture, capture.dark)
    levels = [level for group in capture.flats for level in _levels(capture, group, top)]
    exposures = [level for group in capture.exposures if len(group.files) > 1 for level in _levels(capture, group, top)]
    timed = [
        (float(group.seconds or 0.0), block_sums(raw_frames(capture, group), top).jackknife())
        for group in capture.dark_exposures
    ]
    dark = block_sums(dark_frames, top).jackknife()
    return _Fit(capture, dark, levels, exposures, timed, common_noise(dark_frames), top).result()


def _levels(capture: Capture, group: FrameGroup, top: int) -> list[_Level]:
    """One level for each filter."""
    light = (group.photons, "photons") if group.photons is not None else None
    if group.name.startswith("exposure/"):
        light = (group.seconds or 0.0, "seconds")
    frames = raw_frames(capture, group)
    likeness = noise_likeness(frames, 1 if capture.kind == "mono-raw" else 2)
    return [
        _Level(group.name, site, block_sums(pixels, top).jackknife(), light, group.seconds, likeness)
        for site, pixels in of_filters(frames, capture.kind)
    ]


class _Fit:
    """One fit; arrays have one entry for the whole and one for each block left out."""

    def __init__(
        self,
        capture: Capture,
        dark: BlockSums,
        levels: list[_Level],
        exposures: list[_Level],
        timed: list[tuple[float, BlockSums]],
        common: CommonNoise,
        top: int,
    ) -> None:
        self.notes, self.folder, self.top = capture.notes, capture.folder, top
        self.dark, self.levels, self.exposures = dark, levels, exposures
        self.timed, self.common = timed, common
        moments = before_rounding(dark, common.seen_frame_dn2)
        self.black, self.dark_dn2, self.offset_dn2 = moments.T
        self.is_hidden = self._is_hidden()
        if self.is_hidden:  # one or two codes fit to any narrow noise
            self.black, self.offset_dn2 = dark.mean_dn, np.zeros_like(self.black)
            self.dark_dn2 = np.maximum(dark.temporal_dn2 - 1.0 / 12.0, 0.0)
        self.values: dict[str, Array] = {}
        self.extra: dict[str, float] = {}
        # relative standard deviations, beside that of the response: of the gain, and of it by the noise's likeness
        self.gain_doubt, self.noise_doubt = 0.0, 0.0
        self.reasons: dict[str, str] = {}
        self.measured: dict[str, tuple[float | list[float], float | list[float], str]] = {}
        self.findings: dict[str, str] = {}

    def result(self) -> TransferFit:
        used = self._usable()
        response = self._response(used)
        self._raw_noise(used)
        self.values["gain_dn_per_e"] = response.gain / self.notes.analogue_gain
        dark_dn_per_s = self._dark_current(response.gain)
        self._noise(response.gain, dark_dn_per_s / response.gain)
        self._prnu(used, response)
        self._full_well(response)
        self._linearity(float(dark_dn_per_s[0]))
        points = tuple(
            TransferPoint(one.name, one.site, float(self._signal(one)[0]), self._excess(one), one in used)
            for one in self.levels
        )
        values = {name: float(x[0]) for name, x in self.values.items()}
        return TransferFit(
            values,
            {name: self._sigma(name, x, response) for name, x in self.values.items()},
            self.reasons,
            points,
            self._ratios(used),
            response,
            self.measured,
            self.findings,
        )

    def _sigma(self, name: str, x: Array, response: Response) -> float:
        """Of the blocks, of what frames and rows have in common, and of the choice of the response."""
        own = self.extra.get(name, 0.0)
        # numbers in electrons carry the relative error of the gain
        doubt = float(np.hypot(response.spread / float(response.gain[0]), self.gain_doubt))
        by_gain = abs(float(x[0])) * doubt if name in _BY_GAIN else 0.0
        return float(np.sqrt(jackknife_sigma(x) ** 2 + own**2 + by_gain**2))

    def _usable(self) -> list[_Level]:
        darkest = min(self.levels, key=lambda level: float(self._signal(level)[0]))
        if self._signal(darkest)[0] < -max(_DARKER * self._range, _DARKER_DN):
            raise CaptureError(
                f"{self.folder / darkest.name} is darker than dark/, {darkest.sums.mean_dn[0]:.1f} and "
                f"{self.dark.mean_dn[0]:.1f} DN: cap the lens for dark/, and look whether folders were exchanged"
            )
        ceiling = self._ceiling()
        used = [
            level
            for level in self.levels
            if self._reach(level) < ceiling
            and self._signal(level)[0] > 0.0
            and not level.sums.is_partly_full(self.dark)
        ]
        if not used and any(self._reach(level) < self.top for level in self._plateau()):
            raise self._no_growth()
        if not used:
            raise CaptureError(
                f"{self.folder}: every level of flat/ is saturated or dark; take levels from 5 to 90 % of full scale"
            )
        return used

    def _signal(self, one: _Level) -> Array:
        return one.sums.mean_dn - self.dark.mean_dn

    def _reach(self, one: _Level) -> float:
        s = one.sums
        # brightest pixel that is to be expected: noise and fixed pattern together
        return float(s.mean_dn[0] + _MARGIN_SIGMAS * np.sqrt(s.temporal_dn2[0] + max(s.spatial_dn2[0], 0.0)))

    @staticmethod
    def _is_wide(one: _Level) -> bool:
        """Behind less noise, rounding hides or doubles small differences of pixels."""
        return bool(one.sums.temporal_dn2[0] > _NARROW_DN**2 + 1.0 / 12.0)

    def _plateau(self) -> list[_Level]:
        """Levels at which the wells are full: hardly more noise than in the dark, below the last code."""
        if len(self.levels) < 2:
            return []
        bright = [level for level in self.levels if self._signal(level)[0] > _FAINT * self._range]
        usual = max((self._excess(level) / float(self._signal(level)[0]) for level in bright), default=0.0)
        return [
            level
            for level in bright
            if self._excess(level) < 0.02 * usual * self._signal(level)[0] and level.sums.full == 0.0
        ]

    def _excess(self, one: _Level) -> float:
        return float(one.sums.temporal_dn2[0] - self.dark.temporal_dn2[0])

    @property
    def _range(self) -> float:
        """Codes from black to the last."""
        return self.top - float(self.black[0])

    def _ceiling(self) -> float:
        flat = [float(level.sums.mean_dn[0]) for level in self._plateau()]
        return min([float(self.top), *flat])

    def _response(self, used: list[_Level]) -> Response:
        """K with the response: the temporal variance against the mean, through the dark frames' point."""
        levels = [
            NoiseOfLevel(
                level.name,
                self._signal(level),
                level.sums.temporal_dn2,
                float(level.sums.mean_dn[0]),
                float(np.sqrt(max(level.sums.spatial_dn2[0], 0.0))),
                float(level.sums.pixels[0] * (level.sums.frames - 1)),
            )
            for level in used
        ]
        no_dark = self._is_cut or self.is_hidden  # the dark frames' own variance says nothing
        dark_dn2 = intercept(levels) if no_dark and len({level.name for level in used}) > 1 else self.dark_dn2
        try:
            response = fit_response(levels, dark_dn2, self._range)
        except ValueError:
            raise self._no_growth() from None
        if response.sigma > float(response.gain[0]):
            raise CaptureError(
                f"{self.folder}: no response explains the noise of flat/, a straight line leaves "
                f"{response.straight_misfit:.3g} times its variance: take all levels with one gain and one setting"
            )
        signal = np.array([float(level.signal_dn[0]) for level in levels])
        unknown = float(response.gain[0]) * self._unknown_black() * float(signal.sum() / np.sum(signal**2))
        if no_dark and response.is_bent:  # a line through levels that bend has another intercept
            other = fit_response(levels, self.dark_dn2, self._range)
            unknown = float(np.hypot(unknown, other.gain[0] - response.gain[0]))
        self.gain_doubt = unknown / float(response.gain[0])
        if (said := response.finding()) is not None:
            self.findings["photon_transfer"] = said
        if response.is_bent:
            unit = f"x = y (1 + a1 u + a2 u^2 + a3 u^3), u = y / {self._range:.6g} DN"
            a, sigma = response.coefficients[0].tolist(), response.coefficient_sigmas.tolist()
            self.measured["response_coefficients"] = (a, sigma, unit)
            self.measured["straight_gain_dn_per_e"] = (
                response.straight_gain / self.notes.analogue_gain,
                response.straight_sigma / self.notes.analogue_gain,
                "DN per electron, of a straight line",
            )
        return response

    def _raw_noise(self, used: list[_Level]) -> None:
        """Weigh the likeness of the levels' noise."""
        used = [level for level in used if self._is_wide(level)]
        partly = {level.name for level in self.levels if level not in used}  # some filters are saturated
        likeness = {one.name: one.likeness for one in used if one.likeness is not None and one.name not in partly}
        if not likeness:
            return
        uneven = [level.sums.uneven(self.dark) for level in used]
        told = raw_noise(list(likeness.values()), uneven, self.common.seen_row_dn2)
        if told.not_raw:
            raise CaptureError(f"{self.folder}: {told.finding}; give raw frames as the converter wrote them")
        self.noise_doubt, self.gain_doubt = told.doubt, float(np.hypot(self.gain_doubt, told.doubt))
        if told.finding:
            self.findings["noise"] = f"{told.finding}; the sigma of the gain is widened by it"

    def _no_growth(self) -> CaptureError:
        return CaptureError(
            f"{self.folder}: the noise of flat/ does not grow with its level; are these raw frames, without a curve?"
        )

    @property
    def _is_cut(self) -> bool:
        return self._cut_share() > _CUT

    def _unknown_black(self) -> float:
        """Standard deviation of the black level that the dark frames' own codes leave: cut, or hidden by rounding."""
        if self._is_cut:
            return max(float(self.black[0]) - self.dark.lowest, _ROUNDING_DN)
        return _ROUNDING_DN if self.is_hidden else 0.0

    def _is_hidden(self) -> bool:
        """Rounding hides the noise of dark frames: it is small, or their values are two codes alone."""
        place = float(self.dark.mean_dn[0]) % 1.0
        spread = float(self.dark.temporal_dn2[0] + self.dark.spatial_dn2[0]) + self.common.seen_frame_dn2
        third = spread - place * (1.0 - place)  # two codes alone have no more than that
        values = float(self.dark.pixels[0]) * self.dark.frames
        return bool(self.dark_dn2[0] < _HIDDEN_DN**2 or third * values < _THIRD_CODE)

    def _dark_current(self, gain: Array) -> Array:
        """Growth of the dark level, DN per second; 0 where no series tells."""
        at = self.notes.exposure_s
        self.values["black_level_dn"] = self.black
        unknown = self._unknown_black()
        self.extra["black_level_dn"] = float(np.hypot(unknown, np.sqrt(self.common.level_dn2 / self.dark.frames)))
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
        # weighted straight line: dark current is its slope, the black level its value at 0 s
        centre = (weights * t).sum() / weights.sum()
        slope = np.sum(weights * (t - centre) * means, axis=0) / np.sum(weights * (t - centre) * t)
        black_share = (1.0 - (t - centre) * (weights * t).sum() / np.sum(weights * (t - centre) * t)) / weights.sum()
        slope_share = (t - centre) / np.sum(weights * (t - centre) * t)
        frames = np.array([sums.frames for _, sums in self.timed] + [self.dark.frames])[: len(t), None]
        jitter2 = self.common.level_dn2 / frames  # of each level as a whole
        slope_sigma = float(np.sqrt(np.sum((weights * slope_share) ** 2 * jitter2)))
        jitter = float(np.sqrt(np.sum((weights * black_share) ** 2 * jitter2)))
        self.extra["black_level_dn"] = float(np.hypot(unknown, jitter))
        self.values["black_level_dn"] = np.sum(weights * (means - slope * t), axis=0) / weights.sum()
        if slope[0] > 0.0:
            self.values["dark_e_per_s"] = slope / gain
            self.extra["dark_e_per_s"] = slope_sigma / float(gain[0])
        else:
            sigma = float(np.hypot(jackknife_sigma(slope), slope_sigma) / gain[0])
            self.reasons["dark_e_per_s"] = f"not above 0 in these frames, whose sigma is {sigma:.2g} electrons/s"
        return np.asarray(slope)

    def _noise(self, gain: Array, dark_rate: Array) -> None:
        if self._is_cut:
            reason = f"dark frames are cut at code {self.dark.lowest}; raise the camera's offset (brightness)"
            self.reasons |= {"read_noise_e": reason, "dsnu_e": reason, "row_noise_e": reason}
            self.findings["dark"] = (
                f"{reason}; the black level is too high by it, and the gain is that of the slope between the levels"
            )
            return
        if self.is_hidden:
            reason = f"below {_HIDDEN_DN} DN: rounding hides it; take dark frames at a higher gain"
            if self.dark.at_lowest > _ONE_CODE:
                self.findings["dark"] = (
                    f"dark frames hold the code {self.dark.lowest} alone: their noise is hidden, or they were cut there"
                )
            self.reasons |= {"read_noise_e": reason, "dsnu_e": reason, "row_noise_e": reason}
            return
        share, row_sigma = self.common.seen_row_dn2, self.common.row_sigma_dn2
        if self.common.seen_frame_dn2:
            value = float(np.sqrt(self.common.seen_frame_dn2)) / float(gain[0])
            freedom = 2.0 * (self.dark.frames - 1)
            self.measured["frame_noise_e"] = (value, value / float(np.sqrt(freedom)), "electrons, of whole frames")
        if share:
            self.values["row_noise_e"] = np.sqrt(share) / gain
            self.extra["row_noise_e"] = 0.5 * row_sigma / float(np.sqrt(share)) / float(gain[0])
        seconds = self.notes.exposure_s or 0.0
        # what rows share and the shot noise of the dark current are not the reading's
        square = (self.dark_dn2 - share) / gain**2 - dark_rate * seconds
        self.values["read_noise_e"] = np.sqrt(np.maximum(square, 0.0))
        pattern = self.offset_dn2 / gain**2
        if pattern[0] > 3.0 * jackknife_sigma(pattern):
            self.values["dsnu_e"] = np.sqrt(np.maximum(pattern, 0.0))
        else:
            self.reasons["dsnu_e"] = "lost in temporal noise and rounding: take more dark frames, at a higher gain"

    def _cut_share(self) -> float:
        """Share of the dark values below their lowest code, to which they were cut; 1 where most are at it.

        A converter cuts at 0, a program at any code.
        """
        if self.is_hidden and self.dark.lowest > 0:
            return 0.0
        if self.dark.at_lowest > 0.5:
            return 1.0
        spread = np.sqrt(max(float(self.dark_dn2[0] + self.offset_dn2[0]), 1e-6))
        # no more than are at that code: hot pixels have a spread that is no Gaussian's
        return min(float(ndtr((self.dark.lowest - 0.5 - float(self.black[0])) / spread)), self.dark.at_lowest)

    def _prnu(self, used: list[_Level], response: Response) -> None:
        used = [level for level in used if self._is_wide(level)] or used
        shown = np.stack([self._signal(level) for level in used])
        signal = np.stack([response.linear(y) / response.slope(y) for y in shown])  # dy / y' is the change of x
        # the pattern's variance grows with the square of a signal that shading makes uneven
        signal *= np.sqrt(1.0 + np.stack([np.maximum(level.sums.shade_dn2, 0.0) for level in used]) / shown**2)
        pattern = np.stack([level.sums.spatial_dn2 for level in used]) - self.dark.spatial_dn2
        temporal = np.array([level.sums.temporal_dn2[0] / level.sums.frames for level in used])
        # inverse variance of pattern / signal^2: a variance is known to its own size
        weights = (signal[:, 0] ** 2 / (np.maximum(pattern[:, 0], 0.0) + temporal)) ** 2
        squares = pattern / signal**2
        square = np.sum(weights[:, None] * squares, axis=0) / weights.sum()
        # a response that is not the sensor's gives another pattern at each level
        apart = float(np.sqrt(np.sum(weights * (squares[:, 0] - square[0]) ** 2) / weights.sum() / max(len(used), 1)))
        if self._is_cut and response.is_bent:
            self.reasons["prnu"] = "dark frames are cut, and levels bend: the signal is not known"
        elif square[0] > 3.0 * jackknife_sigma(square):
            self.values["prnu"] = np.sqrt(np.maximum(square, 0.0))
            # x / x' of a bend a_1 differs by a_1 u
            bend = response.unseen_bend * response.reach_dn / response.range_dn
            apart *= 0.5 / float(square[0]) if response.is_bent or response.refused else 0.0
            doubt = float(np.hypot.reduce([bend, self.noise_doubt, apart]))
            self.extra["prnu"] = float(self.values["prnu"][0]) * doubt
        else:
            self.reasons["prnu"] = "lost in temporal noise: take more frames of the brighter levels"

    def _full_well(self, response: Response) -> None:
        plateau = self._plateau()
        if plateau:
            level = np.mean([flat.sums.mean_dn for flat in plateau], axis=0)
            self.values["full_well_e"] = response.linear(level - self.dark.mean_dn) / response.gain
            return
        gain = float(response.gain[0])
        end_e = float(response.linear(np.asarray(self._range))) / gain
        largest = max(float(response.linear(np.asarray(self._signal(flat)[0]))) for flat in self.levels) / gain
        self.reasons["full_well_e"] = (
            f"the converter ends first, at {end_e:.0f} electrons"
            if any(flat.sums.full > 0.0 for flat in self.levels)
            else f"no level of flat/ is saturated; above {largest:.0f} electrons"
        )

    def _linearity(self, dark_dn_per_s: float) -> None:
        """Signal against stated light: of an exposure series, or of flat levels whose photons are known."""
        ceiling, start = self._ceiling(), self.notes.exposure_s or 0.0
        named = self.exposures or [level for level in self.levels if level.light is not None]
        levels: dict[str, list[_Level]] = {}
        for level in named:
            levels.setdefault(level.name, []).append(level)
        lights, unit = [], "seconds"
        for sites in levels.values():
            if any(self._reach(level) >= ceiling or level.light is None for level in sites):
                continue
            light, unit = sites[0].light or (0.0, unit)
            dark = dark_dn_per_s * ((sites[0].seconds or start) - start)
            signal = float(np.mean([self._signal(level)[0] for level in sites])) - dark
            flicker = float(np.mean([s.sums.flicker_dn2 for s in sites])) + self.common.level_dn2 / self.dark.frames
            lights.append(LightLevel(light, signal, float(np.sqrt(flicker))))
        linearity = fit_linearity(lights, unit)
        if linearity is None:
            return
        self.measured["linearity_error"] = (linearity.mean_percent, linearity.sigma_percent, f"percent, against {unit}")
        if (said := linearity.finding()) is not None:
            self.findings["linearity"] = said

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
