"""What is wrong with positions, angles and covariances whose truth is known, in plain words.

A mistake of convention moves every spot by a rule; each rule is tried on the truth, and one that predicts the answers
is named. Positions have the shape (n, 2, 2): pair, (down, up), (u, v); NaN where there is none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array

NEAR_PX = 2.0  # median error up to which a method sees the spot; the worst built-in has 0.7 on these pairs
_EXPLAINED = 0.2  # of the median error may remain under a rule that is named
_OFFSET_PX = 0.25  # mean offset that is no accident of a coarse method, if it is also significant
_OFFSET_SIGMAS = 5.0  # false alarm below 1e-5 for 20 spots, 2 axes
_HALF_PX = 0.2  # by which a half-pixel offset may miss a half
_PULL = (0.5, 2.0)  # of 40 numbers: outside by chance 3e-8 (chi squared)
_LEAST_PULLS = 10


@dataclass(frozen=True)
class Views:
    """What the rules need besides the true positions.

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
    """What is wrong with positions; "" if nothing is.

    Parameters
    ----------
    answer_px, truth_px : shape (n, 2, 2)
    views : Views
    """
    error = _median_distance(answer_px, truth_px)
    if not np.isfinite(error):
        return ""
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
    """What is wrong with the size of claimed covariances; "" if nothing is, or if there are too few to tell.

    Parameters
    ----------
    error_px : shape (n, 2)
    covariance_px2 : shape (n, 2, 2)
    """
    pull = rms_pull(error_px, covariance_px2)
    if 2 * len(error_px) < _LEAST_PULLS or _PULL[0] <= pull <= _PULL[1]:
        return ""
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
