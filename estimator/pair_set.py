"""Sets of pairs to score on: two protocols, `Pairs` and `Truths`, the types of a truth, and one cache.

A truth is never shown to a method. Positions are pixels (u, v), integers at pixel centres; NaN where there is none.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.store.pair_files import LEAST_BOX_PX
from phibench.estimator.interface import Pair
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class Distraction:
    """Another light in one image, which a method may take for the spot."""

    kind: str
    uv_px: tuple[float, float]
    electrons: float


@dataclass(frozen=True)
class ImageTruth:
    """Exact answer for one image of a pair.

    Attributes
    ----------
    uv_px : (u, v), the centre of the light; NaN where there is none, or a visible spot's place is not known: of a real
        pair
    phi_rad : dict of "ray", "normal", "incidence" to float
    cause : str
        Reason why it is not visible, as in the manifest; "none" if it is.
    electrons : float
        Expected electrons of the whole spot behind the red filter (all filters of a mono sensor) in this exposure.
    peak_e : float
        Largest expected electrons of a pixel, room included.
    snr : float
        Signal to noise of the light in this image, after all processing, with place and room known
        (`limits.position_bound`).
    saturated : bool
        A pixel of the spot is expected above the sensor's saturation.
    bound_px2 : array, shape (2, 2), or None
        Bound of (u, v) from this image; None where there is none. Raw outputs: Cramer-Rao (`spot_limit`). Processed
        ones: that of the estimator's model (`chain_limit`), which counts a part of the information only.
    raw_bound_px2 : array, shape (2, 2), or None
        Bound of the raw pixels behind this image, whatever the output.
    distractions : tuple of Distraction
    axis_px : (u, v), the image of the beam's axis; NaN where it is not known
    """

    uv_px: tuple[float, float]
    phi_rad: dict[str, float]
    azimuth_rad: float
    visible: bool
    cause: str
    electrons: float
    peak_e: float
    snr: float
    saturated: bool
    bound_px2: Array | None
    raw_bound_px2: Array | None
    distractions: tuple[Distraction, ...] = ()
    axis_px: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True, repr=False)
class PairTruth(ShortForm):
    """Exact answer for one pair, with what a score sorts by.

    Attributes
    ----------
    number : int
        `Pair.number`.
    jpeg_quality : int or None
        None unless the output is MJPEG.
    hinted : bool
        The method got search boxes.
    depth_m, stroke_m : float
        D of the light on the surfaces, and the true stroke.
    true_rig, nominal_rig : Rig
        The rig that was rendered, and the one in `Pair.rig`.
    down, up : ImageTruth
    nominal_stroke_m : float or None
        The stroke in `Pair.stroke_m`; None if it is the true one.
    calibration_covariance : array, shape (p, p), or None
        That of the pair: the predicted error of D then includes the calibration's.
    exposure_s, analogue_gain, laser_level, lamp_level : float or None
        Of both images; None where nobody knows.
    depth_sigma_m : float
        Of `depth_m` where it was measured by a tape; 0 of an exact one.
    axis_depth_m : float
        D of the beam's axis; NaN where it is not known.
    box_px2 : float
        Area of a search box where there is one: the smaller of both.
    """

    number: int
    sample_id: str
    draw: int
    preset: str
    jpeg_quality: int | None
    hinted: bool
    depth_m: float
    stroke_m: float
    true_rig: Rig
    nominal_rig: Rig
    down: ImageTruth
    up: ImageTruth
    nominal_stroke_m: float | None = None
    calibration_covariance: Array | None = None
    exposure_s: float | None = None
    analogue_gain: float | None = None
    laser_level: float | None = None
    lamp_level: float | None = None
    depth_sigma_m: float = 0.0
    axis_depth_m: float = math.nan
    box_px2: float = LEAST_BOX_PX**2

    def _title(self) -> str:
        return f"Truth of pair {self.number}: '{self.sample_id}', draw {self.draw}, {self.preset}"

    def _shown(self) -> dict[str, Any]:
        spots = {"down": self.down, "up": self.up}
        places = {
            name: f"({one.uv_px[0]:.3f}, {one.uv_px[1]:.3f}) px, phi_ray {one.phi_rad.get('ray', math.nan):.6f} rad"
            if one.visible
            else f"not visible: {one.cause}"
            for name, one in spots.items()
        }
        return {"depth D": f"{self.depth_m:.4f} m", "stroke h": f"{self.stroke_m:.4f} m", **places}


class Pairs(Protocol):
    """Pairs as methods see them, by number from 0 to len - 1; each is simulated or read on request."""

    def __len__(self) -> int:
        """Return the number of pairs."""

    def pair(self, number: int) -> Pair:
        """Images of a pair, with what a user knows of the rig."""


class Truths(Protocol):
    """Exact answers, by the same numbers."""

    def truth(self, number: int) -> PairTruth:
        """Exact answer for a pair.

        Raises
        ------
        DatasetError
            If the set is sealed.
        """


class PairSet(Pairs, Truths, Protocol):
    """Pairs with their truth: what a score needs."""

    def document(self) -> dict[str, Any]:
        """Provenance as JSON can hold it: name, task version, hashes, seeds."""


def truth_folders(pairs: object) -> tuple[Path, ...]:
    """Folders of the files behind a set, which a method must not read; none for pairs that are made in memory."""
    return tuple(getattr(pairs, "folders", ()))


def tell_answered(pairs: object, number: int) -> bool:
    """Tell a set that all methods have answered a pair; whether the set then makes its truth by itself."""
    told = getattr(pairs, "answered", None)
    return bool(told(number)) if callable(told) else False


class CachedPairs:
    """Pairs and truths of another set, each asked for once and kept; make a new one for the next part of a set.

    A pair's truth is made when all methods have answered it, before the next pair. It takes longer where both spots are
    seen: a method that waits for it, or looks how busy the machine is, would know by the clock.

    Parameters
    ----------
    before : CachedPairs, optional
        The part before, of the same set. Threads may ask both.

    Attributes
    ----------
    truth_seconds, late_seconds : float
        CPU-seconds of the truths so far, and of those of them that no pair waited for.
    """

    def __init__(self, pairs: PairSet, before: CachedPairs | None = None) -> None:
        self._pairs = pairs
        self.folders = truth_folders(pairs)
        self.truth_seconds = self.late_seconds = 0.0
        self._lock: threading.RLock = threading.RLock() if before is None else before._lock
        self._answered: deque[tuple[CachedPairs, int]] = deque() if before is None else before._answered
        self._made: dict[int, Pair] = {}
        self._truths: dict[int, PairTruth] = {}

    def answered(self, number: int) -> bool:
        """Let the truth of a pair be made from now on."""
        if not tell_answered(self._pairs, number):
            self._answered.append((self, number))
        return True

    def pair(self, number: int) -> Pair:
        """Images of a pair."""
        if (found := self._made.get(number)) is not None:
            return found
        with self._lock:
            if number not in self._made:
                while self._answered:
                    pairs, answered = self._answered.popleft()
                    pairs._truth(answered)
                self._made[number] = self._pairs.pair(number)
            return self._made[number]

    def truth(self, number: int) -> PairTruth:
        """Exact answer for a pair."""
        if (found := self._truths.get(number)) is not None:
            return found  # without waiting for a pair that is being made
        with self._lock:
            self.late_seconds += self._truth(number)
            return self._truths[number]

    def _truth(self, number: int) -> float:
        """Make a truth that is not there yet; CPU-seconds that it took."""
        if number in self._truths:
            return 0.0
        start = time.thread_time()
        self._truths[number] = self._pairs.truth(number)
        took = time.thread_time() - start
        self.truth_seconds += took
        return took

    def __len__(self) -> int:
        return len(self._pairs)

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()
