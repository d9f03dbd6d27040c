"""Dark frames of a photon transfer: black level, dark current, read and row noise, DSNU; stray light and cut codes."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from phibench.calibration.sensor_fit.block_sums import before_rounding, jackknife_sigma
from phibench.calibration.sensor_fit.dark_frames import LitPattern, light_by_noise, light_by_pattern, pattern
from phibench.calibration.sensor_fit.transfer_frames import FilterLevel, TransferFrames
from phibench.scenes.frames import Array

_ONE_CODE = 0.999  # of the dark values
_THIRD_CODE = 30.0  # values of a third code, below which the noise is that of any width
_CUT = 1e-3  # of dark values at the converter's lower end: below, their variance lacks less than 1 %
_SAME_DN, _UNEVEN_TIMES = 0.02, 25.0  # dark levels that are equal; mean square of what is left of their line
_LAW = 0.5  # of what rounding moves the mean of a Gaussian noise
_HIDDEN_DN = 0.15  # noise below it leaves too few codes to be told from rounding
ROUNDING_DN = 12.0**-0.5  # of a level that rounding hides


class DarkTransfer:
    """Fit of the dark; arrays have one entry for the whole and one for each block left out."""

    def __init__(self, seen: TransferFrames) -> None:
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

    def _signal(self, one: FilterLevel) -> Array:
        return one.sums.mean_dn - self.dark.mean_dn

    @property
    def _range(self) -> float:
        """Codes from black to the last."""
        return self.top - float(self.black[0])

    def _light_in_the_dark(self, used: list[FilterLevel], gain: float) -> None:
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

    @property
    def _is_cut(self) -> bool:
        return self._cut_share() > _CUT

    def _unknown_black(self) -> float:
        """Standard deviation of the black level that the dark frames' own codes leave: cut, or hidden by rounding."""
        if self._is_cut:
            return max(float(self.black[0]) - self.dark.lowest, ROUNDING_DN)
        return ROUNDING_DN if self.is_hidden else 0.0

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
                f"the dark level does not grow evenly with the stated times, up to {worst:.2g} DN off: check them"
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
