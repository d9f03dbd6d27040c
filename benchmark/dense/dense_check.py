"""Check of a dense method on easy pairs: each mistake of convention is named in plain words.

A mistake of convention changes every D, or every place, by a rule. Each rule is tried on the truth, and one that
explains the answers far better than the truth does is named. Arrays hold one value for each pixel that is looked at,
shape (n,) or (n, 2), all pairs together; NaN where there is no answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phibench.benchmark.dense.easy_dense_pairs import EasyDensePairs, EasyTruth, points_of
from phibench.benchmark.isolation.method_check import MethodCheck
from phibench.benchmark.isolation.method_references import DENSE, resolve
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.status import keep
from phibench.estimator.geometry.triangulate import meeting
from phibench.estimator.interface import Outcome
from phibench.scenes.frames import Array

PAIRS = 3
_LEAST_ANSWERED = 50  # pixels of those that are looked at: fewer tell nothing; sparse features give some hundred
_APART = 0.08  # |log| from which a rule's D and the truth differ, so that the answers can tell
_LEAST_APART = 0.02  # of the pixels
_EXPLAINED = 0.5  # of the median |log|, or of the distance of places, may remain under a rule that is named
_FAIR = 0.2  # median |log| up to which an answer without a rule passes: a coarse matcher has 0.05
_CONSTANT = 0.02
_NEAR_PX = 3.0  # median error of places up to which a method sees the points

Rule = Callable[[EasyTruth], Array]


def check_dense(
    reference: str,
    preset: str = "mjpeg",
    limits: RunLimits | None = None,
    count: int = PAIRS,
    told: Callable[[int], None] = lambda done: None,
) -> MethodCheck:
    """Run a dense method on easy pairs; parameters and errors as for `isolation.method_check.check_method`."""
    pairs, done = EasyDensePairs(preset, count), list[Outcome]()
    with Harness([resolve(reference, DENSE)], limits) as harness:
        for (outcome,) in harness.outcomes(pairs, range(count)):
            done.append(outcome)
            told(len(done))
        isolation = harness.isolations[0]
        check = check_of_dense_outcomes(done, [pairs.truth(outcome.number) for outcome in done])
        if not check.ok:
            ((other,),) = harness.outcomes(_Exchanged(pairs), [0])
            check = replace(check, faults=with_exchanged(check.faults, done[0], other, pairs.truth(0)))
    return check if isolation.startswith("isolated") else replace(check, notes=(*check.notes, isolation))


def check_of_dense_outcomes(done: Sequence[Outcome], truths: Sequence[EasyTruth]) -> MethodCheck:
    """Faults and notes of outcomes on easy pairs, and the truth of each."""
    failed = Counter(outcome.failure for outcome in done if outcome.failure)
    faults = [
        f"{count} of {len(done)} pairs failed ({kind}): {next(o.message for o in done if o.failure == kind)}"
        for kind, count in failed.items()
    ]
    pairs = [(outcome.dense, truth) for outcome, truth in zip(done, truths, strict=True) if outcome.dense is not None]
    notes = [f"{len(pairs)} of {len(done)} pairs answered"]
    if pairs:
        answered = _Answers.of([truth for _, truth in pairs], [answer for answer, _ in pairs])
        faults += _faults(answered)
        notes += _notes(answered, [outcome.seconds for outcome in done if outcome.dense is not None])
    printed = tuple((outcome.number, outcome.output) for outcome in done if outcome.output)
    return MethodCheck(tuple(faults), tuple(notes), printed)


@dataclass(frozen=True)
class _Exchanged:
    """Pairs whose images are exchanged."""

    pairs: EasyDensePairs

    def pair(self, number: int) -> DensePair:
        """Images of a pair."""
        pair = self.pairs.pair(number)
        return replace(pair, down=pair.up, up=pair.down)


def with_exchanged(faults: tuple[str, ...], outcome: Outcome, other: Outcome, truth: EasyTruth) -> tuple[str, ...]:
    """Faults of a method, or one sentence if its answer is right where both images are exchanged.

    Parameters
    ----------
    faults : as of `check_of_dense_outcomes`
    outcome, other : the method's answers for a pair, and for the pair with down and up exchanged
    truth : of the pair
    """
    asked = check_of_dense_outcomes([outcome], [truth]).faults
    if not asked or other.dense is None or check_of_dense_outcomes([other], [truth]).faults:
        return faults
    return (f"down and up are exchanged inside the method: with both images exchanged {_RIGHT}",)


_RIGHT = "its answers are right. pair.down is the lower position's image, and D is asked for its pixels"


@dataclass(frozen=True)
class _Answers:
    """Answers at the pixels of some truths: D, places or None, sigma or None."""

    truths: Sequence[EasyTruth]
    depth_m: Array
    target_px: Array | None
    sigma_m: Array | None

    @classmethod
    def of(cls, truths: Sequence[EasyTruth], answers: Sequence[object]) -> _Answers:
        planes = [
            {name: getattr(answer, name) for name in ("depth_m", "target_uv_px", "sigma_depth_m")} for answer in answers
        ]

        def joined(name: str) -> Array | None:
            parts = [t.at(p[name]) for t, p in zip(truths, planes, strict=True) if p[name] is not None]
            return np.concatenate(parts) if len(parts) == len(truths) else None

        target, depth = joined("target_uv_px"), joined("depth_m")
        if depth is None:
            places = [_places(t, p) for t, p in zip(truths, planes, strict=True)]
            parts = [_depth(t, uv, t.uv_px) for t, uv in zip(truths, places, strict=True)]
            depth = np.concatenate(parts)
        return cls(truths, depth, target, joined("sigma_depth_m"))

    def some(self, step: int) -> _Answers:
        """Every so many pixels of each pair, D alone."""
        names = ("uv_px", "point_world_m", "depth_m", "up_px")
        few = [replace(t, **{name: getattr(t, name)[::step] for name in names}) for t in self.truths]
        parts = np.split(self.depth_m, np.cumsum([len(t.depth_m) for t in self.truths])[:-1])
        return _Answers(few, np.concatenate([part[::step] for part in parts]), None, None)

    def truth(self, rule: Rule) -> Array:
        return np.concatenate([rule(truth) for truth in self.truths])


def _places(truth: EasyTruth, planes: dict[str, Array]) -> Array:
    """Places in the up image; NaN of a pair that was answered otherwise."""
    target = planes["target_uv_px"]
    return np.full_like(truth.uv_px, np.nan) if target is None else truth.at(target)


def _true_depth(truth: EasyTruth) -> Array:
    return truth.depth_m


def _depth(truth: EasyTruth, up_px: Array, down_px: Array) -> Array:
    """D of places in both images, by the exact rig."""
    at = meeting(truth.rig, truth.stroke_m, down_px, up_px)
    return keep(at.depth_m, at.status)


# Rules for D.


def _elevations(truth: EasyTruth) -> tuple[Array, Array]:
    """Elevation of the points from the sphere centre, down and up, radians."""
    centres = (truth.rig.at(offset).sphere_centre_m for offset in (0.0, truth.stroke_m))
    a, b = (np.arctan2(truth.point_world_m[:, 2] - centre[2], truth.depth_m) for centre in centres)
    return a, b


def _wrong_sign(truth: EasyTruth) -> Array:
    """D of a disparity whose sign is turned: the up image's direction lies as far on the other side."""
    a, b = _elevations(truth)
    return np.asarray(truth.stroke_m / (np.tan(2.0 * a - b) - np.tan(a)))


