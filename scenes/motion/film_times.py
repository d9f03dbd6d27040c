"""Times of a film: its frames, their rows, and the code by which the laser blinks.

Frame k is centred at t_k = first + k / rate. Row r of H is exposed for T seconds about t_k + (r - (H - 1) / 2) x
readout / H: the rolling shutter of `render.sensor.light`, whose reference instant is the frame's. Rows may be
fractions of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.validation import SceneError, finite, positive, within


@dataclass(frozen=True)
class FilmTimes:
    """Times of frames and rows.

    Parameters
    ----------
    rate_hz : float
        Frames per second.
    exposure_s, readout_s : float
        Of each row; from the first row's to the last row's. 0 is a global shutter.
    first_s : float
        Middle of the exposure of the image's centre, of frame 0.
    """

    frames: int
    rate_hz: float
    exposure_s: float
    readout_s: float
    height_px: int
    first_s: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 1_000_000:
            raise SceneError(f"FilmTimes.frames = {self.frames}: allowed range is 1 to 1000000")
        positive("FilmTimes", "rate_hz", self.rate_hz)
        finite("FilmTimes", "first_s", self.first_s)
        for name in ("exposure_s", "readout_s"):
            longest = 1.0 / self.rate_hz
            if not 0.0 <= getattr(self, name) <= longest * (1.0 + 1e-9):  # 1 / 30 as it is typed
                raise SceneError(
                    f"FilmTimes.{name} = {getattr(self, name):g}: must be 0 to {longest:g} at {self.rate_hz:g} frames "
                    "per second; shorten it or lower the rate"
                )

    @property
    def frame_s(self) -> Array:
        """Middle of each frame, shape (frames,)."""
        return self.first_s + np.arange(self.frames) / self.rate_hz

    @property
    def duration_s(self) -> float:
        """Time that the frames take."""
        return self.frames / self.rate_hz

    def row_s(self, frame: int | Array, rows: float | Array) -> Array:
        """Middle of the exposure of rows (pixels, fractions allowed) of frames; both broadcast."""
        # row (H - 1) / 2 is read at the time of the frame, each row readout / H after the one above
        row = (np.asarray(rows, float) - 0.5 * (self.height_px - 1)) * (self.readout_s / self.height_px)
        return self.first_s + np.asarray(frame, float) / self.rate_hz + row


@dataclass(frozen=True)
class BlinkCode:
    """On and off of the laser: bits that repeat.

    Parameters
    ----------
    bits : str
        Of "1" (on) and "0" (off); "1" alone is always on.
    bit_s : float
        Time of a bit.
    start_s : float
        Time at which a code begins; it repeats before and after.

    Examples
    --------
    >>> code = BlinkCode("10", 0.1)
    >>> [float(x) for x in code.level([0.05, 0.15, 0.25])]
    [1.0, 0.0, 1.0]
    >>> [round(float(x), 9) for x in code.mean_level([0.05, 0.1], 0.1)]
    [1.0, 0.5]
    """

    bits: str = "1"
    bit_s: float = 1.0
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.bits or set(self.bits) - {"0", "1"} or len(self.bits) > 4096:
            raise SceneError(f"BlinkCode.bits = '{self.bits[:60]}': give 1 to 4096 digits 0 and 1, with a 1 among them")
        if "1" not in self.bits:
            raise SceneError(f"BlinkCode.bits = '{self.bits[:60]}': the laser is never on; give a 1")
        within("BlinkCode", "bit_s", self.bit_s, 1e-5, 3600.0)
        finite("BlinkCode", "start_s", self.start_s)

    @property
    def duration_s(self) -> float:
        """Time of one code; 0 where the laser is always on."""
        return 0.0 if "0" not in self.bits else len(self.bits) * self.bit_s

    def level(self, times_s: Array) -> Array:
        """1.0 on, 0.0 off."""
        number = np.floor((np.asarray(times_s, float) - self.start_s) / self.bit_s).astype(int)
        return self._values[number % len(self.bits)]

    def mean_level(self, middle_s: Array, exposure_s: float) -> Array:
        """Part of exposures about `middle_s` during which the laser is on: the integral of `level`, exactly."""
        middle = np.asarray(middle_s, float)
        if exposure_s == 0.0:
            return self.level(middle)
        # difference of an integral: exact for any number of bits in the exposure
        return (self._on_s(middle + 0.5 * exposure_s) - self._on_s(middle - 0.5 * exposure_s)) / exposure_s

    @property
    def _values(self) -> Array:
        return np.array([float(bit) for bit in self.bits])

    def _on_s(self, times_s: Array) -> Array:
        """Time that the laser has been on since `start_s`."""
        passed = np.concatenate([[0.0], np.cumsum(self._values)]) * self.bit_s
        position = (times_s - self.start_s) / self.bit_s
        whole = np.floor(position).astype(int)
        # whole codes, then whole bits of the one that runs, then the part of its present bit
        rounds, number = np.divmod(whole, len(self.bits))
        fraction = (position - whole) * self.bit_s
        return rounds * passed[-1] + passed[number] + fraction * self._values[number]
