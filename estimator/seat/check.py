"""Try a method on ten easy pairs and say in plain words what is wrong with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from phibench.estimator.bench.truth import PairTruth, SpotTruth
from phibench.estimator.seat.diagnosis import Views, covariance_fault, position_fault, rms_pull
from phibench.estimator.seat.easy_pairs import EasyPairs
from phibench.estimator.seat.harness import outcomes
from phibench.estimator.seat.limits import Limits
from phibench.estimator.seat.number_faults import depth_fault, phi_fault
from phibench.estimator.seat.outcome import Outcome
from phibench.estimator.seat.pair import OK, Spot
from phibench.scenes.frames import Array

PAIRS = 10
LIMITS = Limits(seconds=10.0)
_GIVE_UP = 3  # pairs in a row without an answer in time


@dataclass(frozen=True)
class Check:
    """What a trial showed.

    Attributes
    ----------
    faults : tuple of str
        Sentences; empty if the method is sound.
    notes : tuple of str
        What is worth knowing.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether there is no fault."""
        return not self.faults


def check_method(reference: str, preset: str = "bayer-raw", limits: Limits = LIMITS, count: int = PAIRS) -> Check:
    """Run a method on easy pairs.

    Parameters
    ----------
    reference : str
        As for `harness.run_method`.
    preset : "bayer-raw", "mono-raw", "srgb8" or "mjpeg"
    limits : Limits
    count : int
        How many pairs.

    Raises
    ------
    MethodError
        If the method cannot be found or imported, or there is no such preset.
    """
    pairs = EasyPairs(preset, count)
    done = list(_until_hopeless(outcomes(reference, pairs, limits)))
    return judged(done, pairs)


def judged(done: Sequence[Outcome], pairs: EasyPairs) -> Check:
    """Faults and notes of outcomes on easy pairs."""
    faults = [*_failures(done), *_missing(done), *_wrong(done, pairs)]
    return Check(tuple(faults), tuple(_notes(done, pairs)))


def _until_hopeless(run: Iterator[Outcome]) -> Iterator[Outcome]:
    """All outcomes, or those up to the third timeout in a row."""
    late = 0
    for outcome in run:
        yield outcome
        late = late + 1 if outcome.failure == "timeout" else 0
        if late == _GIVE_UP:
            return


def _failures(done: Sequence[Outcome]) -> Iterator[str]:
    """One sentence per kind of failure, with the message of the first."""
    counts = Counter(outcome.failure for outcome in done if outcome.failure)
    for failure, count in counts.items():
        first = next(outcome for outcome in done if outcome.failure == failure)
        yield f"{count} of {len(done)} pairs: {_IN_WORDS[failure]}: {first.message}"


_IN_WORDS = {
    "error": "the method raised an exception",
    "timeout": "too slow",
    "crash": "the method's process died",
    "memory": "too much memory",
    "invalid": "the answer is none",
    "mutated": "the input was written to",
}


def _missing(done: Sequence[Outcome]) -> Iterator[str]:
    """A sentence if most spots of answered pairs are missing: these pairs are easy."""
    spots = list(_spots(done))
    missing = [spot.status for _, _, spot in spots if spot.status != OK]
    if 2 * len(missing) > len(spots):
        reason, count = Counter(missing).most_common(1)[0]
        yield f"{len(missing)} of {len(spots)} spots are missing, although all are easy: '{reason}' ({count} times)"


def _wrong(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    """Sentences about positions, covariances, angles and depths."""
    answered = [outcome for outcome in done if outcome.answer is not None]
    if not answered:
        return
    truths = {outcome.number: pairs.truth(outcome.number) for outcome in answered}
    answer_px, truth_px = _positions(answered), np.array([_true_px(truths[o.number]) for o in answered])
    fault = position_fault(answer_px, truth_px, _views(pairs, answered))
    errors, covariances = _claimed(answered, truths)
    # a covariance says nothing about positions that are wrong by a rule
    yield from filter(None, [fault or covariance_fault(errors, covariances)])
    yield from filter(None, [phi_fault(list(_angles(answered, truths))), depth_fault(list(_depths(answered, truths)))])


def _notes(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    answered = [outcome for outcome in done if outcome.answer is not None]
    yield f"{len(answered)} of {len(done)} pairs answered"
    if not answered:
        return
    truths = {outcome.number: pairs.truth(outcome.number) for outcome in answered}
    errors = _positions(answered) - np.array([_true_px(truths[o.number]) for o in answered])
    distance = np.linalg.norm(errors, axis=-1)
    seen = distance[np.isfinite(distance)]
    if seen.size:
        yield f"error: median {np.median(seen):.3f} px, largest {seen.max():.3f} px, of {seen.size} spots"
    pull = rms_pull(*_claimed(answered, truths))
    if np.isfinite(pull):
        yield f"errors are {pull:.2f} times the claimed deviations (rms; 1 is right)"
    seconds = [outcome.seconds for outcome in answered]
    yield f"time: median {np.median(seconds):.3f} s, longest {max(seconds):.3f} s a pair"


def _spots(done: Sequence[Outcome]) -> Iterator[tuple[int, str, Spot]]:
    for outcome in done:
        if outcome.answer is not None:
            yield outcome.number, "down", outcome.answer.down
            yield outcome.number, "up", outcome.answer.up


def _positions(answered: Sequence[Outcome]) -> Array:
    """Positions, shape (n, 2, 2), NaN where there is none."""
    nowhere = (np.nan, np.nan)
    flat = [spot.uv_px if spot.uv_px is not None else nowhere for _, _, spot in _spots(answered)]
    return np.array(flat, float).reshape(-1, 2, 2)


def _true_px(truth: PairTruth) -> list[tuple[float, float]]:
    return [truth.down.uv_px, truth.up.uv_px]


def _views(pairs: EasyPairs, answered: Sequence[Outcome]) -> Views:
    camera = pairs.rig.camera
    boxes = [pairs.boxes(outcome.number) for outcome in answered]
    origins = [[(0, 0) if box is None else (box.u0_px, box.v0_px) for box in both] for both in boxes]
    return Views((camera.height_px, camera.width_px), np.array(origins, float))


def _of(truth: PairTruth, position: str) -> SpotTruth:
    return truth.down if position == "down" else truth.up


def _claimed(answered: Sequence[Outcome], truths: dict[int, PairTruth]) -> tuple[Array, Array]:
    """Errors (n, 2) and covariances (n, 2, 2) of the spots that claim one."""
    claims = [
        (np.subtract(spot.uv_px, _of(truths[number], position).uv_px), spot.covariance_px2)
        for number, position, spot in _spots(answered)
        if spot.uv_px is not None and spot.covariance_px2 is not None
    ]
    errors = np.array([error for error, _ in claims], float).reshape(-1, 2)
    return errors, np.array([covariance for _, covariance in claims], float).reshape(-1, 2, 2)


def _angles(answered: Sequence[Outcome], truths: dict[int, PairTruth]) -> Iterator[tuple[float, str, dict[str, float]]]:
    """(phi, its convention, the true angles) of the spots that have one."""
    for number, position, spot in _spots(answered):
        if spot.phi_rad is not None:
            yield spot.phi_rad, spot.phi_convention, _of(truths[number], position).phi_rad


def _depths(answered: Sequence[Outcome], truths: dict[int, PairTruth]) -> Iterator[tuple[float, float]]:
    """(depth, true depth) of the answers that have one."""
    for outcome in answered:
        if outcome.answer is not None and outcome.answer.depth_m is not None:
            yield outcome.answer.depth_m, truths[outcome.number].depth_m
