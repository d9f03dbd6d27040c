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
from numpy.typing import NDArray
from scipy.special import ndtr

from phibench.calibration.sensor_fit.block_sums import (
    BlockSums,
    CommonNoise,
    before_rounding,
    block_sums,
    common_noise,
    jackknife_sigma,
    outliers,
)
from phibench.calibration.sensor_fit.capture_folder import Capture, CaptureError, FrameGroup, of_filters, raw_frames
from phibench.calibration.sensor_fit.code_widths import CodeWidths
from phibench.calibration.sensor_fit.dark_frames import (
    DarkImage,
    LitPattern,
    dark_image,
    light_by_noise,
    light_by_pattern,
    pattern,
)
from phibench.calibration.sensor_fit.noise_likeness import NoiseLikeness, noise_likeness, raw_noise
from phibench.calibration.sensor_fit.response_fit import (
    LightLevel,
    NoiseOfLevel,
    Response,
    fit_linearity,
    fit_response,
)
from phibench.scenes.frames import Array

_MARGIN_SIGMAS = 6.0  # a level is used if so many deviations of its noise lie below saturation
_ONE_CODE = 0.999  # of the dark values
_HIDDEN_DN = 0.15  # noise below it leaves too few codes to be told from rounding
_MOST_HIDDEN_DN, _HIDDEN_DOUBT_DN2 = 0.2, 0.005  # of such a noise, and of its variance by the levels' line
_NARROW_DN = 0.4  # noise below it does not smooth the steps of codes: 1 % of a code is left of them
_WHITE_DN = 0.7  # noise behind which rounding adds 1/12 DN^2 wherever a level lies
_THIRD_CODE = 30.0  # values of a third code, below which the noise is that of any width
_ROUNDING_DN = 12.0**-0.5  # of a level that rounding hides
_CUT = 1e-3  # of dark values at the converter's lower end: below, their variance lacks less than 1 %
_DARKER, _DARKER_DN = 0.005, 1.0  # of the range: dark levels move by less
_FAINT = 0.02  # of the range: below, a level's noise over its signal says nothing
_SAME_DN, _UNEVEN_TIMES = 0.02, 25.0  # dark levels that are equal; mean square of what is left of their line
_LAW = 0.5  # of what rounding moves the mean of a Gaussian noise
_OTHER = 2.0  # factor of the dark variance, beyond which dark and flat frames are not of one setting
_STRONG = 0.2  # change of the response's slope that polynomials of three terms still follow
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
    codes: Array  # shares
    light: tuple[float, str] | None = None  # photons or seconds
    seconds: float | None = None
    likeness: NoiseLikeness | None = None
    image: Array | None = None  # of all filters


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
    return _Fit(_Frames(capture)).result()


class _Frames:
    """What is summed up of the frames, read group by group."""

    def __init__(self, capture: Capture) -> None:
        assert capture.dark is not None
        self.capture, self.top = capture, (1 << capture.notes.bits) - 1
        self.filters = 1 if capture.kind == "mono-raw" else 2
        self.widths = CodeWidths(self.top)
        frames = raw_frames(capture, capture.dark)
        self.dark_image, self.common = dark_image(frames), common_noise(frames)
        self.defects = outliers(self.dark_image.mean, float(np.median(self.dark_image.variance)) / len(frames))[0]
        self.dark = block_sums(frames, self.top, self.defects).jackknife()
        self.dark_codes = self.widths.add(frames, float(self.dark.temporal_dn2[0]))
        self.levels = [level for group in capture.flats for level in self._levels(group)]
        exposures = [group for group in capture.exposures if len(group.files) > 1]
        self.exposures = [level for group in exposures for level in self._levels(group)]
        self.timed = [
            (float(group.seconds or 0.0), block_sums(raw_frames(capture, group), self.top, self.defects).jackknife())
            for group in capture.dark_exposures
        ]

    def _levels(self, group: FrameGroup) -> list[_Level]:
        """One level for each filter."""
        light = (group.photons, "photons") if group.photons is not None else None
        if group.name.startswith("exposure/"):
            light = (group.seconds or 0.0, "seconds")
        frames = raw_frames(self.capture, group)
        likeness, levels = noise_likeness(frames, self.filters), []
        image = frames.mean(axis=0, dtype=np.float32)
        defects = of_filters(self.defects[None], self.capture.kind)
        for (site, pixels), (_, bad) in zip(of_filters(frames, self.capture.kind), defects, strict=True):
            sums = block_sums(pixels, self.top, bad[0]).jackknife()
            codes = self.widths.add(pixels, float(sums.temporal_dn2[0]))
            levels.append(_Level(group.name, site, sums, codes, light, group.seconds, likeness, image))
        return levels


