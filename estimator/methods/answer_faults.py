"""Faults of a method's positions, covariances, phi and D on easy pairs: wrong axes, units or conventions, in words.

A mistake of convention moves every answer by a rule. Of the rules that predict the answers the nearest is named.
Positions have the shape (n, 2, 2): pair, (down, up), (u, v), pixels; NaN where there is none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array

# -- positions ---------------------------------------------------------------------------------------------------------

NEAR_PX = 2.0  # median error up to which a method sees the spot; the worst built-in has 0.7 on these pairs
_EXPLAINED = 0.2  # of the median error may remain under a rule that is named
_OFFSET_PX = 0.25  # mean offset that is no accident of a coarse method, if it is also significant
_OFFSET_SIGMAS = 5.0  # false alarm below 1e-5 for 20 spots, 2 axes
_HALF_PX = 0.2  # by which a half-pixel offset may miss a half
_SAME_PX = 0.01  # scatter of answers that are all one
_CORNER_PX = 3.0  # no spot of an image of hundreds of pixels is so near its corner
_WILD_PX, _WILD = 5.0, 0.2  # error of a spot that is not seen, and part of them that is no accident
_HALF_BOX = 32.0


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

    @property
    def middle_px(self) -> Array:
        """Middle (u, v) of the image."""
        return np.array([0.5 * (self.shape[1] - 1.0), 0.5 * (self.shape[0] - 1.0)])


Rule = Callable[[Array, Views], Array]


def _mirrored(uv_px: Array, axis: int, size: float) -> Array:
    mirrored = uv_px.copy()
    mirrored[..., axis] = size - 1 - uv_px[..., axis]
    return mirrored


def _binned(times: float) -> Rule:
    """Positions in an image whose pixels are squares of so many, or parts of one."""
    return lambda uv, _: (uv - 0.5 * (times - 1.0)) / times


def _in_box(rule: Rule) -> Rule:
    return lambda uv, s: rule(uv - s.origin_px, s)


_WHOLE = "give pixels of the whole image"
RULES: dict[str, Rule] = {
    "the axes are swapped: these are (v, u), row first; give (u, v), column first": lambda uv, _: uv[..., ::-1],
    "v runs upwards: it must run downwards, row 0 at the top": lambda uv, s: _mirrored(uv, 1, s.shape[0]),
    "u runs to the left: it must run to the right, column 0 at the left": lambda uv, s: _mirrored(uv, 0, s.shape[1]),
    "the image was turned by 180 degrees: give pixels of the image as it is": lambda uv, s: 2.0 * s.middle_px - uv,
    "the frames are swapped: 'down' holds the spot of the up image and the other way round": lambda uv, _: uv[:, ::-1],
    "both are the spot of the down image: look for the other one in pair.up": lambda uv, _: uv[:, [0, 0]],
    "both are the spot of the up image: look for the other one in pair.down": lambda uv, _: uv[:, [1, 1]],
    "these are the spots of the pair before: keep nothing from pair to pair": lambda uv, _: np.roll(uv, 1, axis=0),
    "positions are relative to the box: add (box.u0_px, box.v0_px)": lambda uv, s: uv - s.origin_px,
    f"positions are relative to the box, and halved: {_WHOLE}": _in_box(_binned(2.0)),
    "positions are relative to the box, and (v, u): give (u, v), and add (box.u0_px, box.v0_px)": _in_box(
        lambda uv, _: uv[..., ::-1]
    ),
    "the axes are swapped in the box: give (u, v) before its first pixel is added": lambda uv, s: (
        (uv - s.origin_px)[..., ::-1] + s.origin_px
    ),
    "v runs upwards in the box: it must run downwards, row 0 at the top": lambda uv, s: (
        _mirrored(uv - s.origin_px, 1, 2.0 * _HALF_BOX) + s.origin_px
    ),
    "these are the first pixels of the boxes: look for the spot inside": lambda _, s: s.origin_px,
    "these are the middles of the boxes: look for the spot inside": lambda _, s: s.origin_px + _HALF_BOX,
    f"positions are halved, as in an image binned 2 x 2: {_WHOLE}": _binned(2.0),
    f"positions are halved, and (v, u): give (u, v), and {_WHOLE[5:]}": lambda uv, s: _binned(2.0)(uv, s)[..., ::-1],
    f"positions are a third, as in an image binned 3 x 3: {_WHOLE}": _binned(3.0),
    f"positions are a quarter, as in an image binned 4 x 4: {_WHOLE}": _binned(4.0),
    "positions are doubled, as in an image made larger: give pixels of the image as it is": _binned(0.5),
    "positions count from the image's middle: the first pixel is (0, 0)": lambda uv, s: uv - s.middle_px,
    "positions count from the image's middle, v upwards: the first pixel is (0, 0), v runs downwards": lambda uv, s: (
        (uv - s.middle_px) * np.array([1.0, -1.0])
    ),
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
    if one := _one_image_fault(answer_px, truth_px, views):
        return one
    if error <= NEAR_PX:
        return _offset_fault((answer_px - truth_px).reshape(-1, 2))
    return (
        rule_fault(answer_px, truth_px, views)
        or _constant_fault(answer_px)
        or _shift_fault(answer_px - truth_px)
        or f"the positions are {error:.1f} px from the spot (median); a coarse method comes within 1 px on these "
        "pairs: is something else than the laser spot found?"
    )


def rule_fault(answer_px: Array, truth_px: Array, views: Views) -> str:
    """Words of the rule that predicts positions which are far off; "" if none does."""
    error = _median_distance(answer_px, truth_px)
    if not error > NEAR_PX:
        return ""
    left = {text: _median_distance(answer_px, rule(truth_px, views)) for text, rule in RULES.items()}
    text = min(left, key=lambda name: left[name])
    return text if left[text] < min(NEAR_PX, _EXPLAINED * error) else ""


def _one_image_fault(answer_px: Array, truth_px: Array, views: Views) -> str:
    """Fault of the answers for one image, where those for the other are right."""
    errors = [_median_distance(answer_px[:, k], truth_px[:, k]) for k in (0, 1)]
    if not min(errors) <= NEAR_PX < max(errors):
        return ""
    k = int(np.argmax(errors))
    name, other = ("down", "up") if k == 0 else ("up", "down")
    # a rule that leaves the right image as it is, or moves it as well: what it says of the wrong one counts
    left = {
        text: _median_distance(answer_px[:, k], rule(truth_px, views)[:, k])
        for text, rule in RULES.items()
        if not text.startswith("the frames are swapped")
    }
    text = min(left, key=lambda one: left[one])
    if left[text] >= min(NEAR_PX, _EXPLAINED * errors[k]):
        text = _constant_fault(answer_px[:, [k]]) or f"they are {errors[k]:.1f} px from the spot (median)"
    return f"positions in the image '{name}' are wrong, those in '{other}' are right: {text}"


def _constant_fault(answer_px: Array) -> str:
    """Fault of positions that do not depend on the images, or are no pixels."""
    seen = answer_px.reshape(-1, 2)[np.isfinite(answer_px).all(axis=-1).ravel()]
    if len(seen) > 2 and np.all(np.ptp(seen, axis=0) <= _SAME_PX):
        return f"all positions are ({seen[0][0]:.1f}, {seen[0][1]:.1f}) px: does the method look at the images?"
    if np.all(np.abs(seen) <= _CORNER_PX):
        return "positions are no pixels but parts of the image's size, tangents or millimetres: give pixels"
    return ""


def _shift_fault(error_px: Array) -> str:
    """Fault of positions that are all off by the same pixels, as in a part that was cut out."""
    seen = error_px.reshape(-1, 2)[np.isfinite(error_px).all(axis=-1).ravel()]
    shift = np.median(seen, axis=0)
    if np.median(np.linalg.norm(seen - shift, axis=1)) > min(NEAR_PX, _EXPLAINED * float(np.linalg.norm(shift))):
        return ""
    return (
        f"all positions are off by ({shift[0]:+.1f}, {shift[1]:+.1f}) px, as in a part that was cut out of the image: "
        f"{_WHOLE}"
    )


def wild_fault(error_px: Array) -> str:
    """Fault of spots that are far off, where most are right."""
    distance = np.linalg.norm(error_px, axis=-1)
    seen = distance[np.isfinite(distance)]
    far = seen[seen > _WILD_PX]
    if len(far) <= _WILD * len(seen):
        return ""
    return (
        f"{len(far)} of {len(seen)} positions are {np.median(far):.0f} px from the spot (median), others are right: is "
        "something else than the laser spot found there?"
    )


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


def whole_pixels_note(answer_px: Array) -> str:
    """Sentence on positions that are all whole pixels, or multiples of them; "" if they are not."""
    seen = answer_px[np.isfinite(answer_px)]
    step = next((step for step in (8.0, 4.0, 2.0, 1.0) if len(seen) and np.all(seen % step == 0.0)), 0.0)
    if not step:
        return ""
    return f"all positions are multiples of {step:g} px: fractions of a pixel are known to some hundredths here"


def _median_distance(a_px: Array, b_px: Array) -> float:
    distance = np.linalg.norm(a_px - b_px, axis=-1)
    seen = distance[np.isfinite(distance)]
    return float(np.median(seen)) if seen.size else float("nan")


# -- covariances -------------------------------------------------------------------------------------------------------

_PULL = (0.5, 2.0)  # of 40 numbers: outside by chance 3e-8 (chi squared)
_LEAST_PULLS = 10  # of fewer the deviation is uncertain by more than a fifth
_DEPTH_PULL = (0.2, 2.5)  # of 10 numbers: outside by chance below 1e-5


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


# -- angles and depths -------------------------------------------------------------------------------------------------

_NEAR_RAD = 0.02  # 3 px of the default rig; the senses of phi differ by 0.08 on easy pairs
_NEAR_DEPTH = 0.15  # relative: a spot that is off by some pixels stays within
_RULED_DEPTH = 0.06  # and less under a rule that is named
_OWN_DEPTH = 0.02  # by which D may differ from that of the answer's own positions


@dataclass(frozen=True)
class SeenAngle:
    """One answered angle: value, its convention, and the true angles of its image and of the other one."""

    phi_rad: float
    convention: str
    truth: dict[str, float]
    other: dict[str, float]


@dataclass(frozen=True)
class SeenDepth:
    """One answered depth: D, its standard deviation, the true D and stroke, and D of the answer's own positions."""

    depth_m: float
    sigma_m: float | None
    truth_m: float
    stroke_m: float
    own_m: float


