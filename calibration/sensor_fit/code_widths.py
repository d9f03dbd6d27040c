"""Code widths of the converter (DNL) from histograms; faults of altered codes: bytes, bit shifts, signs, drawn text.

The values of a level have a smooth distribution where its noise is about a code or more: that of the pixels' means,
widened by the noise. A code that comes w times as often as its neighbours let expect is w codes wide. Wide codes add
(w^2 - 1) / 12 DN^2 to the variance and move the mean by up to half of what they are too wide. Both go into sigma: a
table after the converter, a digital gain and a converter's own steps look alike.

The faults are those that programs make between the converter and the file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from phibench.scenes.frames import Array

_LEAST_DN, _MOST_DN = 0.75, 40.0  # noise: below, codes are not smooth by themselves; above, no width matters
_FINE = 8  # places in a code
_LOCAL = 1.5  # of the noise: what is uneven over more codes is light
_EXPECTED = 50.0  # counts, below which a code is not judged
_TAIL = 0.005  # of the values: at the ends of a level no code is judged
_EMPTY = 30.0  # counts that are to be expected of a code that is said to be missing
_SEEN, _SAID = 0.03, 0.1  # rms of the widths: that sigma takes, that is a finding
_SIGMAS = 6.0
_BY_TURNS = 0.1  # of 1/n


@dataclass
class CodeWidths:
    """Counts of codes of all levels, added one by one.

    Attributes
    ----------
    top : last code
    seen, expected : counts, and those of codes of one width, shape (top + 1,)
    """

    top: int
    seen: Array = field(init=False, repr=False)
    expected: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.seen, self.expected = np.zeros(self.top + 1), np.zeros(self.top + 1)

    def add(self, frames: NDArray[Any], temporal_dn2: float) -> Array:
        """Add one filter's frames, shape (n, h, w), and give the shares of its codes, shape (top + 1,)."""
        counts = sum(np.bincount(frame.ravel(), minlength=self.top + 1) for frame in frames) + np.zeros(self.top + 1)
        moved = float(np.var([float(frame.mean()) for frame in frames]))  # whole frames that jitter
        noise = max(temporal_dn2 + moved - 1.0 / 12.0, 0.0) ** 0.5
        shares = counts / counts.sum()
        low, high = np.flatnonzero(counts)[[0, -1]]
        if _LEAST_DN < noise < _MOST_DN and max(shares[low], shares[high]) < _TAIL:  # not cut
            below = np.cumsum(shares)
            inner = (below > _TAIL) & (below < 1.0 - _TAIL)
            expected = _smooth(frames, noise, self.top)
            width = _LOCAL * max(noise, 1.0)
            local = gaussian_filter1d(counts, width) / np.maximum(gaussian_filter1d(expected, width), 1e-12)
            self.seen[inner] += counts[inner]
            self.expected[inner] += (expected * local)[inner]
        return shares

    @property
    def _judged(self) -> Array:
        return np.asarray(self.expected > _EXPECTED)

    @property
    def widths(self) -> Array:
        """Width of each code, shape (top + 1,); 1 where the frames do not tell another one."""
        widths = np.ones(self.top + 1)
        if self.rms > _SEEN:
            judged = self._judged
            widths[judged] = self.seen[judged] / self.expected[judged]
        return widths

    @property
    def rms(self) -> float:
        """Spread of the widths less that of counting, 0 where it is not above that."""
        expected, seen = self.expected[self._judged], self.seen[self._judged]
        if not len(expected):
            return 0.0
        excess = float(np.sum((seen - expected) ** 2 / expected - 1.0))
        return float(np.sqrt(excess / expected.sum())) if excess > _SIGMAS * np.sqrt(2.0 * len(expected)) else 0.0

    def doubt(self, shares: Array) -> tuple[float, float]:
        """Effect of uneven widths on a level at most: shift of its mean, DN, and of its variance, DN^2."""
        widths = self.widths
        return 0.5 * float(shares @ np.abs(widths - 1.0)), max(float(shares @ (widths**2 - 1.0)) / 12.0, 0.0)

    @property
    def averaged(self) -> int:
        """Number of frames whose means were rounded half to even: even codes are 1 + 1/n wide; 1 where none were."""
        judged = np.flatnonzero(self._judged)
        if self.rms < _SAID or len(judged) < 4:
            return 1
        deviation = self.seen[judged] / self.expected[judged] - 1.0
        by_turns = float(np.average(np.where(judged % 2, -deviation, deviation), weights=self.expected[judged]))
        means = [n for n in (2, 4, 6, 8) if abs(by_turns * n - 1.0) < _BY_TURNS and self.rms < (1 + _BY_TURNS) / n]
        return means[0] if means else 1

    def finding(self) -> str | None:
        """Sentence about codes of other width than one."""
        if self.averaged > 1:
            return (
                f"even codes are wider than odd ones, as if each frame were a mean of {self.averaged}: the gain is "
                "too small by it, and sigma holds that; give single frames"
            )
        missing = np.flatnonzero((self.expected > _EMPTY) & (self.seen < 0.02 * self.expected))
        if not len(missing) and self.rms < _SAID:
            return None
        judged = np.flatnonzero(self._judged)
        if len(missing):
            others = f" and {len(missing) - 1} others never come" if len(missing) > 1 else " never comes"
            said = f"the code {missing[0]}{others}"
        else:
            widest = int(judged[np.argmax(self.seen[judged] / self.expected[judged])])
            said = (
                f"codes differ in width by {100.0 * self.rms:.0f} % rms, and {widest} is "
                f"{self.seen[widest] / self.expected[widest]:.2g} wide"
            )
        return (
            f"{said}: a table, a digital gain or the converter's steps; sigma holds what they do to mean and noise; "
            "give the converter's own codes"
        )

    @property
    def unevenness(self) -> float:
        """Mean absolute deviation of the judged codes' widths from 1: what a local gain may differ by."""
        return float(np.abs(self.widths[self._judged] - 1.0).mean()) if self._judged.any() else 0.0


