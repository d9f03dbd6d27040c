"""Check of a method on ten easy pairs, three of them without boxes: each mistake is named in plain words.

What of an answer is compared with the truth, and in which order; the rules are those of `answer_faults`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from textwrap import indent

import numpy as np

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import OK, Outcome, Spot
from phibench.estimator.methods.answer_faults import (
    NEAR_PX,
    SeenAngle,
    SeenDepth,
    Views,
    covariance_fault,
    depth_fault,
    phi_fault,
    position_fault,
    rms_pull,
    rule_fault,
    whole_pixels_note,
    wild_fault,
)
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.scenes.frames import Array

PAIRS = 10
WHOLE = 3
"""Pairs of these, the last ones, that have no boxes: the whole image is searched, and a blue light is in it."""
_GIVE_UP = 3  # pairs in a row without an answer in time


@dataclass(frozen=True)
class MethodCheck:
    """Result of a check.

    Attributes
    ----------
    faults : tuple of str
        Sentences; empty if the method is sound.
    notes : tuple of str
        Counts, errors and times.
    printed : tuple of (pair, text)
        Last lines that the method printed for a pair, where it printed anything.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]
    printed: tuple[tuple[int, str], ...] = ()

    @property
    def ok(self) -> bool:
        """True if there is no fault."""
        return not self.faults

    def lines(self, reference: str, sound: str, show_output: bool) -> Iterator[str]:
        """Lines for a person: what was printed, notes, faults, and the verdict, `sound` where there is no fault."""
        for number, text in self.printed if show_output else ():
            yield f"printed for pair {number}:\n{indent(text, '    ')}"
        if self.printed and not show_output:
            yield "the method prints something: --show-output shows it"
        yield from self.notes
        yield from (f"wrong: {fault}" for fault in self.faults)
        yield f"{reference}: {sound if self.ok else f'{len(self.faults)} wrong'}"