_ANGLES: dict[str, Callable[[SeenAngle], float]] = {
    "phi_rad is theta, the ray's angle from the downward vertical: phi is half of it": lambda a: 2.0 * a.truth["ray"],
    "phi_rad is twice the normal's angle: set phi_convention='normal', and give half of it": lambda a: (
        2.0 * a.truth["normal"]
    ),
    "phi_rad is half of the angle: it was halved twice": lambda a: 0.5 * a.truth[a.convention],
    "phi_rad is the rest to a right angle, from the horizontal: it must be from the downward vertical": lambda a: (
        0.5 * math.pi - a.truth[a.convention]
    ),
    "phi_rad is the angle's tangent: give the angle, np.arctan of it": lambda a: math.tan(a.truth[a.convention]),
    "phi_rad is the angle's sine: give the angle, np.arcsin of it": lambda a: math.sin(a.truth[a.convention]),
    "phi_rad is in half turns: give radians, pi times as much": lambda a: a.truth[a.convention] / math.pi,
    "phi_rad is in turns: give radians, 2 pi times as much": lambda a: 0.5 * a.truth[a.convention] / math.pi,
    "phi_rad of down and up are exchanged": lambda a: a.other[a.convention],
}


def phi_fault(angles: Sequence[SeenAngle]) -> str:
    """Sentence on the fault of angles; "" if there is none.

    The convention "outline" is none of the truth's and is left alone.
    """
    known = [angle for angle in angles if angle.convention in angle.truth]
    if not known:
        return ""  # no angle was answered

    def off(rule: Callable[[SeenAngle], float]) -> float:
        return float(np.median([abs(angle.phi_rad - rule(angle)) for angle in known]))

    said, convention = off(lambda angle: angle.truth[angle.convention]), known[0].convention
    if said <= _NEAR_RAD:
        return ""  # the sense that it states is right
    senses = {name: off(lambda angle, name=name: angle.truth[name]) for name in ("ray", "normal", "incidence")}  # type: ignore[misc]
    best = min(senses, key=lambda name: senses[name])
    if senses[best] <= _NEAR_RAD:
        return f"phi_rad is the angle '{best}', not '{convention}': set phi_convention='{best}'"
    if np.ptp([angle.phi_rad for angle in known]) < 1e-9:
        return f"phi_rad is {known[0].phi_rad:.3g} for all spots: does the method look at the images?"
    left = {text: off(rule) for text, rule in _ANGLES.items()}
    text = min(left, key=lambda one: left[one])
    if left[text] <= min(_NEAR_RAD, 0.5 * said):
        return text
    return f"phi_rad is off by {said:.2g} rad (median) from the angle '{convention}'"