def _smooth(frames: NDArray[Any], noise_dn: float, top: int) -> Array:
    """Counts of codes of one width, of the pixels' means and the noise about them."""
    n = len(frames)
    total = frames.sum(axis=0, dtype=np.int64)
    places = np.bincount(np.rint((total / n + 0.5) * _FINE).astype(int).ravel(), minlength=(top + 1) * _FINE)
    places = places[: (top + 1) * _FINE].astype(float)
    dense = gaussian_filter1d(places, float(_FINE * noise_dn * np.sqrt((n - 1) / n)), mode="constant")
    return np.asarray(n * dense.reshape(top + 1, _FINE).sum(axis=1))


# -- codes that a program changed ------------------------------------------------------------------------------------

_JUMP = 0.5  # of the range, between two frames of one level: no noise does that
_FEWEST = 8  # pixels that jump: a cosmic ray or a blinking pixel has fewer
_COMPACT = 0.2  # of the frame: text is drawn at one place
_WRAPPED = 0.1  # of the range below the last code of 16 bits, in which negative numbers end


def code_fault(frames: NDArray[Any], bits: int) -> str:
    """Fault of the frames of one level, shape (n, h, w), as codes of so many bits; "" if there is none."""
    top, largest = (1 << bits) - 1, int(frames.max())
    if largest > top:
        return _beyond(frames, bits)
    return _jumps(frames, top) or _spread(frames[0], bits)


def _beyond(frames: NDArray[Any], bits: int) -> str:
    """Fault of codes above the last one of the bits."""
    top, largest = (1 << bits) - 1, int(frames.max())
    said = f"has the code {largest}, and {bits} bits end at {top}"
    codes = frames.astype(np.uint16)
    if int(codes.byteswap().max()) <= top:
        return f"{said}: its bytes are exchanged, high byte first; save it with the low byte first"
    if int(codes[codes > top].min()) > 65535 - _WRAPPED * top:
        return (
            f"{said}: numbers below 0 became 65535 and less, as black was subtracted; give the converter's codes, "
            "black included"
        )
    return f"{said}: write `bits` into capture.toml, and give codes that are not scaled to 16 bits"


def _jumps(frames: NDArray[Any], top: int) -> str:
    """Fault of pixels that jump over half of the range from frame to frame."""
    first = frames[0].astype(np.int32)
    apart = np.zeros(first.shape, bool)
    for frame in frames[1:]:
        apart |= np.abs(frame - first) > _JUMP * top
    count = int(apart.sum())
    if count < _FEWEST:
        return ""
    rows, columns = np.nonzero(apart)
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    said = f"has {count} pixels that change by more than half of the range from frame to frame"
    if height * width <= _COMPACT * apart.size:
        return (
            f"{said}, all within {width} x {height} pixels at ({columns.min()}, {rows.min()}): a date or a counter is "
            "written there; switch it off"
        )
    return (
        f"{said}: numbers below 0 became the largest codes, as black was subtracted, or those above the largest began "
        "anew; give the converter's codes, black included"
    )


def _spread(frame: NDArray[Any], bits: int) -> str:
    """Fault of codes that are more than one apart: rounding is a whole step then."""
    top = (1 << bits) - 1
    codes = np.flatnonzero(np.bincount(frame.ravel()))
    step = int(np.diff(codes).min()) if len(codes) > 2 else 1
    if step <= 1:
        return ""
    unused = step.bit_length() - 1
    stretched = top / (top >> unused)  # of a program that makes the last code the last one of more bits
    most = 1.0 if step > 3 else 0.5  # upper bits that are repeated below are up to 1 off
    shifted = any(np.abs(codes - s * np.rint(codes / s)).max() <= most for s in (1 << unused, stretched))
    if not shifted:
        return (
            f"has codes {step} or more apart, which a table or a digital gain spread: give the codes of the converter"
        )
    bytes_too = ", or whose bytes are exchanged" if step >= 256 else ""
    remedy = f"shift them right by {unused} bits, and write bits = {bits - unused} into capture.toml"
    remedy = f"{remedy}, or save them with the low byte first" if bytes_too else remedy
    return f"has codes {step} or more apart, which a program scaled{bytes_too}: {remedy}"
