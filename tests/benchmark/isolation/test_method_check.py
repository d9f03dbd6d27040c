"""`phibench method check`: each mistake that a method can make is made here, and the message must name it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.sandbox_pairs import HEADER, method_file

from phibench.benchmark.isolation.answers import AnswerError, answer_document, checked_answer
from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.benchmark.isolation.method_check import PAIRS, MethodCheck, check_method, check_of_outcomes
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.cli import main as cli
from phibench.estimator.geometry.phi import phi_normal, phi_ray
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Method, Outcome, Pair, Spot
from phibench.estimator.methods.answer_faults import Views, covariance_fault, position_fault
from phibench.estimator.methods.pair_light import mirror_mask
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair
from phibench.scenes.random_streams import generator

Change = Callable[[Pair, Spot, str], Spot]
SET = EasyPairs(count=PAIRS)


MADE, TRUE = cache(EasyPairs.pair), cache(EasyPairs.truth)


@pytest.fixture(autouse=True)
def made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each easy pair is made once for all tests of this file: making ten takes longer than judging them."""
    monkeypatch.setattr(EasyPairs, "pair", MADE)
    monkeypatch.setattr(EasyPairs, "truth", TRUE)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return list(shown(SET))


@cache
def shown(of: EasyPairs) -> tuple[Pair, ...]:
    """Pairs of a set, with the work that built-in methods share."""
    return tuple(SharedPair.of(of.pair(number)) for number in range(len(of)))


@cache
def of_the_method(name: str, number: int) -> Answer:
    """Answer of a built-in method; most of the mistakes below are made on the same ones."""
    return METHODS[name](shown(SET)[number])


def right(pair: Pair) -> Answer:
    return of_the_method("raw_maximum_likelihood", pair.number)


def coarse(pair: Pair) -> Answer:
    return of_the_method("brightest_pixel", pair.number)


def tried(method: Method, pairs: list[Pair], of: EasyPairs = SET) -> MethodCheck:
    """Judge a method in this process; answers go the way that they go from the method's process."""
    done = []
    for pair in pairs:
        try:
            done.append(Outcome(pair.number, checked_answer(answer_document(method(pair))), 0.01))
        except AnswerError as error:
            done.append(Outcome(pair.number, None, 0.01, "invalid", str(error)))
        except AttributeError as error:
            done.append(Outcome(pair.number, None, 0.01, "error", str(error)))
    return check_of_outcomes(done, of)


def each(change: Change, method: Method = right) -> Method:
    """Method whose spots are changed."""

    def changed(pair: Pair) -> Answer:
        answer = method(pair)
        return Answer(change(pair, answer.down, "down"), change(pair, answer.up, "up"))

    return changed


def moved(f: Callable[[float, float, Pair, str], tuple[float, float]]) -> Change:
    """Change of positions alone."""

    def change(pair: Pair, spot: Spot, name: str) -> Spot:
        assert spot.uv_px is not None
        return replace(spot, uv_px=f(*spot.uv_px, pair, name))

    return change


def swapped_frames(pair: Pair) -> Answer:
    answer = right(pair)
    return Answer(answer.up, answer.down)


def box_of(pair: Pair, name: str) -> tuple[int, int]:
    box = pair.box_down if name == "down" else pair.box_up
    assert box is not None
    return box.u0_px, box.v0_px


def deviations(_: Pair, spot: Spot, __: str) -> Spot:
    """Standard deviations on the diagonal of the covariance."""
    assert spot.covariance_px2 is not None
    (a, _b), (_c, d) = spot.covariance_px2
    return replace(spot, covariance_px2=((math.sqrt(a), 0.0), (0.0, math.sqrt(d))))


def scaled(factor: float) -> Change:
    def change(_: Pair, spot: Spot, __: str) -> Spot:
        (a, b), (c, d) = np.multiply(spot.covariance_px2, factor).tolist()
        return replace(spot, covariance_px2=((a, b), (c, d)))

    return change


def phi(pair: Pair, spot: Spot, name: str) -> float:
    view = pair.rig.at(0.0 if name == "down" else pair.stroke_m)
    return float(phi_ray(view, np.array(spot.uv_px)))


def depth(factor: float) -> Method:
    def method(pair: Pair) -> Answer:
        answer = right(pair)
        D = depth_exact(pair.rig, pair.stroke_m, np.array(answer.down.uv_px), np.array(answer.up.uv_px)).depth_m
        return replace(answer, depth_m=factor * float(D))

    return method


