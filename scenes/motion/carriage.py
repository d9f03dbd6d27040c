"""Motion of the carriage along the stroke axis in time, its encoder, and vibration of the rig along any axis.

All positions and velocities are closed forms of the time, shape of the times, seconds in and metres out. A leg starts
and ends at rest: it speeds up with the acceleration a, goes on with the speed v, and slows down with a. Where the leg
is shorter than v^2 / a the speed is never reached. Vibration is a sum of sine waves whose phases and frequencies are
drawn once from a named stream: the same names give the same vibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.validation import SceneError, finite, positive, within

Axis = Literal["stroke", "x", "y"]
Times = Array | Sequence[float] | float
_LINES = 16  # sine waves of a band: a fourth moment within 6 % of the Gaussian's, (1 - 1 / (2 n)) of 3


@dataclass(frozen=True)
class Leg:
    """Straight motion of the carriage from rest to rest.

    Parameters
    ----------
    start_m, end_m : float
        Offsets along the stroke axis; equal for a pause.
    speed_m_per_s, acceleration_m_per_s2 : float
        Largest magnitudes.
    """

    start_s: float
    start_m: float
    end_m: float
    speed_m_per_s: float
    acceleration_m_per_s2: float

    @property
    def ramp_s(self) -> float:
        """Time of speeding up, and of slowing down."""
        way = abs(self.end_m - self.start_m)
        # a short way ends before top speed is reached: two ramps alone, way = a t^2
        return min(self.speed_m_per_s / self.acceleration_m_per_s2, math.sqrt(way / self.acceleration_m_per_s2))

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        way, ramp = abs(self.end_m - self.start_m), self.ramp_s
        if ramp == 0.0:
            return 0.0
        top = self.acceleration_m_per_s2 * ramp
        # both ramps together cover top x ramp; the rest is driven at top speed
        return 2.0 * ramp + max(way - top * ramp, 0.0) / top

    def state(self, times_s: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at times within the leg or beyond its ends, where it rests."""
        t = np.clip(np.asarray(times_s, float) - self.start_s, 0.0, self.duration_s)
        sign, a, ramp, whole = math.copysign(1.0, self.end_m - self.start_m), *self._numbers()
        down = whole - t  # time left
        top = a * ramp
        way = np.where(
            t < ramp,
            0.5 * a * t * t,
            np.where(down < ramp, abs(self.end_m - self.start_m) - 0.5 * a * down * down, top * (t - 0.5 * ramp)),
        )
        speed = np.minimum(np.minimum(a * t, a * down), top)
        moving = (t > 0.0) & (down > 0.0)
        change = np.where(moving & (t < ramp), a, np.where(moving & (down < ramp), -a, 0.0))
        return self.start_m + sign * way, sign * speed, sign * change

    def _numbers(self) -> tuple[float, float, float]:
        return self.acceleration_m_per_s2, self.ramp_s, self.duration_s


