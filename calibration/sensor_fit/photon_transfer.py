"""Photon transfer of raw frames (`fit_transfer`): gain, response curve, PRNU, full well, linearity; all with sigmas.

Dark current and read noise are in `transfer_dark`. Terms and equations are those of EMVA 1288, release 4.0. Frame by
frame, the variance of a level against its mean has the slope K. The variance from pixel to pixel of the mean frame is
the fixed pattern, after what temporal noise adds has been taken off. Five things differ:

* Whether the line is straight is asked, and a response that bends is fitted: see `response_fit`.
* Rounding at a noise below half a code has its exact moments: see `block_sums`.
* Shading of lamp and lens is removed by a mean over 5 x 5 pixels of one filter; 24/25 of white noise remain.
* Sigmas come from a jackknife over blocks of pixels: all is estimated again without one.
* Whether the frames are raw ones is asked: see `noise_likeness`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.calibration.sensor_fit.block_sums import jackknife_sigma
from phibench.calibration.sensor_fit.capture_folder import Capture, CaptureError
from phibench.calibration.sensor_fit.noise_likeness import raw_noise
from phibench.calibration.sensor_fit.response_fit import (
    LightLevel,
    NoiseOfLevel,
    Response,
    fit_linearity,
    fit_response,
)
from phibench.calibration.sensor_fit.transfer_dark import ROUNDING_DN, DarkTransfer
from phibench.calibration.sensor_fit.transfer_frames import FilterLevel, TransferFrames
from phibench.scenes.frames import Array

_MARGIN_SIGMAS = 6.0  # a level is used if so many deviations of its noise lie below saturation
_MOST_HIDDEN_DN, _HIDDEN_DOUBT_DN2 = 0.2, 0.005  # of such a noise, and of its variance by the levels' line
_NARROW_DN = 0.4  # noise below it does not smooth the steps of codes: 1 % of a code is left of them
_WHITE_DN = 0.7  # noise behind which rounding adds 1/12 DN^2 wherever a level lies
_DARKER, _DARKER_DN = 0.005, 1.0  # of the range: dark levels move by less
_FAINT = 0.02  # of the range: below, a level's noise over its signal says nothing
_OTHER = 2.0  # factor of the dark variance, beyond which dark and flat frames are not of one setting
_STRAIGHT = 0.5  # posterior share of the bent sets, below which a line is no curve
_LINE = 4  # levels that tell a line from a curve which grows faster
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
    return _Fit(TransferFrames(capture, capture.dark)).result()


class _Fit(DarkTransfer):
    """One fit; arrays have one entry for the whole and one for each block left out."""

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

    def _usable(self) -> list[FilterLevel]:
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

    def _reach(self, one: FilterLevel) -> float:
        s = one.sums
        # brightest pixel that is to be expected: noise and fixed pattern together
        return float(s.mean_dn[0] + _MARGIN_SIGMAS * np.sqrt(s.temporal_dn2[0] + max(s.spatial_dn2[0], 0.0)))

    @staticmethod
    def _is_wide(one: FilterLevel) -> bool:
        """Behind less noise, rounding hides or doubles small differences of pixels."""
        return bool(one.sums.temporal_dn2[0] > _NARROW_DN**2 + 1.0 / 12.0)

    def _plateau(self) -> list[FilterLevel]:
        """Levels at which the wells are full: hardly more noise than in the dark, below the last code."""
        if len(self.levels) < 2:
            return []
        bright = [level for level in self.levels if self._signal(level)[0] > _FAINT * self._range]
        usual = max((self._excess(level) / float(self._signal(level)[0]) for level in bright), default=0.0)
        flat = [
            level
            for level in bright
            if self._excess(level) < 0.02 * usual * self._signal(level)[0] and level.sums.full == 0.0
        ]
        # rounding hides the noise of faint levels, too
        noisy = max((float(self._signal(level)[0]) for level in bright if level not in flat), default=0.0)
        return [level for level in flat if self._signal(level)[0] > noisy]

    def _excess(self, one: FilterLevel) -> float:
        return float(one.sums.temporal_dn2[0] - self.dark.temporal_dn2[0])

    def _ceiling(self) -> float:
        flat = [float(level.sums.mean_dn[0]) for level in self._plateau()]
        return min([float(self.top), *flat])

    def _response(self, used: list[FilterLevel]) -> Response:
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
            response = fit_response(levels, self.dark_dn2, self._range, (0.0, most_dn2) if no_dark else None)
        except ValueError:
            raise self._no_growth() from None
        if response.sigma > float(response.gain[0]):
            raise CaptureError(
                f"{self.folder}: no response explains the noise of flat/, a straight line leaves "
                f"{response.straight_misfit:.3g} times its variance: take all levels with one gain and one setting"
            )
        if response.is_bent and not no_dark:
            self._refuse_other_settings(fit_response(levels, self.dark_dn2, self._range, (-np.inf, np.inf)))
        signal = np.array([float(level.signal_dn[0]) for level in levels])
        unknown = float(response.gain[0]) * self._unknown_black() * float(signal.sum() / np.sum(signal**2))
        if no_dark and response.is_bent:  # a line through levels that bend has another intercept
            other = fit_response(levels, self.dark_dn2, self._range)
            unknown = float(np.hypot(unknown, other.gain[0] - response.gain[0]))
        # D moves the gain by its own error; strong bends are not those of polynomials of three terms
        unknown = float(np.hypot(unknown, self.dark_doubt_dn2 * float(signal.sum() / np.sum(signal**2))))
        bend = abs(float(response.slope(np.asarray(signal.max()))) - 1.0) * response.is_bent
        self.bend_doubt = bend if self.seen.dark_image.lopsided_dn else max(bend - _STRONG, 0.0)
        by_means = self.widths.averaged - 1.0
        self.gain_doubt = float(np.hypot.reduce([unknown / float(response.gain[0]), self.bend_doubt, by_means]))
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
        if free.bent > _STRAIGHT or free.refused or _OTHER**-1.0 < free.dark_dn2 / max(dark_dn2, 1e-9) < _OTHER:
            return
        if free.dark_dn2 < 0.0 and free.levels < _LINE:
            return
        raise CaptureError(
            f"{self.folder}: the levels' noise lies on a straight line that starts at {free.dark_dn2:.3g} DN^2, and "
            f"dark frames have {dark_dn2:.3g}: take both with one gain and one black level, and "
            "give single frames for both, not means"
        )

    def _raw_noise(self, used: list[FilterLevel]) -> None:
        """Weigh the likeness of the levels' noise."""
        used = [level for level in used if self._is_wide(level)]
        partly = {level.name for level in self.levels if level not in used}  # some filters are saturated
        likeness = {one.name: one.likeness for one in used if one.likeness is not None and one.name not in partly}
        if not likeness:
            return
        if any(one.jpeg for one in likeness.values()):
            raise CaptureError(
                f"{self.folder}: terms of 8 x 8 pixels lie on steps: the frames passed through JPEG or a video codec, "
                "which changes noise and black; give raw frames as the converter wrote them"
            )
        white = [level for level in used if level.sums.temporal_dn2[0] > _WHITE_DN**2 + 1.0 / 12.0]
        uneven = [level.sums.uneven(self.dark) for level in white] or [(0.0, 1.0)]
        told = raw_noise(list(likeness.values()), uneven, self.common.seen_row_dn2)
        if told.not_raw:
            raise CaptureError(f"{self.folder}: {told.finding}; give raw frames as the converter wrote them")
        self.noise_doubt, self.gain_doubt = told.doubt, float(np.hypot(self.gain_doubt, told.doubt))
        if told.doubt:
            self.black_doubt = float(np.hypot(self.black_doubt, ROUNDING_DN))  # of a program that rounds again
        if told.finding:
            self.findings["noise"] = f"{told.finding}; the sigma of the gain is widened by it"

    def _no_growth(self) -> CaptureError:
        return CaptureError(
            f"{self.folder}: the noise of flat/ does not grow with its level; are these raw frames, without a curve?"
        )

    def _prnu(self, used: list[FilterLevel], response: Response) -> None:
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
        levels: dict[str, list[FilterLevel]] = {}
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

    def _ratios(self, used: list[FilterLevel]) -> tuple[float, ...]:
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
