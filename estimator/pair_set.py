"""The exact answer for one pair, with what a score sorts by. Never shown to a method.

A set of pairs to score on, wherever it comes from.

Pairs that are drawn once and held while everything that looks at them does so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from phibench.estimator.interface import Pair
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class Distraction:
    """Another light that a method may take for the spot, in one image."""

    kind: str
    uv_px: tuple[float, float]
    electrons: float


@dataclass(frozen=True)
class SpotTruth:
    """One image of a pair.

    Attributes
    ----------
    uv_px : (u, v), the chief ray's; NaN where there is none
    phi_rad : dict of "ray", "normal", "incidence" to float
    azimuth_rad : float
    visible : bool
    cause : str
        Why not: as in the manifest; "none" if visible.
    electrons : float
        Expected electrons of the whole spot behind the red filter (all filters of a mono sensor) in this exposure.
    peak_e : float
        Largest expected electrons of a pixel, room included.
    snr : float
        Flux over its standard deviation at the limit of this image, after all processing; position known, the room's
        levels not: "so many sigma".
    saturated : bool
        Whether a pixel of the spot is expected above the sensor's saturation.
    bound_px2 : array, shape (2, 2), or None
        Cramer-Rao bound of (u, v) from this image: `estimator.limits` for raw outputs, `estimator.chain_limit` for
        processed ones; None where there is none.
    raw_bound_px2 : array, shape (2, 2), or None
        Bound of the raw pixels behind this image, whatever the output.
    distractions : tuple of Distraction
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


@dataclass(frozen=True)
class PairTruth:
    """One pair.

    Attributes
    ----------
    number : int
        `Pair.number`.
    sample_id : str
    draw : int
    preset : str
    jpeg_quality : int or None
        None unless the output is MJPEG.
    hinted : bool
        Whether the method got boxes.
    depth_m, stroke_m : float
    true_rig, nominal_rig : Rig
        The rig that was rendered, and the one in `Pair.rig`.
    down, up : SpotTruth
    nominal_stroke_m : float or None
        The stroke in `Pair.stroke_m`; None if it is the true one.
    calibration_covariance : array, shape (p, p), or None
        That of the pair: the predicted error of D then includes the calibration's.
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
    down: SpotTruth
    up: SpotTruth
    nominal_stroke_m: float | None = None
    calibration_covariance: Array | None = None


class PairSet(Protocol):
    """Pairs by number, 0 to len - 1; each is drawn or read when it is asked for."""

    def __len__(self) -> int:
        """How many."""

    def pair(self, number: int) -> Pair:
        """What a method sees."""

    def truth(self, number: int) -> PairTruth:
        """The exact answer.

        Raises
        ------
        DatasetError
            If the set is sealed.
        """

    def document(self) -> dict[str, Any]:
        """Provenance: name, task version, hashes, seeds, as JSON can hold it."""


class HeldPairs:
    """A part of a pair set in memory; make another for the next part.

    Parameters
    ----------
    pairs : PairSet
    """

    def __init__(self, pairs: PairSet) -> None:
        self._pairs = pairs
        self._images: dict[int, Pair] = {}
        self._truths: dict[int, PairTruth] = {}

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """What a method sees."""
        if number not in self._images:
            self._images[number] = self._pairs.pair(number)
        return self._images[number]

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        if number not in self._truths:
            self._truths[number] = self._pairs.truth(number)
        return self._truths[number]

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()