def _in_degrees(truth: EasyTruth) -> Array:
    a, b = _elevations(truth)
    with np.errstate(divide="ignore"):
        return np.asarray(np.abs(truth.stroke_m / (np.tan(np.degrees(a)) - np.tan(np.degrees(b)))))


def _disparity(factor: float, truth: EasyTruth) -> Array:
    a, b = _elevations(truth)
    return factor * np.abs(a - b)


def _range(truth: EasyTruth) -> Array:
    centre = truth.rig.at(0.0).sphere_centre_m
    return np.asarray(np.linalg.norm(truth.point_world_m - centre, axis=1))


def _height(above_floor: bool, truth: EasyTruth) -> Array:
    level = 0.0 if above_floor else truth.rig.at(0.0).sphere_centre_m[2]
    return np.abs(truth.point_world_m[:, 2] - level)


def _depth_at(truth: EasyTruth, uv_px: Array, offset_m: float = 0.0) -> Array:
    """D of what other pixels show."""
    view = truth.rig.at(offset_m)
    X = points_of(view, truth.room, uv_px)
    return np.asarray(np.hypot(*(X - view.sphere_centre_m)[:, :2].T))


def _moved(truth: EasyTruth, turn_deg: float = 0.0, outwards_px: float = 0.0, mirrored: str = "") -> Array:
    """Pixels turned about the mirror's middle, moved away from it, or mirrored at it."""
    middle = truth.rig.camera.project(truth.rig.sphere_in_camera_m)
    offset = truth.uv_px - middle
    if mirrored:
        offset = offset * np.array([-1.0, 1.0] if mirrored == "u" else [1.0, -1.0])
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    offset = offset @ np.array([[c, s], [-s, c]])
    length = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
    return np.asarray(middle + offset * (1.0 + outwards_px / length))