class _Fit:
    """One fit; arrays have one entry for the whole and one for each block left out."""

    def __init__(self, seen: _Frames) -> None:
        self.seen = seen
        self.notes, self.folder, self.top = seen.capture.notes, seen.capture.folder, seen.top
        self.dark, self.levels, self.exposures = seen.dark, seen.levels, seen.exposures
        self.timed, self.common, self.widths = seen.timed, seen.common, seen.widths
        moments = before_rounding(self.dark, self.common.seen_frame_dn2)
        self.black, self.dark_dn2, self.offset_dn2 = moments.T
        self.is_hidden = self._is_hidden()
        # the law of a noise narrower than a code is not known to be Gauss's
        self.black_doubt = _LAW * abs(float(self.black[0] - self.dark.mean_dn[0]))
        if self.is_hidden:  # one or two codes fit to any narrow noise
            self.black, self.offset_dn2 = self.dark.mean_dn, np.zeros_like(self.black)
            self.dark_dn2 = np.maximum(self.dark.temporal_dn2 - 1.0 / 12.0, 0.0)
        shift, self.dark_doubt_dn2 = self.widths.doubt(seen.dark_codes)
        self.black_doubt = float(np.hypot.reduce([self.black_doubt, shift, seen.dark_image.lopsided_dn]))
        self.values: dict[str, Array] = {}
        self.extra: dict[str, float] = {}
        # relative standard deviations, beside that of the response: of the gain, and of it by the noise's likeness
        self.gain_doubt, self.noise_doubt = 0.0, 0.0
        self.dark_light = self.bend_doubt = 0.0
        self.reasons: dict[str, str] = {}
        self.measured: dict[str, tuple[float | list[float], float | list[float], str]] = {}
        self.findings: dict[str, str] = {}

    def result(self) -> TransferFit:
        used = self._usable()
        response = self._response(used)
        self._raw_noise(used)
        self.values["gain_dn_per_e"] = response.gain / self.notes.analogue_gain
        self._light_in_the_dark(used, float(response.gain[0]))
        dark_dn_per_s = self._dark_current(response.gain)
        self._noise(response.gain, dark_dn_per_s / response.gain)
        self._prnu(used, response)
        self._full_well(response)
        self._linearity(float(dark_dn_per_s[0]), response.gain)
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
                float(np.hypot(self.widths.doubt(level.codes)[1], _HIDDEN_DOUBT_DN2 * self.is_hidden)),
            )
            for level in used
        ]
        no_dark = self._is_cut or self.is_hidden  # the dark frames' own variance says nothing
        most_dn2 = _MOST_HIDDEN_DN**2 if self.is_hidden and not self._is_cut else np.inf
        try:
            response = fit_response(levels, self.dark_dn2, self._range, most_dn2 if no_dark else 0.0)
        except ValueError:
            raise self._no_growth() from None
        if response.sigma > float(response.gain[0]):
            raise CaptureError(
                f"{self.folder}: no response explains the noise of flat/, a straight line leaves "
                f"{response.straight_misfit:.3g} times its variance: take all levels with one gain and one setting"
            )
        if response.is_bent and not no_dark:
            self._refuse_other_settings(fit_response(levels, self.dark_dn2, self._range, np.inf))
        signal = np.array([float(level.signal_dn[0]) for level in levels])
        unknown = float(response.gain[0]) * self._unknown_black() * float(signal.sum() / np.sum(signal**2))
        if no_dark and response.is_bent:  # a line through levels that bend has another intercept
            other = fit_response(levels, self.dark_dn2, self._range)
            unknown = float(np.hypot(unknown, other.gain[0] - response.gain[0]))
        # D moves the gain by its own error; strong bends are not those of polynomials of three terms
        unknown = float(np.hypot(unknown, self.dark_doubt_dn2 * float(signal.sum() / np.sum(signal**2))))
        bend = abs(float(response.slope(np.asarray(signal.max()))) - 1.0) * response.is_bent
        self.bend_doubt = bend if self.seen.dark_image.lopsided_dn else max(bend - _STRONG, 0.0)
        self.gain_doubt = float(np.hypot(unknown / float(response.gain[0]), self.bend_doubt))
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

    def _refuse_other_settings(self, free: Response) -> None:
        """Refuse levels on a line that starts far from the dark frames' noise: a sensor that bends leaves it."""
        dark_dn2 = float(self.dark_dn2[0])
        if free.is_bent or free.refused or _OTHER**-1.0 < free.dark_dn2 / max(dark_dn2, 1e-9) < _OTHER:
            return
        raise CaptureError(
            f"{self.folder}: the levels' noise lies on a straight line that starts at {free.dark_dn2:.3g} DN^2, and dark "
            f"frames have {dark_dn2:.3g}: take both with one gain, and give single frames for both, not means"
        )

    def _raw_noise(self, used: list[_Level]) -> None:
        """Weigh the likeness of the levels' noise."""
        used = [level for level in used if self._is_wide(level)]
        partly = {level.name for level in self.levels if level not in used}  # some filters are saturated
        likeness = {one.name: one.likeness for one in used if one.likeness is not None and one.name not in partly}
        if not likeness:
            return
        if any(one.jpeg for one in likeness.values()):
            raise CaptureError(
                f"{self.folder}: terms of 8 x 8 pixels lie on steps: the frames passed through a JPEG, which changes "
                "noise and black; give raw frames as the converter wrote them"
            )
        white = [level for level in used if level.sums.temporal_dn2[0] > _WHITE_DN**2 + 1.0 / 12.0]
        uneven = [level.sums.uneven(self.dark) for level in white] or [(0.0, 1.0)]
        told = raw_noise(list(likeness.values()), uneven, self.common.seen_row_dn2)
        if told.not_raw:
            raise CaptureError(f"{self.folder}: {told.finding}; give raw frames as the converter wrote them")
        self.noise_doubt, self.gain_doubt = told.doubt, float(np.hypot(self.gain_doubt, told.doubt))
        if told.doubt:
            self.black_doubt = float(np.hypot(self.black_doubt, _ROUNDING_DN))  # of a program that rounds again
        if told.finding:
            self.findings["noise"] = f"{told.finding}; the sigma of the gain is widened by it"

    def _light_in_the_dark(self, used: list[_Level], gain: float) -> None:
        """Light, a drift or a curve in the dark frames, which the black level's sigma then holds."""
        said, dark = [], self.seen.dark_image
        lit = {level.name: level for level in used}
        whole = [one for name, one in lit.items() if all(x in used for x in self.levels if x.name == name)]
        light = light_by_noise(dark, gain)
        if len(whole) > 1:
            whole.sort(key=lambda one: float(self._signal(one)[0]))
            bright, faint = self._lit_pattern(whole[-1].name), self._lit_pattern(whole[0].name)
            light = max(light, light_by_pattern(dark, bright, faint, self.seen.filters))
        if light:
            said.append(f"dark frames hold light, {light:.2g} DN or more: cap the lens and darken the room")
        if dark.lopsided_dn:
            said.append(
                f"the noise of dark frames is lopsided, its mean {dark.lopsided_dn:+.2g} DN off its median: a curve or "
                "a cut about black, or few electrons of light"
            )
        if self.common.drift_dn:
            said.append(f"the level of dark frames drifts by {2.0 * self.common.drift_dn:.2g} DN: warm the camera up")
        self.dark_light = light
        self.black_doubt = float(np.hypot.reduce([self.black_doubt, light, self.common.drift_dn]))
        # slopes above and below black that differ by s move the mean by 0.4 s of the noise, and its variance by s of it
        lopsided = 2.5 * abs(dark.lopsided_dn) * float(np.sqrt(max(self.dark_dn2[0], 0.0)))
        uneven = self.widths.unevenness * max(float(self.dark_dn2[0]), 0.0)
        self.dark_doubt_dn2 = float(np.hypot.reduce([self.dark_doubt_dn2, light * gain, lopsided, uneven]))
        if (codes := self.widths.finding()) is not None:
            self.findings["codes"] = codes
        if said:
            self.findings["dark"] = "; ".join(said)

    def _lit_pattern(self, name: str) -> LitPattern:
        levels = [level for level in self.levels if level.name == name]
        image = levels[0].image
        assert image is not None
        noise = float(np.mean([level.sums.temporal_dn2[0] / level.sums.frames for level in levels]))
        signal = float(np.mean([self._signal(level)[0] for level in levels]))
        return LitPattern(pattern(image, self.seen.filters), signal, noise)

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
        unknown = float(np.hypot(self._unknown_black(), self.black_doubt))
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
        # three times or more tell whether the dark level grows evenly
        rest = (means - slope * (t - centre))[:, :1]
        rest = rest - (weights * rest).sum() / weights.sum()
        own = 1.0 / weights + jitter2 + _SAME_DN**2
        excess = float(np.sum(rest**2 / own)) / max(len(t) - 2, 1)
        if len(t) > 2 and excess > _UNEVEN_TIMES:
            worst = float(np.abs(rest).max())
            self.findings["dark-exposure"] = (
                f"the dark level does not grow evenly with the stated times, up to {worst:.2g} DN off: look at the times"
            )
            blurred = np.sqrt(np.sum(rest**2) / (len(t) - 2))
            jitter += float(blurred) * float(np.sqrt(np.sum((weights * black_share) ** 2)))
            slope_sigma += float(blurred) * float(np.sqrt(np.sum((weights * slope_share) ** 2)))
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
        columns = self.common.seen_column_dn2
        if columns:
            own = 0.5 * self.common.column_sigma_dn2 / float(np.sqrt(columns)) / float(gain[0])
            self.measured["column_noise_e"] = (float(np.sqrt(columns) / gain[0]), own, "electrons, of whole columns")
        if self.common.seen_frame_dn2:
            value = float(np.sqrt(self.common.seen_frame_dn2)) / float(gain[0])
            freedom = 2.0 * (self.dark.frames - 1)
            self.measured["frame_noise_e"] = (value, value / float(np.sqrt(freedom)), "electrons, of whole frames")
        if share:
            self.values["row_noise_e"] = np.sqrt(share) / gain
            self.extra["row_noise_e"] = 0.5 * row_sigma / float(np.sqrt(share)) / float(gain[0])
        seconds = self.notes.exposure_s or 0.0
        # what rows and columns share and the shot noise of the dark current are not the reading's
        square = (self.dark_dn2 - share - columns) / gain**2 - dark_rate * seconds
        self.values["read_noise_e"] = np.sqrt(np.maximum(square, 0.0))
        less = max(float(square[0]) - self.dark_doubt_dn2 / float(gain[0]) ** 2, 0.0)
        self.extra["read_noise_e"] = float(self.values["read_noise_e"][0] - np.sqrt(less))
        pattern = self.offset_dn2 / gain**2
        if pattern[0] > 3.0 * jackknife_sigma(pattern):
            self.values["dsnu_e"] = np.sqrt(np.maximum(pattern, 0.0))
            share = 1.0 if self.dark_light else self.dark_doubt_dn2 / float(self.dark_dn2[0])
            self.extra["dsnu_e"] = float(self.values["dsnu_e"][0]) * share
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
            # light in the dark is missing in the signal, and its pattern in the levels'
            by_light = self.dark_light / float(shown[:, 0].mean())
            by_pattern = 0.5 * self.dark.spatial_dn2[0] / np.maximum(pattern[:, 0], 1e-9).mean()
            dark = float(by_light + by_pattern) if self.dark_light else 0.0
            uneven = 0.5 * self.widths.unevenness
            doubt = float(np.hypot.reduce([bend, self.noise_doubt, apart, dark, self.bend_doubt, uneven]))
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

    def _linearity(self, dark_dn_per_s: float, gain: Array) -> None:
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
        if unit == "photons":
            self._quantum_efficiency([(one.light, one.signal_dn) for one in lights], gain)
        self.measured["linearity_error"] = (linearity.mean_percent, linearity.sigma_percent, f"percent, against {unit}")
        if (said := linearity.finding()) is not None:
            self.findings["linearity"] = said

    def _quantum_efficiency(self, levels: list[tuple[float, float]], gain: Array) -> None:
        """Electrons a photon: the mean of n frames, given as one, has n times the electrons."""
        light, signal = np.array(levels).T
        line = np.polynomial.Polynomial.fit(light, signal, 1, w=1.0 / signal).convert().coef[1]
        value = float(line / gain[0])
        sigma = value * float(np.hypot(jackknife_sigma(gain) / gain[0], self.gain_doubt))
        self.measured["quantum_efficiency"] = (value, sigma, "electrons per photon, on the mean of the filters")
        if value - 3.0 * sigma > 1.0:
            self.findings["quantum_efficiency"] = (
                f"{value:.3g} electrons a photon: the stated photons are too few, or each frame is a mean of several; "
                "the gain is then too small, and all numbers in electrons too large"
            )

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
