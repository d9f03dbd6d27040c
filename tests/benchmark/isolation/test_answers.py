"""Answers on their way to the parent: what arrives as it was, what is taken as a number, what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from phibench.benchmark.isolation.answers import AnswerError, answer_document, checked_answer
from phibench.estimator.interface import Answer, Spot


def through(answer: object) -> Answer:
    """An answer on its way to the parent."""
    return checked_answer(json.loads(json.dumps(answer_document(answer))))


MISSING = Spot.missing("x")


def test_sound_answers_arrive_as_they_were() -> None:
    spot = Spot((1.5, -0.5), ((0.04, 0.01), (0.01, 0.09)), 0.7, "normal")
    whole = Answer(spot, MISSING, 2.5, 0.1)
    assert through(whole) == whole
    interval = Answer(spot, MISSING, 2.5, 0.1, (2.2, 2.9))
    assert through(interval) == interval
    numpy_like = Answer(Spot(np.array([1.5, -0.5]), np.eye(2), np.float64(0.7)), MISSING, np.float32(2.5))  # type: ignore[arg-type]
    assert through(numpy_like) == Answer(Spot((1.5, -0.5), ((1.0, 0.0), (0.0, 1.0)), 0.7), MISSING, 2.5)
    assert through(Answer(Spot((np.nan, np.nan), status="too faint"), MISSING)).down == Spot.missing("too faint")
    long = Answer(Spot(tuple(np.array([1.5, 2.5], np.longdouble))), MISSING, np.longdouble(2.5))  # type: ignore[arg-type]
    assert through(long) == Answer(Spot((1.5, 2.5)), MISSING, 2.5)
    assert through(Answer(Spot(np.array([3, 4], np.uint8)), MISSING)).down.uv_px == (3.0, 4.0)  # type: ignore[arg-type]


class Tensor:
    """A tensor as torch has it: `size` is a function, and conversion by NumPy is refused where a gradient is kept."""

    def __init__(self, values: object) -> None:
        self._values = np.array(values)
        self.shape = self._values.shape

    def size(self) -> tuple[int, ...]:
        return self.shape

    def tolist(self) -> object:
        return self._values.tolist()

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")


class Buffer:
    """An array of a library that has nothing but `__array__`."""

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        return np.array([1.5, 2.5], np.float32)


def test_tensors_are_numbers() -> None:
    tensors = Answer(
        Spot(Tensor([1.5, 2.5]), Tensor(np.eye(2)), Tensor(0.5)), Spot((Tensor(1), Tensor(2.0))), Tensor(3)
    )  # type: ignore[arg-type]
    assert through(tensors) == Answer(Spot((1.5, 2.5), ((1.0, 0.0), (0.0, 1.0)), 0.5), Spot((1.0, 2.0)), 3.0)
    assert through(Answer(Spot(Buffer()), MISSING)).down.uv_px == (1.5, 2.5)  # type: ignore[arg-type]
    with pytest.raises(AnswerError, match=r"down\.uv_px is an array of shape"):
        through(Answer(Spot(Tensor(np.zeros((720, 1280)))), MISSING))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (None, "the method returned None: an Answer(down, up) is needed"),
        ((1.0, 2.0), "the method returned a tuple of 2"),
        (np.zeros((2, 2)), "the method returned an array of shape (2, 2)"),
        (Answer((1.0, 2.0), MISSING), "down is a tuple of 2: a Spot is needed"),  # type: ignore[arg-type]
        (Answer(MISSING, Spot()), "up.uv_px is None with status 'ok': two numbers"),
        (Answer(Spot((1.0, 2.0, 3.0)), MISSING), "down.uv_px is [1.0, 2.0, 3.0]"),  # type: ignore[arg-type]
        (Answer(Spot(("1", "2")), MISSING), "down.uv_px is ['1', '2']"),  # type: ignore[arg-type]
        (Answer(Spot(np.zeros((720, 1280))), MISSING), "down.uv_px is an array of shape (720, 1280)"),  # type: ignore[arg-type]
        (Answer(Spot((1.0, math.inf)), MISSING), "down.uv_px is (1, inf)"),
        (Answer(Spot((1.0, 2.0), phi_rad=43.0), MISSING), "These look like degrees: give radians"),
        (Answer(Spot((1.0, 2.0), phi_rad=-0.1), MISSING), "allowed range is 0 to pi/2"),
        (Answer(Spot((1.0, 2.0), phi_rad=math.nan), MISSING), "down.phi_rad is nan"),
        (Answer(Spot((1.0, 2.0), phi_convention="rays"), MISSING), "did you mean 'ray'"),
        (
            Answer(Spot((1.0, 2.0), ((1.0, 2.0), (2.0, 1.0))), MISSING),
            "not positive definite: its least eigenvalue is -1",
        ),
        (Answer(Spot((1.0, 2.0), ((0.0, 0.0), (0.0, 1.0))), MISSING), "not positive definite"),
        (Answer(Spot((1.0, 2.0), ((1.0, 0.2), (0.0, 1.0))), MISSING), "not symmetric: 0.2 and 0"),
        (Answer(Spot((1.0, 2.0), (0.1, 0.2)), MISSING), "2 x 2 numbers are needed"),  # type: ignore[arg-type]
        (Answer(Spot((1.0, 2.0), ((math.nan, 0.0), (0.0, 1.0))), MISSING), "not finite: give None"),
        (Answer(MISSING, MISSING, -2.0), "depth_m is -2.0: a finite number above 0"),
        (Answer(MISSING, MISSING, math.nan), "depth_m is nan"),
        (Answer(MISSING, MISSING, None, 0.1), "sigma_depth_m comes without depth_m"),
        (Answer(MISSING, MISSING, None, None, (1.0, 2.0)), "interval_depth_m comes without depth_m"),
        (Answer(MISSING, MISSING, 2.5, 0.1, (2.6, 2.9)), "two numbers low < high about depth_m"),
        (Answer(MISSING, MISSING, 2.5, 0.1, (2.5, 2.5)), "two numbers low < high about depth_m"),
        (Answer(MISSING, MISSING, 2.5, 0.1, (math.nan, 2.9)), "interval_depth_m is nan"),
        (Answer(MISSING, MISSING, 2.5, 0.1, 0.3), "two numbers (low, high) are needed"),  # type: ignore[arg-type]
        (Answer(Spot(status=""), MISSING), "down.status is ''"),
        (Answer(Spot(status=3), MISSING), "down.status is 3"),  # type: ignore[arg-type]
    ],
)
def test_what_is_no_answer_is_said_in_a_sentence(answer: object, sentence: str) -> None:
    with pytest.raises(AnswerError) as caught:
        through(answer)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
