"""Check of a method on ten easy pairs, three of them without boxes: each mistake is named in plain words.

A mistake of convention moves every spot by a rule. Each rule is tried on the truth, and one that predicts the answers
is named. Positions have the shape (n, 2, 2): pair, (down, up), (u, v), pixels; NaN where there is none.
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
from phibench.estimator.interface import OK, Outcome, Spot
from phibench.estimator.pair_set import ImageTruth, PairTruth
from phibench.scenes.frames import Array

PAIRS = 10
WHOLE = 3
"""Pairs of these, the last ones, that have no boxes: the whole image is searched, and a blue light is in it."""
_GIVE_UP = 3  # pairs in a row without an answer in time


@dataclass(frozen=True)
class Check:
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
) -> Check:
    """Run a method on easy pairs.

    Parameters
    ----------
    reference : str
        As for `runner.run_method`.
    preset : "bayer-raw", "mono-raw", "srgb8", "yuyv" or "mjpeg"
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
    check = judged(done, pairs)
    return check if isolation.startswith("isolated") else replace(check, notes=(*check.notes, isolation))


def judged(done: Sequence[Outcome], pairs: EasyPairs) -> Check:
    """Faults and notes of outcomes on easy pairs."""
    faults = [*_failures(done, pairs), *_missing(done, pairs), *_wrong(done, pairs)]
    printed = tuple((outcome.number, outcome.output) for outcome in done if outcome.output)
    return Check(tuple(faults), tuple(_notes(done, pairs)), printed)


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
    fault = colour_fault(answered, pairs)
    if not fault:
        boxed = [pairs.boxes(outcome.number)[0] is not None for outcome in answered]
        fault = position_fault(answer_px, truth_px, _views(pairs, answered)) or whole_fault(answer_px - truth_px, boxed)
    errors, covariances = _claimed(answered, truths)
    # a covariance says nothing about positions that are wrong by a rule
    yield from filter(None, [fault or covariance_fault(errors, covariances)])
    yield from filter(None, [phi_fault(list(_angles(answered, truths))), depth_fault(list(_depths(answered, truths)))])


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


# -- positions and covariances -------------------------------------------------------------------------------------

NEAR_PX = 2.0  # median error up to which a method sees the spot; the worst built-in has 0.7 on these pairs
_EXPLAINED = 0.2  # of the median error may remain under a rule that is named
_OFFSET_PX = 0.25  # mean offset that is no accident of a coarse method, if it is also significant
_OFFSET_SIGMAS = 5.0  # false alarm below 1e-5 for 20 spots, 2 axes
_HALF_PX = 0.2  # by which a half-pixel offset may miss a half
_PULL = (0.5, 2.0)  # of 40 numbers: outside by chance 3e-8 (chi squared)
_LEAST_PULLS = 10  # of fewer the deviation is uncertain by more than a fifth
_LEAST_BLUE = 2  # spots: two answers within 2 px of a blue one are no accident in 4e5 pixels


@dataclass(frozen=True)
class Views:
    """Geometry that the rules need besides the true positions.

    Attributes
    ----------
    shape : (H, W)
    origin_px : shape (n, 2, 2)
        First pixel (u, v) of the boxes.
    """

    shape: tuple[int, int]
    origin_px: Array


Rule = Callable[[Array, Views], Array]

RULES: dict[str, Rule] = {
    "the axes are swapped: these are (v, u), row first; give (u, v), column first": lambda uv, _: uv[..., ::-1],
    "v runs upwards: it must run downwards, row 0 at the top": lambda uv, s: _mirrored(uv, 1, s.shape[0]),
    "u runs to the left: it must run to the right, column 0 at the left": lambda uv, s: _mirrored(uv, 0, s.shape[1]),
    "the frames are swapped: 'down' holds the spot of the up image and the other way round": lambda uv, _: uv[:, ::-1],
    "positions are relative to the box: add (box.u0_px, box.v0_px)": lambda uv, s: uv - s.origin_px,
    "positions are halved, as in an image binned 2 x 2: give pixels of the whole image": lambda uv, _: (uv - 0.5) / 2.0,
}


def position_fault(answer_px: Array, truth_px: Array, views: Views) -> str:
    """Sentence on the fault of positions; "" if there is none.

    Parameters
    ----------
    answer_px, truth_px : shape (n, 2, 2)
    """
    error = _median_distance(answer_px, truth_px)
    if not np.isfinite(error):
        return ""  # too few answers
    if error <= NEAR_PX:
        return _offset_fault((answer_px - truth_px).reshape(-1, 2))
    left = {text: _median_distance(answer_px, rule(truth_px, views)) for text, rule in RULES.items()}
    text = min(left, key=lambda name: left[name])
    if left[text] < min(NEAR_PX, _EXPLAINED * error):
        return text
    return (
        f"the positions are {error:.1f} px from the spot (median); a coarse method comes within 1 px on these pairs: "
        "is something else than the laser spot found?"
    )


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


def whole_fault(error_px: Array, boxed: Sequence[bool]) -> str:
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