DEPTH_RULES: dict[str, Rule] = {
    "the sign is wrong: D follows from a disparity of the other sign, and is right at the horizon alone": _wrong_sign,
    "the images are swapped: this is D for the pixels of the up image; answer for those of the down image": (
        lambda t: _depth_at(t, t.uv_px, t.stroke_m)
    ),
    "this is the range along the ray: D is the horizontal distance, range times the cosine of the elevation": _range,
    "this is the height above the floor: D is the horizontal distance": partial(_height, True),
    "this is the height above the sphere centre: D is the horizontal distance": partial(_height, False),
    "angles are in degrees where radians are needed: tan() of degrees": _in_degrees,
    "this is the disparity in degrees: D is a distance in metres": partial(_disparity, 180.0 / np.pi),
    "this is the disparity in radians: D is a distance in metres": partial(_disparity, 1.0),
    "this is 1 / D: give D": lambda t: 1.0 / t.depth_m,
    "this is 1 / D in units of 1 / h: give D in metres": lambda t: t.stroke_m / t.depth_m,
    "depth_m is in millimetres: metres are needed": lambda t: 1e3 * t.depth_m,
    "depth_m is in centimetres: metres are needed": lambda t: 1e2 * t.depth_m,
    "D is in strokes: it must be multiplied by pair.stroke_m": lambda t: t.depth_m / t.stroke_m,
    "this is the diameter 2 D: halve it": lambda t: 2.0 * t.depth_m,
    "u runs to the left: column 0 is at the left": lambda t: _depth_at(t, _moved(t, mirrored="u")),
    "v runs upwards: row 0 is at the top": lambda t: _depth_at(t, _moved(t, mirrored="v")),
}
_TURN_DEG = 5  # of the first search; the second goes by single degrees
_OUTWARDS_PX = (-20.0, -15.0, -10.0, -7.0, -5.0, -3.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0)
_FEW = 12  # of the search of turns: every so many pixels are looked at


def _off(depth_m: Array, expected_m: Array) -> Array:
    """|log(depth / expected)|, shape (n,), at most 1; NaN where there is no answer, 1 where nothing is expected."""
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.minimum(np.abs(np.log(depth_m / expected_m)), 1.0)
    return np.where(np.isfinite(depth_m) & np.isnan(off), 1.0, off)


def _left(depth_m: Array, expected_m: Array) -> float:
    """Mean of `_off`: small where an answer agrees nearly everywhere."""
    return float(np.nanmean(_off(depth_m, expected_m)))


def _explains(depth_m: Array, expected_m: Array, true_m: Array) -> bool:
    """Tell whether answers follow what a rule expects, where that is far from the truth.

    Rules such as a turn of the grid change D in some places alone: only these are compared.
    """
    apart = (_off(true_m, expected_m) > _APART) & np.isfinite(depth_m)
    if apart.sum() < _LEAST_APART * np.isfinite(depth_m).sum():
        return False
    rule, truth = (float(np.median(_off(depth_m[apart], x[apart]))) for x in (expected_m, true_m))
    return rule <= _EXPLAINED * truth


