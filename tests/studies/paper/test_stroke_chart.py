"""What another stroke loses, on a curve whose error is known in closed form; and the command `phibench stroke`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.limits.best_stroke import LARGEST, BestStroke
from phibench.estimator.limits.stroke_curve import CEILING, FREE, NO_BOUND, TOO_FAINT, StrokeCurve, stroke_grid
from phibench.studies.paper.stroke_chart import (
    USUAL_M,
    best_lines,
    loss_table,
    losses,
    require_measured,
    write_stroke_picture,
)

STROKES = stroke_grid(0.1, 1.4)


def sigma_m(stroke_m: np.ndarray | float) -> np.ndarray:
    """Error that is smallest at 0.8 m and 1 % of D = 2 m there: a sum of a falling and a rising power."""
    x = np.asarray(stroke_m) / 0.8
    return 0.01 * (1.0 / x + x)


def found(causes: tuple[str, ...] = (FREE,) * len(STROKES), depth_m: float = 2.0) -> BestStroke:
    none = np.zeros(len(STROKES))
    curve = StrokeCurve(STROKES, none, sigma_m(STROKES), none, none, causes)
    return BestStroke(depth_m, 0.8, 0.02, 0.0, 0.02, 0.0, 0.0, (), curve)


def test_losses_are_those_of_the_curve_between_its_strokes() -> None:
    asked = (0.1, 0.137, 0.425, 0.8, 1.0, 1.4)
    rows = losses(found(), asked)
    # straight lines between points 3.4 % apart, curvature at most 1 in the logarithms: 0.034^2 / 8 = 1.4e-4
    assert [row.sigma_m for row in rows] == pytest.approx(sigma_m(np.array(asked)), rel=2e-4)
    assert [row.times for row in rows] == pytest.approx([row.sigma_m / 0.02 for row in rows])
    assert [row.cause for row in rows] == [FREE] * len(asked)


def test_a_stroke_that_cannot_be_taken_has_its_cause_and_no_error() -> None:
    barred = tuple(CEILING if h > 0.9 else FREE for h in STROKES)
    below, above = losses(found(barred), (0.8, 1.2))
    assert (below.cause, above.cause) == (FREE, CEILING)
    assert below.times == pytest.approx(1.0, abs=2e-4)
    assert math.isnan(above.sigma_m)
    (row,) = loss_table(found(barred), (1.2,)).rows
    assert row == ("1.200", "-", "-", "-", CEILING)


def test_the_table_has_the_usual_strokes_of_the_carriage_and_says_which_are_as_good() -> None:
    rows = {float(row[0]): row for row in loss_table(found()).rows}
    assert tuple(rows) == USUAL_M
    # (1/x + x) / 2 <= 1.05 from x = 0.730 to 1.370: 0.584 to 1.096 m
    good = [h for h, row in rows.items() if "within 5 %" in row[-1]]
    assert good == [0.6, 0.8, 1.0]
    assert rows[0.425][1:4] == ("24.1", "1.2", "1.21")  # x = 0.53125: 0.01 (1.8824 + 0.5313)
    assert rows[1.4][1:4] == ("23.2", "1.2", "1.16")


def test_sentences_have_the_parts_and_the_limit() -> None:
    lines = best_lines(replace(found(), limits=(LARGEST,)))
    assert lines[0] == "D = 2 m: the best stroke is 0.80 m, sigma of D 20 mm (1 %)"
    assert "the rig 20 mm" in lines[1]
    assert lines[2] == "strokes from 0.59 to 1.08 m lose at most 5 %"  # of the grid, 3.4 % apart
    assert lines[3].endswith("but for: longest stroke")


@pytest.mark.parametrize(
    ("best", "words"),
    [
        (
            replace(found(), stroke_m=math.nan, limits=(TOO_FAINT,)),
            ("D = 2 m", "0.1 to 1.4 m", TOO_FAINT, "--power-mw"),
        ),
        (replace(found(), stroke_m=math.nan, limits=(CEILING,)), (CEILING, "--strokes-m")),
        (replace(found(), stroke_m=math.nan, limits=("occluded by robot_body",)), ("robot_body", "--height-m")),
        (replace(found(), sigma_m=0.7), ("no stroke", "0.7 m", "third of D")),
    ],
)
def test_a_distance_that_no_stroke_measures_is_one_sentence(best: BestStroke, words: tuple[str, ...]) -> None:
    for ask in (require_measured, loss_table):
        with pytest.raises(DatasetError) as caught:
            ask(best)
        assert all(word in str(caught.value) for word in words)
        assert "\n" not in str(caught.value)
    require_measured(replace(found(), sigma_m=0.6))  # below a third


def test_what_to_give_instead_is_said_once() -> None:
    with pytest.raises(DatasetError, match=r"; give another --height-m or --depth-m, or a --calibration$"):
        require_measured(replace(found(), stroke_m=math.nan, limits=(NO_BOUND, "occluded by camera_housing")))


@pytest.mark.slow
def test_the_picture_is_the_same_for_the_same_curve(tmp_path: Path) -> None:
    barred = tuple(CEILING if h > 0.9 else FREE for h in STROKES)
    for name in ("a.png", "b.png", "a.svg", "b.svg"):
        write_stroke_picture(tmp_path / name, found(barred))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (770, 462)


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_asks_for_what_was_given(tmp_path: Path, monkeypatch, capsys) -> None:
    asked = {}

    def best(depth_m, rig, **options):
        asked.update(options, depth_m=depth_m, rig=rig)
        return found()

    monkeypatch.setattr("phibench.estimator.limits.best_stroke.best_stroke", best)
    rig, out = tmp_path / "rig.toml", tmp_path / "stroke.svg"
    rig.write_text("[rig]\nradius_m = 0.05\n")
    command = ["stroke", "--depth-m", "2", "--rig", str(rig), "--preset", "bayer-raw", "--strokes-m", "0.1", "1.4",
               "--height-m", "0.7", "--power-mw", "0.5", "--stroke-m", "0.3", "0.5", "--out", str(out)]  # fmt: skip
    assert cli.main(command) == 0
    assert (asked["depth_m"], asked["rig"].mirror.radius_m, asked["card"].output) == (2.0, 0.05, "raw")
    assert (asked["around"].heights_m, asked["around"].laser.power_w) == ((0.7,), 0.5e-3)
    assert (asked["strokes_m"], asked["covariance_rig"]) == ((0.1, 1.4), None)
    said = capsys.readouterr().out
    assert "the best stroke is 0.80 m" in said
    assert " 0.300 " in said
    assert " 0.425 " not in said
    assert "bayer-raw, 0.5 mW, spots 0.7 m high" in said
    assert out.is_file()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--depth-m", "-1"), ("depth_m = -1", "0.05 to 100")),
        (("--depth-m", "2,18"), ("2.18",)),
        (("--depth-m", "2", "--strokes-m", "1", "0.5"), ("strokes_m = (1, 0.5)", "rising")),
        (("--depth-m", "2", "--power-mw", "0"), ("--power-mw 0", "1e-06 to 1000")),
        (("--depth-m", "2", "--preset", "mjpg"), ("mjpg",)),
        (("--depth-m", "2", "--rig", "nowhere.toml"), ("nowhere.toml",)),
        (("--depth-m", "2", "--out", "stroke.pdf"), ("stroke.pdf", ".png or .svg")),
    ],
)
def test_bad_input_is_one_sentence(options: tuple[str, ...], words: tuple[str, ...], capsys) -> None:
    assert cli.main(["stroke", *options]) == 2
    out, err = capsys.readouterr()
    assert all(word in err for word in words)
    assert "Traceback" not in err
    assert out == ""


def test_a_stroke_beyond_the_carriage_is_one_sentence(monkeypatch, capsys) -> None:
    monkeypatch.setattr("phibench.estimator.limits.best_stroke.best_stroke", lambda *_, **__: found())
    assert cli.main(["stroke", "--depth-m", "2", "--stroke-m", "2"]) == 2
    err = capsys.readouterr().err
    assert "a stroke of 2 m" in err
    assert "--strokes-m" in err