def _mirrored(uv_px: Array, axis: int, size: int) -> Array:
    mirrored = uv_px.copy()
    mirrored[..., axis] = size - 1 - uv_px[..., axis]
    return mirrored


def _offset_fault(error_px: Array) -> str:
    seen = error_px[np.isfinite(error_px).all(axis=1)]
    near = seen[np.linalg.norm(seen, axis=1) < 2.0 * NEAR_PX]
    mean, se = near.mean(axis=0), near.std(axis=0) / np.sqrt(len(near))
    for size, text in ((0.5, "half a pixel"), (1.0, "one pixel")):
        for sign, direction in ((1.0, "large"), (-1.0, "small")):
            if (np.abs(mean - sign * size) < _HALF_PX).all() and (np.abs(mean) > 3.0 * se).all():
                return (
                    f"the positions are {text} too {direction} in u and v: the centre of the first pixel is (0, 0), "
                    f"the image begins at -0.5 (mean error {mean[0]:+.2f}, {mean[1]:+.2f} px)"
                )
    if ((np.abs(mean) > _OFFSET_PX) & (np.abs(mean) > _OFFSET_SIGMAS * se)).any():
        return (
            f"the positions are off by ({mean[0]:+.2f}, {mean[1]:+.2f}) px on average: the centre of the first pixel "
            "is (0, 0)"
        )
    return ""


def covariance_fault(error_px: Array, covariance_px2: Array) -> str:
    """Sentence on the size of claimed covariances; "" if it is right, or if there are too few to tell.

    Parameters
    ----------
    error_px : shape (n, 2)
    covariance_px2 : shape (n, 2, 2)
    """
    pull = rms_pull(error_px, covariance_px2)
    if 2 * len(error_px) < _LEAST_PULLS or _PULL[0] <= pull <= _PULL[1]:
        return ""  # too few, or as they should be
    deviations = np.sqrt(np.mean((error_px / np.diagonal(covariance_px2, axis1=1, axis2=2)) ** 2))
    if _PULL[0] <= deviations <= _PULL[1]:
        return (
            "covariance_px2 holds standard deviations: variances are needed, px^2 "
            f"(the errors are {pull:.2g} times what it says)"
        )
    size = "small" if pull > 1.0 else "large"
    return f"covariance_px2 is too {size}: the errors are {pull:.2g} times what it says (rms of error / deviation)"


def rms_pull(error_px: Array, covariance_px2: Array) -> float:
    """Root mean square of errors in units of their claimed deviation; NaN without any."""
    if len(error_px) == 0:
        return float("nan")
    squares = np.einsum("ni,ni->n", error_px, np.linalg.solve(covariance_px2, error_px[..., None])[..., 0])
    return float(np.sqrt(squares.mean() / 2.0))


def _median_distance(a_px: Array, b_px: Array) -> float:
    distance = np.linalg.norm(a_px - b_px, axis=-1)
    seen = distance[np.isfinite(distance)]
    return float(np.median(seen)) if seen.size else float("nan")


# -- angles and depths ------------------------------------------------------------------------------------------------

_NEAR_RAD = 0.02  # 3 px of the default rig; the senses of phi differ by 0.08 on easy pairs
_NEAR_DEPTH = 0.5  # relative: a spot that is off by some pixels stays within
_UNITS = {1000.0: "millimetres", 100.0: "centimetres"}  # times the metres that were asked for


def phi_fault(angles: Sequence[tuple[float, str, dict[str, float]]]) -> str:
    """Sentence on the fault of angles (phi in radians, its convention, the true angles); "" if there is none.

    The convention "outline" is none of the truth's and is left alone.
    """
    known = [(phi, convention, truth) for phi, convention, truth in angles if convention in truth]
    if not known:
        return ""  # no angle was answered
    off = {
        name: float(np.median([abs(phi - truth[name]) for phi, _, truth in known]))
        for name in ("ray", "normal", "incidence")
    }
    said = float(np.median([abs(phi - truth[convention]) for phi, convention, truth in known]))
    if said <= _NEAR_RAD:
        return ""  # the sense that it states is right
    best, convention = min(off, key=lambda name: off[name]), known[0][1]
    if off[best] <= _NEAR_RAD:
        return f"phi_rad is the angle '{best}', not '{convention}': set phi_convention='{best}'"
    if float(np.median([abs(phi - 2.0 * truth["ray"]) for phi, _, truth in known])) <= 2.0 * _NEAR_RAD:
        return "phi_rad is theta, the ray's angle from the downward vertical: phi is half of it"
    return f"phi_rad is off by {said:.2g} rad (median) from the angle '{convention}'"


def depth_fault(depths: Sequence[tuple[float, float]]) -> str:
    """Sentence on the fault of pairs (depth, true depth), metres; "" if there is none."""
    if not depths:
        return ""
    ratio = float(np.median([depth / truth for depth, truth in depths]))
    if abs(ratio - 1.0) <= _NEAR_DEPTH:
        return ""  # metres
    for factor, unit in _UNITS.items():
        if abs(ratio / factor - 1.0) <= _NEAR_DEPTH:
            return f"depth_m is in {unit}: metres are needed"
    return f"depth_m is {ratio:.2g} times the true depth (median)"