def depth_fault(answers: _Answers) -> str:
    """Sentence on the fault of D; "" if there is none."""
    depth, true = answers.depth_m, answers.truth(_true_depth)
    if _spread(depth) < _CONSTANT:
        return "D is nearly the same for all pixels: is it a constant?"
    expected = {text: answers.truth(rule) for text, rule in DEPTH_RULES.items()} | _grids(answers)
    explained = [text for text, by_rule in expected.items() if _explains(depth, by_rule, true)]
    if explained:
        text = min(explained, key=lambda text: _left(depth, expected[text]))
        if _left(depth, expected[text]) < _left(depth, true):
            return text
    off = float(np.nanmedian(_off(depth, true)))
    if off <= _FAIR:
        return _grid_offset(answers) or _half_pixel(answers)
    ratio = float(np.nanmedian(depth / true))
    return f"D is {ratio:.2g} times the truth (median), off by {100.0 * np.expm1(off):.0f} %: a plain matcher has 5 %"


def _spread(depth_m: Array) -> float:
    known = depth_m[np.isfinite(depth_m)]
    return float(np.std(known) / np.mean(known)) if len(known) else 1.0


def _grids(answers: _Answers) -> dict[str, Array]:
    """D by the best turn of the unrolled grid, and by the best shift of its rows, with a sentence each."""
    few = answers.some(_FEW)

    def by(some: _Answers, **moved: float) -> Array:
        return some.truth(lambda t: _depth_at(t, _moved(t, **moved)))  # type: ignore[arg-type]

    def best(name: str, values: Sequence[float]) -> float:
        return min(values, key=lambda x: _left(few.depth_m, by(few, **{name: x})))

    coarse = best("turn_deg", range(_TURN_DEG, 360, _TURN_DEG))
    turn = best("turn_deg", [x for x in np.arange(coarse - _TURN_DEG + 1, coarse + _TURN_DEG) if x % 360])
    shift = best("outwards_px", _OUTWARDS_PX)
    signed = turn if turn <= 180 else turn - 360
    side = "outwards" if shift > 0 else "inwards"
    texts = {
        f"the unrolled grid is turned by about {signed:+.0f} degrees of azimuth: check which column is azimuth 0": (
            by(answers, turn_deg=turn)
        ),
        f"the unrolled grid's rows are off: D is that of pixels some {abs(shift):.0f} px further {side}": (
            by(answers, outwards_px=shift)
        ),
    }
    return texts