@dataclass(frozen=True)
class Carriage:
    """Offsets along the stroke axis against time: a list of stops, a pause at each, a leg between two of them.

    Parameters
    ----------
    stops_m : tuple of floats
        Offsets at which the carriage rests, the first at the time 0.
    pauses_s : tuple of floats
        Rest at each stop; after the last one the carriage stays.
    speed_m_per_s, acceleration_m_per_s2 : float
        Largest magnitudes.

    Examples
    --------
    >>> up = Carriage((0.0, 0.4), (0.5, 0.5), speed_m_per_s=0.2, acceleration_m_per_s2=1.0)
    >>> round(up.duration_s, 9)
    3.2
    >>> [round(float(x), 9) for x in up.position_m([0.0, 0.6, 1.6, 9.0])]
    [0.0, 0.005, 0.2, 0.4]
    """

    stops_m: tuple[float, ...]
    pauses_s: tuple[float, ...]
    speed_m_per_s: float = 0.2
    acceleration_m_per_s2: float = 1.0

    def __post_init__(self) -> None:
        if not self.stops_m or len(self.pauses_s) != len(self.stops_m):
            raise SceneError(
                f"Carriage.pauses_s has {len(self.pauses_s)} numbers for {len(self.stops_m)} stops: give one each"
            )
        for offset in self.stops_m:
            finite("Carriage", "stops_m", offset)
        for pause in self.pauses_s:
            within("Carriage", "pauses_s", pause, 0.0, 3600.0)
        positive("Carriage", "speed_m_per_s", self.speed_m_per_s)
        positive("Carriage", "acceleration_m_per_s2", self.acceleration_m_per_s2)

    @property
    def legs(self) -> tuple[Leg, ...]:
        """Legs in their order, pauses left out."""
        legs, now = [], self.pauses_s[0]
        for number in range(1, len(self.stops_m)):
            ends = self.stops_m[number - 1], self.stops_m[number]
            leg = Leg(now, *ends, self.speed_m_per_s, self.acceleration_m_per_s2)
            legs.append(leg)
            now += leg.duration_s + self.pauses_s[number]
        return tuple(legs)

    @property
    def duration_s(self) -> float:
        """Time until the last pause has ended."""
        return math.fsum(self.pauses_s) + math.fsum(leg.duration_s for leg in self.legs)

    @property
    def moves(self) -> bool:
        """True unless all stops are the same."""
        return len(set(self.stops_m)) > 1

    def position_m(self, times_s: Times) -> Array:
        """Offset along the stroke axis."""
        return self._sum(times_s)[0]

    def velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `position_m`."""
        return self._sum(times_s)[1]

    def acceleration(self, times_s: Times) -> Array:
        """Derivative of `velocity_m_per_s`, m/s^2; where it jumps, one of the two values."""
        return self._sum(times_s)[2]

    def _sum(self, times_s: Times) -> tuple[Array, Array, Array]:
        """Legs rest before and after themselves, so that their ways add up."""
        times = np.asarray(times_s, float)
        position, velocity, change = np.full(times.shape, self.stops_m[0]), np.zeros(times.shape), np.zeros(times.shape)
        for leg in self.legs:
            x, v, a = leg.state(times)
            position, velocity, change = position + (x - leg.start_m), velocity + v, change + a
        return position, velocity, change


@dataclass(frozen=True)
class Sine:
    """One sine wave: amplitude (m), frequency (Hz), phase at time 0 (rad)."""

    amplitude_m: float
    frequency_hz: float
    phase_rad: float


@dataclass(frozen=True)
class Vibration:
    """Vibration of the rig along one axis: a sum of sine waves.

    Parameters
    ----------
    axis : "stroke", "x" or "y"
        Along the stroke axis, or along that axis of the world.
    waves : tuple of Sine
    """

    axis: Axis
    waves: tuple[Sine, ...]

    @classmethod
    def band(cls, axis: Axis, low_hz: float, high_hz: float, rms_m: float, *names: Name) -> Vibration:
        """Vibration of `rms_m` with an even spectrum from `low_hz` to `high_hz`; equal limits are one sine wave.

        Each of 16 equal parts of the band has one wave, its frequency drawn within the part.
        """
        positive("Vibration", "low_hz", low_hz)
        within("Vibration", "high_hz", high_hz, low_hz, 1e4)
        within("Vibration", "rms_m", rms_m, 0.0, 0.1)
        rng, count = generator("vibration", *names), _LINES if high_hz > low_hz else 1
        # one frequency in each of as many parts of the band: an even spectrum
        where = (np.arange(count) + rng.random(count)) / count
        frequencies, phases = low_hz + (high_hz - low_hz) * where, 2.0 * np.pi * rng.random(count)
        # a sine of amplitude A has the mean square A^2 / 2
        amplitude = rms_m * math.sqrt(2.0 / count)
        pairs = zip(frequencies, phases, strict=True)
        return cls(axis, tuple(Sine(amplitude, float(f), float(phase)) for f, phase in pairs))

    @property
    def rms_m(self) -> float:
        """Root mean square over a long time."""
        return math.sqrt(math.fsum(0.5 * wave.amplitude_m**2 for wave in self.waves))

    def displacement_m(self, times_s: Times) -> Array:
        """Displacement along the axis."""
        return self._wave(times_s, 0)

    def velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `displacement_m`."""
        return self._wave(times_s, 1)

    def _wave(self, times_s: Times, order: int) -> Array:
        times = np.asarray(times_s, float)[..., None]
        amplitude, frequency, phase = (
            np.array([(w.amplitude_m, w.frequency_hz, w.phase_rad) for w in self.waves]).reshape(-1, 3).T
        )
        omega = 2.0 * np.pi * frequency
        quarter = 0.5 * np.pi * order  # a derivative is a quarter of a turn ahead
        return np.asarray((amplitude * omega**order * np.sin(omega * times + phase + quarter)).sum(axis=-1))


@dataclass(frozen=True)
class Encoder:
    """Readings of the carriage's offset that the robot gets: rounded to steps, with noise; vibration is none of it.

    Parameters
    ----------
    rms_m : float
        Standard deviation of a reading; readings are independent.
    step_m : float
        Resolution; 0 is none.
    """

    rms_m: float = 0.0
    step_m: float = 0.0

    def __post_init__(self) -> None:
        within("Encoder", "rms_m", self.rms_m, 0.0, 0.1)
        within("Encoder", "step_m", self.step_m, 0.0, 0.1)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of a reading, rounding (step / sqrt(12)) included."""
        return math.hypot(self.rms_m, self.step_m / math.sqrt(12.0))  # an error that is uniform over a step

    def readings_m(self, offsets_m: Array, *names: Name) -> Array:
        """Readings of true offsets, shape (N,), from the named stream; reading k is the same whatever N."""
        noise = generator("encoder", *names).standard_normal(len(offsets_m))
        # noise comes before the rounding, as in an encoder
        read = np.asarray(offsets_m, float) + self.rms_m * noise
        return read if self.step_m == 0.0 else np.rint(read / self.step_m) * self.step_m