def of_depth(f: Callable[[float, Pair], float], sigma: Callable[[float], float] | None = None) -> Method:
    def method(pair: Pair) -> Answer:
        D = depth(1.0)(pair).depth_m
        assert D is not None
        return replace(right(pair), depth_m=f(D, pair), sigma_depth_m=None if sigma is None else sigma(D))

    return method


MISTAKES: dict[str, tuple[Method, str]] = {
    "wrong type": (
        lambda pair: (1.0, 2.0),
        "10 of 10 pairs: the answer is not valid: the method returned a tuple of 2",
    ),  # type: ignore[dict-item, return-value]
    "nothing returned": (lambda pair: None, "the method returned None: an Answer(down, up) is needed"),  # type: ignore[dict-item, return-value]
    "wrong shape": (each(moved(lambda u, v, *_: (u, v, 1.0))), "down.uv_px is ["),  # type: ignore[arg-type, return-value]
    "swapped axes": (each(moved(lambda u, v, *_: (v, u))), "the axes are swapped"),
    "swapped axes, coarse": (each(moved(lambda u, v, *_: (v, u)), coarse), "the axes are swapped"),
    "half a pixel more": (each(moved(lambda u, v, *_: (u + 0.5, v + 0.5))), "half a pixel too large in u and v"),
    "half a pixel less": (each(moved(lambda u, v, *_: (u - 0.5, v - 0.5))), "half a pixel too small in u and v"),
    "half, blurred": (
        each(moved(lambda u, v, *_: (u + 0.5, v + 0.5)), METHODS["windowed_centroid"]),
        "half a pixel too large",
    ),
    "counted from 1": (each(moved(lambda u, v, *_: (u + 1.0, v + 1.0))), "one pixel too large in u and v"),
    "off in u": (each(moved(lambda u, v, *_: (u + 0.4, v))), "off by (+0.40"),
    "mirrored v": (each(moved(lambda u, v, *_: (u, 719.0 - v))), "v runs upwards"),
    "mirrored v, counted from 1": (each(moved(lambda u, v, *_: (u, 720.0 - v))), "v runs upwards"),
    "mirrored u": (each(moved(lambda u, v, *_: (1279.0 - u, v))), "u runs to the left"),
    "swapped frames": (swapped_frames, "the frames are swapped"),
    "relative to the box": (
        each(moved(lambda u, v, p, n: (u - box_of(p, n)[0], v - box_of(p, n)[1]))),
        "relative to the box",
    ),
    "binned": (each(moved(lambda u, v, *_: (u / 2.0, v / 2.0))), "positions are halved"),
    "something else": (each(moved(lambda u, v, *_: (200.0, 200.0))), "all positions are (200.0, 200.0) px"),
    "degrees": (
        each(lambda p, s, n: replace(s, phi_rad=math.degrees(phi(p, s, n)))),
        "These look like degrees: give radians",
    ),
    "theta for phi": (each(lambda p, s, n: replace(s, phi_rad=min(2.0 * phi(p, s, n), 1.57))), "phi is half of it"),
    "normal for ray": (
        each(lambda p, s, n: replace(s, phi_rad=float(phi_normal(p.rig.at(0.0), np.array(s.uv_px))))),
        "phi_rad is the angle 'normal', not 'ray'",
    ),
    "phi of nothing": (each(lambda p, s, n: replace(s, phi_rad=0.1)), "phi_rad is 0.1 for all spots"),
    "NaN": (each(moved(lambda *_: (math.nan, math.nan))), "finite numbers, or Spot.missing('why')"),
    "indefinite": (
        each(lambda p, s, n: replace(s, covariance_px2=((1.0, 2.0), (2.0, 1.0)))),
        "covariance_px2 is not positive definite",
    ),
    "deviations": (each(deviations), "covariance_px2 holds standard deviations: variances are needed"),
    "optimistic": (each(scaled(0.04)), "covariance_px2 is too small"),
    "pessimistic": (each(scaled(25.0)), "covariance_px2 is too large"),
    "millimetres": (depth(1000.0), "depth_m is in millimetres"),
    "centimetres": (depth(100.0), "depth_m is in centimetres"),
    "half the depth": (depth(0.4), "times the true depth"),
    "turned": (each(moved(lambda u, v, *_: (1279.0 - u, 719.0 - v))), "turned by 180 degrees"),
    "from the middle": (each(moved(lambda u, v, *_: (u - 639.5, v - 359.5))), "count from the image's middle"),
    "doubled": (each(moved(lambda u, v, *_: (2.0 * u, 2.0 * v))), "positions are doubled"),
    "quarter": (each(moved(lambda u, v, *_: (u / 4.0, v / 4.0))), "positions are a quarter"),
    "parts of the image": (each(moved(lambda u, v, *_: (u / 1280.0, v / 720.0))), "positions are no pixels"),
    "cut out": (each(moved(lambda u, v, *_: (u - 40.0, v - 20.0))), "off by (-40.0, -20.0) px, as in a part"),
    "middle of the box": (
        each(moved(lambda u, v, p, n: (box_of(p, n)[0] + 31.5, box_of(p, n)[1] + 31.5))),
        "the middles of the boxes",
    ),
    "(v, u) in the box": (
        each(moved(lambda u, v, p, n: (v - box_of(p, n)[1] + box_of(p, n)[0], u - box_of(p, n)[0] + box_of(p, n)[1]))),
        "the axes are swapped in the box",
    ),
    "down for up": (lambda pair: Answer(right(pair).down, right(pair).down), "both are the spot of the down image"),
    "one image": (
        each(moved(lambda u, v, p, n: (u, v) if n == "down" else (v, u))),
        "positions in the image 'up' are wrong, those in 'down' are right: the axes are swapped",
    ),
    "some pairs": (
        each(moved(lambda u, v, p, n: (u + 100.0, v) if p.number < 4 else (u, v))),
        "8 of 20 positions are 100 px from the spot (median), others are right",
    ),
    "pair before": (lambda pair: right(MADE(SET, max(pair.number - 1, 0))), "the spots of the pair before"),
    "phi halved twice": (each(lambda p, s, n: replace(s, phi_rad=0.5 * phi(p, s, n))), "halved twice"),
    "elevation": (each(lambda p, s, n: replace(s, phi_rad=0.5 * math.pi - phi(p, s, n))), "the rest to a right angle"),
    "tangent": (each(lambda p, s, n: replace(s, phi_rad=min(math.tan(phi(p, s, n)), 1.57))), "the angle's tangent"),
    "half turns": (each(lambda p, s, n: replace(s, phi_rad=phi(p, s, n) / math.pi)), "in half turns"),
    "feet": (depth(1.0 / 0.3048), "depth_m is in feet"),
    "twice the depth": (depth(2.0), "depth_m is twice D"),
    "a tenth more": (depth(1.1), "1.100 times the D of the answer's own positions"),
    "stroke left out": (of_depth(lambda D, p: D / p.stroke_m), "D over the stroke"),
    "with the stroke": (of_depth(lambda D, p: D + p.stroke_m), "D and the stroke together"),
    "inverse": (of_depth(lambda D, p: 1.0 / D), "1 / D"),
    "one depth": (of_depth(lambda D, p: 9.0), "depth_m is 9 for all pairs"),
    "variance of D": (of_depth(lambda D, p: D, lambda D: (0.002 * D) ** 2), "sigma_depth_m holds variances"),
    "sigma of D in mm": (of_depth(lambda D, p: D, lambda D: 2.0 * D), "sigma_depth_m is in millimetres"),
    "gives up": (lambda pair: Answer(Spot.missing("dim"), Spot.missing("dim")), "all are easy: 'dim' (20 times)"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_is_named_and_nothing_else(pairs: list[Pair], name: str) -> None:
    method, words = MISTAKES[name]
    check = tried(method, pairs)
    assert not check.ok
    assert len(check.faults) == 1, check.faults
    assert words in check.faults[0]
    assert "\n" not in check.faults[0]


@pytest.mark.parametrize("name", ["raw_maximum_likelihood", "brightest_pixel", "red_centroid", "windowed_centroid"])
def test_sound_methods_pass(pairs: list[Pair], name: str) -> None:
    """Coarse ones too: the brightest pixel of a mosaic is up to a pixel off, and no mistake of convention."""
    check = tried(METHODS[name], pairs)
    assert check.faults == ()
    assert check.notes[0] == "10 of 10 pairs answered"


def test_a_sound_method_may_give_angle_and_depth(pairs: list[Pair]) -> None:
    assert tried(each(lambda p, s, n: replace(s, phi_rad=phi(p, s, n))), pairs).ok
    assert tried(depth(1.0), pairs).ok
    assert tried(METHODS["joint_fit"], pairs).ok


def test_noise_alone_is_not_taken_for_a_mistake() -> None:
    """400 drawn checks of an efficient method (20 spots, 20 mpx) and of one that rounds to whole pixels.

    The rules' false-alarm rates are below 1e-5 and 3e-8 a check: none in 800. The same with 0.5 px added is seen
    in every efficient one.
    """
    truth = np.array([[t.down.uv_px, t.up.uv_px] for t in map(SET.truth, range(PAIRS))])
    views = Views((720, 1280), np.zeros_like(truth))
    covariance = np.tile(4e-4 * np.eye(2), (20, 1, 1))
    rng, seen = generator("check", "noise"), 0
    for _ in range(400):
        error = 0.02 * rng.standard_normal(truth.shape)
        assert position_fault(truth + error, truth, views) == ""
        assert covariance_fault(error.reshape(-1, 2), covariance) == ""
        shifted = truth + rng.uniform(-0.5, 0.5, truth.shape)
        assert position_fault(np.rint(shifted), shifted, views) == ""
        assert "half a pixel too large" in position_fault(truth + error + 0.5, truth, views)
        seen += 1
    assert seen == 400


# -- pairs without boxes, and a blue light -----------------------------------------------------------------------------

WHOLE_SETS = {preset: EasyPairs(preset, 4, whole=3) for preset in ("bayer-raw", "mono-raw", "srgb8", "mjpeg")}


def brightest(channel: int | None) -> Method:
    """Largest on - off in the mirror, of the sum of the colours or of one of R, G, B, the box left alone."""

    def method(pair: Pair) -> Answer:
        spots = []
        for name in ("down", "up"):
            light = pair.images[name].astype(float) - pair.images[f"{name}_off"]
            if light.ndim == 3:
                light = light.sum(axis=2) if channel is None else light[..., channel]
            elif channel is not None:  # the site of a mosaic's colour: red at (0, 0), blue at (1, 1)
                sites = np.full(light.shape, -np.inf)
                at = (slice(channel // 2, None, 2), slice(channel // 2, None, 2))
                sites[at] = light[at]
                light = sites
            v, u = np.unravel_index(np.argmax(np.where(mirror_mask(pair), light, -np.inf)), light.shape)
            spots.append(Spot((float(u), float(v))))
        return Answer(*spots)

    return method


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_blue_taken_for_red_is_told_and_a_grey_picture_is_not(preset: str) -> None:
    of = WHOLE_SETS[preset]
    pairs = list(shown(of))
    (fault,) = tried(brightest(2), pairs, of).faults
    assert fault.startswith("6 of 6 spots are a fainter blue light: red and blue look exchanged")
    for channel in (0, None):
        assert tried(brightest(channel), pairs, of).faults == ()


def in_boxes(otherwise: Spot | None) -> Method:
    """The right answer in boxes; elsewhere a given one, or the crash of who reads a box that is not there."""

    def method(pair: Pair) -> Answer:
        if pair.box_down is None and otherwise is not None:
            return Answer(otherwise, otherwise)
        _ = pair.box_down.slices  # type: ignore[union-attr]
        return METHODS["brightest_pixel"](pair)

    return method


@pytest.mark.slow
def test_a_method_that_needs_boxes_is_told() -> None:
    of = EasyPairs(count=8, whole=3)
    pairs = [of.pair(number) for number in range(len(of))]
    assert [pair.box_down is None for pair in pairs] == [False] * 5 + [True] * 3
    assert [of.truth(number).hinted for number in range(8)] == [True] * 5 + [False] * 3
    (crash,) = tried(in_boxes(None), pairs, of).faults
    assert crash.startswith("3 of 8 pairs: the method raised an exception: 'NoneType' object has no attribute 'slices'")
    assert "box_down and box_up are None there" in crash
    (wrong,) = tried(in_boxes(Spot((3.0, 4.0))), pairs, of).faults
    assert "6 of 6 spots are wrong where a pair has no boxes" in wrong
    (silent,) = tried(in_boxes(Spot.missing("no box")), pairs, of).faults
    assert "6 of 6 spots are missing where a pair has no boxes: 'no box'" in silent


@pytest.mark.slow
@pytest.mark.parametrize("preset", WHOLE_SETS)
@pytest.mark.parametrize("name", ["detect", "brightest_pixel", "red_centroid", "laplacian_blob"])
def test_sound_methods_pass_without_boxes_and_beside_a_blue_light(preset: str, name: str) -> None:
    of = WHOLE_SETS[preset]
    assert tried(METHODS[name], list(shown(of)), of).faults == ()


def test_the_check_has_pairs_without_boxes(tmp_path: Path) -> None:
    reference = method_file(tmp_path, "return Answer(*[Spot((float(b.u0_px), 1.0)) for b in (pair.box_down,) * 2])")
    fault = check_method(reference, "mono-raw").faults[0]
    assert fault.startswith("3 of 10 pairs: the method raised an exception: AttributeError: 'NoneType' object")
    assert "(my_phi.py, line 6, in <listcomp>)" in fault or "(my_phi.py, line 6, in extract)" in fault


# -- through the method's process and the command line ----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("x = 1\nreturn x / 0", "ZeroDivisionError: division by zero (my_phi.py, line 7, in extract)"),
        (
            "pair.down[0, 0] = 0",
            "the input was written to: ValueError: assignment destination is read-only (my_phi.py, line 6",
        ),
        ("import time\ntime.sleep(60)", "2 of 2 pairs: too slow: no answer after 2 s, at my_phi.py, line 7"),
    ],
)
def test_failures_name_the_users_own_line(tmp_path: Path, body: str, words: str) -> None:
    limits = RunLimits(seconds=2.0 if "sleep" in body else 60.0)  # the machine may do other things
    check = check_method(method_file(tmp_path, body), limits=limits, count=2)
    assert len(check.faults) == 1
    assert words in check.faults[0]
    assert check.notes == ("0 of 2 pairs answered",)


@pytest.mark.slow
def test_check_gives_up_on_a_method_that_never_answers(tmp_path: Path) -> None:
    reference = method_file(tmp_path, "while True: pass")
    check = check_method(reference, limits=RunLimits(seconds=0.5))
    assert check.faults[0].startswith("3 of 3 pairs: too slow")


# whole frames with colours take the example 5 to 8 s; test_example_method.py has it in these presets, too
@pytest.mark.parametrize(
    "preset", ["mono-raw", *(pytest.param(p, marks=pytest.mark.slow) for p in ("bayer-raw", "srgb8", "mjpeg"))]
)
def test_the_written_example_passes(tmp_path: Path, monkeypatch, capsys, preset: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["method", "new", "mine.py"]) == 0
    assert "phibench method check mine.py:extract" in capsys.readouterr().out
    assert cli.main(["method", "check", "mine.py:extract", "--preset", preset]) == 0
    out = capsys.readouterr().out
    assert "10 of 10 pairs answered" in out
    assert "nothing wrong" in out
    assert "mine.py:extract" in (tmp_path / "mine.py").read_text()


@pytest.mark.slow
def test_check_exits_with_1_and_says_what_is_wrong(tmp_path: Path, capsys) -> None:
    reference = method_file(tmp_path, "return 5", header=HEADER)
    assert cli.main(["method", "check", reference]) == 1
    assert "wrong: 10 of 10 pairs: the answer is not valid: the method returned an int" in capsys.readouterr().out


def test_check_shows_what_the_method_prints(tmp_path: Path, capsys) -> None:
    reference = method_file(tmp_path, "print('number', pair.number)\nreturn 5", header=HEADER)
    raw = ("--preset", "mono-raw")  # pairs that tests above have made
    assert cli.main(["method", "check", reference, *raw]) == 1
    out = capsys.readouterr().out
    assert "--show-output shows it" in out
    assert "number 3" not in out
    assert cli.main(["method", "check", reference, *raw, "--show-output"]) == 1
    shown = capsys.readouterr()
    assert "printed for pair 3:\n    number 3\n" in shown.out
    assert "easy pairs: 10/10" in shown.err


def test_new_method_overwrites_nothing(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.py").write_text("precious")
    assert cli.main(["method", "new", str(tmp_path / "mine.py")]) == 2
    assert "is there already and is not overwritten" in capsys.readouterr().err
    assert (tmp_path / "mine.py").read_text() == "precious"
    assert cli.main(["method", "new", str(tmp_path / "mine.txt")]) == 2
    assert "must end in .py" in capsys.readouterr().err


def test_mistakes_of_the_command_line_are_2(capsys) -> None:
    assert cli.main(["method", "check", "nowhere.py:extract"]) == 2
    (line,) = capsys.readouterr().err.splitlines()  # before anything else is said
    assert "is not there" in line
    assert cli.main(["method", "check", "red_centroid", "--preset", "bayer"]) == 2
    assert "did you mean 'bayer-raw'" in capsys.readouterr().err
    assert cli.main(["method", "check", "red_centroid", "--seconds", "0"]) == 2
    assert "limit seconds = 0.0" in capsys.readouterr().err


def test_methods_lists_all_and_what_is_not_installed(monkeypatch, capsys) -> None:
    monkeypatch.setattr("phibench.estimator.methods.registry.find_spec", lambda name: None)
    assert cli.main(["method", "list"]) == 0
    out = capsys.readouterr().out
    for name in ("brightest_pixel", "raw_maximum_likelihood", "photutils: not installed", "off frames", "my_phi.py"):
        assert name in out


# -- the easy pairs ----------------------------------------------------------------------------------------------------


def test_easy_pairs_say_what_they_cannot_be() -> None:
    with pytest.raises(MethodError, match="did you mean 'srgb8'"):
        EasyPairs("srgb")