_DEPTHS: dict[str, Callable[[SeenDepth], float]] = {
    "depth_m is in millimetres: metres are needed": lambda d: 1000.0 * d.truth_m,
    "depth_m is in centimetres: metres are needed": lambda d: 100.0 * d.truth_m,
    "depth_m is in decimetres: metres are needed": lambda d: 10.0 * d.truth_m,
    "depth_m is in kilometres: metres are needed": lambda d: 1e-3 * d.truth_m,
    "depth_m is in inches: metres are needed": lambda d: d.truth_m / 0.0254,
    "depth_m is in feet: metres are needed": lambda d: d.truth_m / 0.3048,
    "depth_m is half of D": lambda d: 0.5 * d.truth_m,
    "depth_m is twice D": lambda d: 2.0 * d.truth_m,
    "depth_m is 1 / D: give D": lambda d: 1.0 / d.truth_m,
    "depth_m is D over the stroke: multiply it by pair.stroke_m": lambda d: d.truth_m / d.stroke_m,
    "depth_m is D times the stroke: divide it by pair.stroke_m": lambda d: d.truth_m * d.stroke_m,
    "depth_m is the stroke: give D": lambda d: d.stroke_m,
    "depth_m is D and the stroke together: D is horizontal, from the robot's axis": lambda d: d.truth_m + d.stroke_m,
    "depth_m is D less the stroke: D is horizontal, from the robot's axis": lambda d: d.truth_m - d.stroke_m,
}