_TURNS_DEG = (-4.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
_ROWS_PX = (-10.0, -7.0, -5.0, -3.5, -2.0, -1.0, 0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0)
_BESIDE = 3.0  # median errors by which both D differ at pixels that vote
_VOTES, _NEARER = 60, 0.8  # a fair coin gives 0.8 of 60 votes once in 4e5
_BETTER = 0.9  # of the mean error may be left


def _grid_offset(answers: _Answers) -> str:
    """Sentence if D is that of a grid which is off by some pixels; "" if not.

    D changes little then, but where surfaces end. So pixels vote at which D of the other grid and of the right one
    differ by far more than the answers' own error: they are nearer to the one or to the other.
    """
    few = answers.some(_FEW // 2)
    true = few.truth(_true_depth)
    moved = [(turn, rows) for turn in _TURNS_DEG for rows in _ROWS_PX]

    def expected(move: tuple[float, float]) -> Array:
        return few.truth(lambda t: _depth_at(t, _moved(t, turn_deg=move[0], outwards_px=move[1])))

    best = min(moved, key=lambda move: _left(few.depth_m, expected(move)))
    other, off = expected(best), _off(few.depth_m, true)
    apart = np.isfinite(off) & (_off(true, other) > max(_BESIDE * float(np.nanmedian(off)), _LEAST_APART))
    nearer = _off(few.depth_m, other)[apart] < off[apart]
    if (
        len(nearer) < _VOTES
        or nearer.mean() < _NEARER
        or _left(few.depth_m, other) > _BETTER * _left(few.depth_m, true)
    ):
        return ""
    turn, rows = best
    way = f"{abs(rows):g} px further {'outwards' if rows > 0 else 'inwards'}"
    both = " and ".join([f"{turn:+g} degrees of azimuth further"] * (turn != 0.0) + [way] * (rows != 0.0))
    return f"the unrolled grid is off: D is that of pixels about {both}; does a cell's value stand at its centre?"


_CENTRE = "the centre of the first pixel is (0, 0), the image begins at -0.5"
_SIDES = ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (1.0, -1.0))  # of a shift of (u, v)
_HYPOTHESES = [
    (text, (sign * a * side[0], sign * a * side[1], sign * b * side[0], sign * b * side[1]))
    for text, a, b in (("both images", 0.5, 0.5), ("the down image", 0.5, 0.0), ("the up image", 0.0, 0.5))
    for side in _SIDES
    for sign in (1.0, -1.0)
]
_SIGMAS, _ALIKE = 8.0, 25.0  # of a shift to be named; pixels whose errors count as one: windows overlap
# Of what any shifts explain. What a shift leaves is the squared effect of its distance from the best one. The best one
# is as near to the next hypothesis at a quarter of a pixel: of (0.5, 0.5) that leaves 0.25^2 / 0.5 = 1/8.
_EXPLAINS = 7.0 / 8.0
# Another offset of the up image is told from halfway to half a pixel on, if without it the rms error is less by an
# eighth, 1 - sqrt(3/4): what is worth less is no convention.
_OFFSET_PX, _SHARE = 0.25, 0.25
_INLIER = 4.0  # robust deviations
_STEEP = 0.3  # relative change of D by a pixel from which it is no longer linear


def _half_pixel(answers: _Answers) -> str:
    """Sentence if the errors of D are those of pixels that are off, as of centres at a half; "" if not.

    Errors are compared with the effects of shifts of either image along u and v, by least squares among the inliers.
    A shift of one image is nearly the opposite one of the other: where no half pixel explains them, that of the up
    image alone is told.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        error = answers.depth_m / answers.truth(_true_depth) - 1.0
    A = 2.0 * np.stack([answers.truth(partial(_shifted, tuple(shift))) for shift in 0.5 * np.eye(4)], axis=1)
    limit = max(_INLIER * 1.4826 * float(np.nanmedian(np.abs(error))), 0.01)
    good = np.isfinite(error) & (np.abs(error) < limit) & (np.abs(A).max(axis=1) < _STEEP)  # False for NaN
    if good.sum() < 1000:
        return ""
    A, y = A[good], error[good]

    def left(shift: Array) -> float:
        return float(np.sum((y - A @ shift) ** 2))

    none, least = left(np.zeros(4)), left(np.linalg.lstsq(A, y, rcond=None)[0])
    (text, shift) = min(_HYPOTHESES, key=lambda item: left(np.array(item[1])))
    gained, one = none - left(np.array(shift)), _ALIKE * max(least / len(y), 1e-12)
    if gained > _SIGMAS**2 * one and gained > _EXPLAINS * (none - least):
        return f"pixels of {text} are off by half a pixel ({_told(shift)}): {_CENTRE}"
    up = np.linalg.lstsq(A[:, 2:], y, rcond=None)[0]
    gained = none - left(np.array([0.0, 0.0, *up]))
    if gained > max(_SIGMAS**2 * one, _SHARE * none) and np.abs(up).max() > _OFFSET_PX:
        return f"pixels of one image are off against the other ({_told((0.0, 0.0, *up))}): {_CENTRE}"
    return ""


def _told(shift: Sequence[float]) -> str:
    down, up = (f"({u:+.1f}, {v:+.1f})" if u or v else "" for u, v in (shift[:2], shift[2:]))
    return ", ".join([f"{down} px in the down image"] * bool(down) + [f"{up} px in the up image"] * bool(up))


def _shifted(shift_px: Sequence[float], truth: EasyTruth) -> Array:
    """Relative change of D by shifts (u, v) of the pixels of the down and of the up image."""
    return _depth(truth, truth.up_px + shift_px[2:], truth.uv_px + shift_px[:2]) / truth.depth_m - 1.0


# Rules for places.

TARGET_RULES: dict[str, Rule] = {
    "the axes are swapped: these are (v, u), row first; give (u, v), column first": lambda t: t.up_px[:, ::-1],
    "this is the shift from the down to the up image: add the pixel's own place": lambda t: t.up_px - t.uv_px,
    "this is the shift from the up to the down image: give the place in the up image": lambda t: t.uv_px - t.up_px,
    "the shift has the wrong sign: the place lies on the other side of the pixel": lambda t: 2.0 * t.uv_px - t.up_px,
    "the images are swapped: this is the place in the down image of what the pixel shows in the up image": (
        lambda t: _back(t)
    ),
    "places are halved, as in an image binned 2 x 2: give pixels of the whole image": lambda t: (t.up_px - 0.5) / 2.0,
    "places are those of the down image: the answer repeats the pixel": lambda t: t.uv_px,
}


def _back(truth: EasyTruth) -> Array:
    """Place in the down image of the points that pixels show in the up image."""
    return image_of(truth.rig.at(0.0), points_of(truth.rig.at(truth.stroke_m), truth.room, truth.uv_px)).uv_px


def target_fault(answers: _Answers, target_px: Array) -> str:
    """Sentence on the fault of places; "" if there is none."""

    def distance(rule: Rule) -> float:
        off = np.linalg.norm(target_px - answers.truth(rule), axis=1)
        return float(np.nanmedian(off)) if np.isfinite(off).any() else float("inf")

    error = target_px - answers.truth(lambda t: t.up_px)
    off = distance(lambda t: t.up_px)
    left = {text: distance(rule) for text, rule in TARGET_RULES.items()}
    text = min(left, key=lambda name: left[name])
    if off > 1.0 and left[text] <= _EXPLAINED * off:
        return text
    if off > _NEAR_PX:
        return f"the places are {off:.1f} px from the truth (median): a plain matcher comes within 1 px"
    mean = np.nanmedian(error, axis=0)
    if (np.abs(np.abs(mean) - 0.5) < 0.2).all():
        return f"the places are off by half a pixel ({mean[0]:+.2f}, {mean[1]:+.2f} px): {_CENTRE}"
    return ""


# Everything together.


def _faults(answers: _Answers) -> Iterator[str]:
    known = np.isfinite(answers.depth_m) if answers.target_px is None else np.isfinite(answers.target_px).all(axis=1)
    if known.sum() < _LEAST_ANSWERED:
        yield f"{known.sum()} of {known.size} pixels are answered, although all have a pattern"
        return  # what is said of the few would mislead
    target = answers.target_px
    fault = depth_fault(answers) if target is None else target_fault(answers, target)
    if fault:
        yield fault
    elif answers.sigma_m is not None:  # a sigma says nothing about a D that is wrong by a rule
        yield from filter(None, [sigma_fault(answers.depth_m - answers.truth(_true_depth), answers.sigma_m)])


_PULL = (0.33, 3.0)  # of the median: outliers do not count


def sigma_fault(error_m: Array, sigma_m: Array) -> str:
    """Sentence on the size of claimed standard deviations; "" if it is right."""
    known = np.isfinite(error_m) & np.isfinite(sigma_m)
    if known.sum() < 100:
        return ""  # too few to tell
    pull = float(np.median(np.abs(error_m[known]) / sigma_m[known]) / 0.6745)  # the median of a normal |x|
    if _PULL[0] <= pull <= _PULL[1]:
        return ""
    size, sigma = np.maximum(np.abs(error_m[known]), 1e-12), sigma_m[known]
    root = float(np.median(size / np.sqrt(sigma)) / 0.6745)
    # pulls of the right scale scatter least
    spreads = [float(np.subtract(*np.quantile(np.log(size / x), [0.75, 0.25]))) for x in (sigma, np.sqrt(sigma))]
    if _PULL[0] <= root <= _PULL[1] and spreads[1] < spreads[0]:
        return "sigma_depth_m holds variances: standard deviations are needed, metres"
    wrong = "small" if pull > 1.0 else "large"
    return f"sigma_depth_m is too {wrong}: the errors are {pull:.2g} times what it says (by medians)"


def _notes(answers: _Answers, seconds: Sequence[float]) -> Iterator[str]:
    true = answers.truth(_true_depth)
    error = np.abs(answers.depth_m / true - 1.0)
    known = np.isfinite(error)
    yield f"{100.0 * known.mean():.2g} % of the pixels answered"
    if known.any():
        beyond = 100.0 * np.mean(error[known] > 0.1)
        yield f"error of D: median {100.0 * np.median(error[known]):.2f} %, above 10 % in {beyond:.0f} % of them"
    yield f"time: median {np.median(seconds):.2f} s, longest {max(seconds):.2f} s a pair"