def check_method(
    reference: str,
    preset: str = "mjpeg",
    limits: RunLimits | None = None,
    count: int = PAIRS,
    told: Callable[[int], None] = lambda done: None,
) -> MethodCheck:
    """Run a method on easy pairs.

    Parameters
    ----------
    reference : str
        As for `runner.run_method`.
    preset : str
        Name of a sensor's preset that ends in pixels, such as "mjpeg".
    limits : RunLimits, optional
    count : int
        How many pairs.
    told : callable
        Given the number of pairs that are done.

    Raises
    ------
    MethodError
        If the method cannot be found or imported, or there is no such preset.
    """
    pairs = EasyPairs(preset, count, whole=min(WHOLE, count // 2))
    done: list[Outcome] = []
    with Harness([reference], limits) as harness:
        for outcome in _until_hopeless(outcome for (outcome,) in harness.outcomes(pairs, range(len(pairs)))):
            done.append(outcome)
            told(len(done))
        isolation = harness.isolations[0]
    check = check_of_outcomes(done, pairs)
    return check if isolation.startswith("isolated") else replace(check, notes=(*check.notes, isolation))


def check_of_outcomes(done: Sequence[Outcome], pairs: EasyPairs) -> MethodCheck:
    """Faults and notes of outcomes on easy pairs."""
    faults = [*_failures(done, pairs), *_missing(done, pairs), *_wrong(done, pairs)]
    printed = tuple((outcome.number, outcome.output) for outcome in done if outcome.output)
    return MethodCheck(tuple(faults), tuple(_notes(done, pairs)), printed)


def _until_hopeless(run: Iterator[Outcome]) -> Iterator[Outcome]:
    """All outcomes, or those up to the third timeout in a row."""
    late = 0
    for outcome in run:
        yield outcome
        late = late + 1 if outcome.failure == "timeout" else 0
        if late == _GIVE_UP:
            return  # each further pair would cost the same time


def _failures(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    """One sentence per kind of failure, with the message of the first."""
    counts = Counter(outcome.failure for outcome in done if outcome.failure)
    whole = {outcome.number for outcome in done if pairs.boxes(outcome.number)[0] is None}
    for failure, count in counts.items():
        failed = [outcome for outcome in done if outcome.failure == failure]
        boxless = {outcome.number for outcome in failed} == whole and len(whole) < len(done)
        advice = f"; {_NO_BOXES}" if boxless else ""
        yield f"{count} of {len(done)} pairs: {_IN_WORDS[failure]}: {failed[0].message}{advice}"


_NO_BOXES = "it fails where a pair has no boxes: box_down and box_up are None there, search the whole mirror"
_IN_WORDS = {
    "error": "the method raised an exception",
    "timeout": "too slow",
    "crash": "the method's process died",
    "memory": "too much memory",
    "invalid": "the answer is not valid",
    "mutated": "the input was written to",
}


def _missing(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    """A sentence if most spots of answered pairs are missing, or of those without boxes: these pairs are easy."""
    spots = [(number, spot.status) for number, _, spot in _spots(done)]
    boxless = [(number, status) for number, status in spots if pairs.boxes(number)[0] is None]
    for asked, where in ((spots, ", although all are easy"), (boxless, " where a pair has no boxes")):
        missing = [status for _, status in asked if status != OK]
        if 2 * len(missing) > len(asked):
            reason, count = Counter(missing).most_common(1)[0]
            yield f"{len(missing)} of {len(asked)} spots are missing{where}: '{reason}' ({count} times)"
            return  # what is said of the few would mislead


def _wrong(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    """Sentences about positions, covariances, angles and depths."""
    answered = [outcome for outcome in done if outcome.answer is not None]
    if not answered:
        return  # told as missing
    truths = {outcome.number: pairs.truth(outcome.number) for outcome in answered}
    answer_px, truth_px = _positions(answered), np.array([_true_px(truths[o.number]) for o in answered])
    views, boxed = _views(pairs, answered), [pairs.boxes(outcome.number)[0] is not None for outcome in answered]
    # a blue spot lies across the mirror from the red one: an image that was turned looks the same without boxes
    fault = rule_fault(answer_px, truth_px, views) if _is_far(answer_px[boxed] - truth_px[boxed]) else ""
    fault = fault or colour_fault(answered, pairs)
    error_px = answer_px - truth_px
    if not fault:
        fault = position_fault(answer_px, truth_px, views) or no_boxes_fault(error_px, boxed) or wild_fault(error_px)
    errors, covariances = _claimed(answered, truths)
    # a covariance says nothing about positions that are wrong by a rule
    yield from filter(None, [fault or covariance_fault(errors, covariances)])
    depths = list(_depths(answered, pairs, truths))
    # D of positions that are wrong by a rule says nothing of its own
    depths = [replace(depth, own_m=float("nan")) for depth in depths] if fault else depths
    yield from filter(None, [phi_fault(list(_angles(answered, truths))), depth_fault(depths)])


def _notes(done: Sequence[Outcome], pairs: EasyPairs) -> Iterator[str]:
    answered = [outcome for outcome in done if outcome.answer is not None]
    yield f"{len(answered)} of {len(done)} pairs answered"
    if not answered:
        return  # nothing to say
    truths = {outcome.number: pairs.truth(outcome.number) for outcome in answered}
    errors = _positions(answered) - np.array([_true_px(truths[o.number]) for o in answered])
    distance = np.linalg.norm(errors, axis=-1)
    seen = distance[np.isfinite(distance)]
    if seen.size:
        yield from filter(None, [whole_pixels_note(_positions(answered))])
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


def _is_far(error_px: Array) -> bool:
    """True where most answers, of any, are off."""
    distance = np.linalg.norm(error_px, axis=-1)
    return bool(np.isfinite(distance).any() and np.nanmedian(distance) > NEAR_PX)


def _of(truth: PairTruth, position: str) -> ImageTruth:
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


def _angles(answered: Sequence[Outcome], truths: dict[int, PairTruth]) -> Iterator[SeenAngle]:
    """The spots' angles, of those that have one."""
    for number, position, spot in _spots(answered):
        if spot.phi_rad is not None:
            other = "up" if position == "down" else "down"
            truth = truths[number]
            yield SeenAngle(spot.phi_rad, spot.phi_convention, _of(truth, position).phi_rad, _of(truth, other).phi_rad)


def _depths(answered: Sequence[Outcome], pairs: EasyPairs, truths: dict[int, PairTruth]) -> Iterator[SeenDepth]:
    """The answers' depths, of those that have one."""
    for outcome in answered:
        answer = outcome.answer
        if answer is None or answer.depth_m is None:
            continue
        truth, own = truths[outcome.number], float("nan")
        if answer.down.uv_px is not None and answer.up.uv_px is not None:
            uv = np.array(answer.down.uv_px), np.array(answer.up.uv_px)
            own = float(depth_exact(pairs.rig, truth.stroke_m, *uv).depth_m)
        yield SeenDepth(answer.depth_m, answer.sigma_depth_m, truth.depth_m, truth.stroke_m, own)


# -- pairs without boxes -------------------------------------------------------------------------------------------

_LEAST_BLUE = 2  # spots: two answers within 2 px of a blue one are no accident in 4e5 pixels


def colour_fault(answered: Sequence[Outcome], pairs: EasyPairs) -> str:
    """Sentence if most answers in images with a blue spot are that spot; "" if not, or if nothing is answered there."""
    lit = [(outcome, blue) for outcome in answered if (blue := pairs.blue_px(outcome.number)) is not None]
    if not lit:
        return ""  # no blue light is in these pairs
    distance = np.linalg.norm(
        _positions([outcome for outcome, _ in lit]) - np.array([blue for _, blue in lit]), axis=-1
    )
    seen = distance[np.isfinite(distance)]
    if len(seen) < _LEAST_BLUE or 2 * int((seen <= NEAR_PX).sum()) <= len(seen):
        return ""  # it takes red ones, or finds few
    return (
        f"{int((seen <= NEAR_PX).sum())} of {len(seen)} spots are a fainter blue light: red and blue look exchanged; "
        "images are R, G, B, not B, G, R, and a mosaic has red at even rows and even columns"
    )


def no_boxes_fault(error_px: Array, boxed: Sequence[bool]) -> str:
    """Sentence if spots are found in boxes and not without them; "" if not.

    Parameters
    ----------
    error_px : shape (n, 2, 2)
    boxed : n flags
        Whether a pair has boxes.
    """
    distance, inside = np.linalg.norm(error_px, axis=-1), np.array(boxed)
    within, without = distance[inside], distance[~inside]
    seen, near = without[np.isfinite(without)], within[np.isfinite(within)]
    if not (len(seen) and len(near)) or np.median(near) > NEAR_PX or 2 * int((seen > NEAR_PX).sum()) <= len(seen):
        return ""  # it needs no boxes, or does not work with them either
    return (
        f"{int((seen > NEAR_PX).sum())} of {len(seen)} spots are wrong where a pair has no boxes: search inside the "
        "mirror's outline, `mirror_mask(pair)` in docs/method.md"
    )