def depth_fault(depths: Sequence[SeenDepth]) -> str:
    """Sentence on the fault of depths or of their standard deviations; "" if there is none."""
    if not depths:
        return ""

    def off(rule: Callable[[SeenDepth], float]) -> float:
        return float(np.median([abs(d.depth_m / rule(d) - 1.0) for d in depths]))

    said, ratio = off(lambda d: d.truth_m), float(np.median([d.depth_m / d.truth_m for d in depths]))
    if said <= _NEAR_DEPTH:
        own = float(np.median([d.depth_m / d.own_m for d in depths if math.isfinite(d.own_m)] or [1.0]))
        if abs(own - 1.0) > _OWN_DEPTH:
            return (
                f"depth_m is {own:.3f} times the D of the answer's own positions (median): D is horizontal, from the "
                "robot's axis"
            )
        return _depth_sigma_fault(depths)
    if len(depths) > 2 and np.ptp([d.depth_m for d in depths]) < 1e-9:
        return f"depth_m is {depths[0].depth_m:g} for all pairs: does the method look at the images?"
    left = {text: off(rule) for text, rule in _DEPTHS.items()}
    text = min(left, key=lambda one: left[one])
    if left[text] <= _RULED_DEPTH:
        return text
    return f"depth_m is {ratio:.2g} times the true depth (median)"


def _depth_sigma_fault(depths: Sequence[SeenDepth]) -> str:
    """Sentence on the size of sigma_depth_m; "" if it is right, or if there are too few to tell."""
    claimed = [(d.depth_m - d.truth_m, d.sigma_m) for d in depths if d.sigma_m is not None]
    if len(claimed) < _LEAST_PULLS:
        return ""
    error, sigma = np.array(claimed, float).T

    def pull(deviation: Array) -> float:
        return float(np.sqrt(np.mean((error / deviation) ** 2)))

    low, high = _DEPTH_PULL
    if low <= pull(sigma) <= high:
        return ""
    said = f"(the errors are {pull(sigma):.2g} times what it says)"
    if low <= pull(np.sqrt(sigma)) <= high:
        return f"sigma_depth_m holds variances: standard deviations are needed, metres {said}"
    if low <= pull(1e-3 * sigma) <= high:
        return f"sigma_depth_m is in millimetres: metres are needed {said}"
    return f"sigma_depth_m is too {'small' if pull(sigma) > 1.0 else 'large'} {said}"
