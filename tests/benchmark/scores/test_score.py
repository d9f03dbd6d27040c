"""A score from outcomes to files, the commands, and what they refuse."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from helpers.bench_cases import Cases, cases, change, constant, outcomes, sampler, shifted, silent, truth_itself
from PIL import Image

import phibench
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score import saved_scores, score_methods, score_outcomes
from phibench.benchmark.scores.score_document import MethodCard, ScoreDocument, results_sha256
from phibench.benchmark.scores.score_files import read_records, read_score, write_score
from phibench.benchmark.scores.score_tables import leaderboard, number, ranked_scores
from phibench.benchmark.scores.strata import STRATA
from phibench.benchmark.scores.worst_images import crop, worst_images
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_file import SensorFile, write_sensor_file
from phibench.estimator.interface import Outcome

RULES = Rules(resamples=199)


def scored(oracle=None, pairs=None, name="mine", **options):
    pairs = pairs or cases(40)
    return score_outcomes(MethodCard.of(name), pairs, outcomes(pairs, oracle or sampler()), RULES, **options)


@pytest.fixture(scope="module")
def mine():
    return scored(limits={"seconds": 30.0})


def test_a_score_that_cannot_be_written_costs_no_other_method_its_own(mine, tmp_path):
    files = [tmp_path / f"{name}.json" for name in "abc"]
    (tmp_path / "b.parquet").mkdir()
    with pytest.raises(DatasetError, match=r"b\.json could not be written: .*; 2 of 3 scores are written$") as caught:
        saved_scores([mine] * 3, files)
    assert "\n" not in str(caught.value)
    assert [file.exists() for file in files] == [True, False, True]
    assert read_score(files[2]).records == "c.parquet"


def test_a_score_says_where_it_comes_from(mine):
    d = mine.document
    assert (d.pairs, d.images, d.samples, d.seed) == (40, 80, 40, 0)
    assert d.pair_set == cases(40).document()
    counted = {"match_px": 3, "missed_relative": 1, "least_missed_relative": 0.1, "missed_phi_rad": 0.02}
    assert d.rules == {**counted, "confidence": 0.95, "resamples": 199, "least_samples": 5, "least_compared": 30}
    assert d.limits == {"seconds": 30.0}
    assert "numpy" in d.provenance["packages"]
    assert len(d.code_sha256) == 64
    assert set(d.metrics) == set(METRICS)
    assert (d.metrics["rms_px"].unit, d.metrics["rms_px"].better) == ("px", "lower")
    assert "all" not in {stratum.by for stratum in d.strata}


def test_results_have_a_hash_that_times_do_not_change(mine):
    """The same as by the standard library, from the records as Python has them."""
    changed = mine.records.with_columns(seconds=pl.col("seconds") + 1.0, message=pl.lit("late"))
    rows = mine.records.drop("seconds", "message").to_dict(as_series=False)
    text = json.dumps([[name, values] for name, values in rows.items()], separators=(",", ":"))
    assert mine.document.results_sha256 == hashlib.sha256(text.encode()).hexdigest() == results_sha256(changed)
    other = mine.records.with_columns(u_px=pl.col("u_px") * (1.0 + 2e-16))
    assert results_sha256(other) != mine.document.results_sha256
    assert mine.document.program.startswith(f"phibench {phibench.__version__}")


def test_a_score_and_its_records_are_read_back(mine, tmp_path):
    path = tmp_path / "deep" / "mine.json"
    written = write_score(path, mine.document, mine.records)
    assert read_score(path) == written
    assert written.records == "mine.parquet"
    assert read_records(path, written).equals(mine.records)
    assert "NaN" not in path.read_text()
    assert sorted(file.name for file in path.parent.iterdir()) == ["mine.json", "mine.parquet"]


@pytest.mark.slow
def test_the_same_run_gives_the_same_bytes(mine):
    again = scored(limits={"seconds": 30.0})
    assert again.document.model_dump_json() == mine.document.model_dump_json()
    other = scored(limits={"seconds": 30.0}, seed=1)
    assert other.document.metrics["rms_px"].value == mine.document.metrics["rms_px"].value
    assert other.document.metrics["rms_px"].low != mine.document.metrics["rms_px"].low


def test_strata_part_the_whole(mine):
    """Images of the strata of one kind add up to all; the whole's rms is that of its parts."""
    by = {}
    for stratum in (mine.document.whole, *mine.document.strata):
        by.setdefault(stratum.by, []).append(stratum)
    # one preset, no hints, all visible, and one class of signal to noise: these strata are the whole again
    assert set(by) == set(STRATA) - {"preset", "hint", "sigmas", "shift", "spot", "saturation"}
    whole = by["all"][0].metrics["rms_px"].value
    for name in ("depth", "stroke", "signal", "azimuth", "image", "bayer", "quality"):
        assert sum(stratum.images for stratum in by[name]) == 80, name
        square = sum(s.metrics["rms_px"].value ** 2 * s.metrics["rms_px"].n for s in by[name]) / 80
        assert math.sqrt(square) == pytest.approx(whole, rel=1e-12)
        if name not in ("image", "bayer"):
            assert sum(s.metrics["rms_depth_m"].n for s in by[name]) == 40, name
            assert sum(stratum.pairs for stratum in by[name] if stratum.pairs) >= 40
    assert "rms_depth_m" not in by["bayer"][0].metrics


def test_hidden_and_faint_spots_have_strata_of_their_own():
    """40 pairs: one up image hides its spot, another has it at 8 sigma. Whoever answers all is false once."""
    pairs = cases(40)
    some = (
        *(change(pairs.truths[0], "up", visible=False, cause="occluded:table", snr=0.0),),
        *(change(pairs.truths[1], "up", snr=8.0), *pairs.truths[2:]),
    )
    d = scored(truth_itself, Cases(some)).document
    found = {s.label: s for s in d.strata if s.by == "spot"}
    assert {name: s.images for name, s in found.items()} == {
        "from 10 sigma": 78,
        "not visible": 1,
        "visible, fainter": 1,
    }
    assert [found[name].metrics["false_rate"].value for name in sorted(found)] == [0.0, 1.0, 0.0]
    assert found["from 10 sigma"].metrics["detection_rate"].value == 1.0
    # 40 samples, none false: the limit of Clopper and Pearson is 1 - 0.025^(1/40)
    assert found["from 10 sigma"].metrics["false_rate"].high == pytest.approx(1.0 - 0.025 ** (1 / 40), rel=0.05)


def test_a_stratum_holds_its_own_errors():
    """Half a pixel off at quality 60 alone."""
    half = shifted(0.5)
    d = scored(lambda t: half(t) if t.jpeg_quality == 60 else truth_itself(t)).document
    rms = {s.label: s.metrics["rms_px"].value for s in d.strata if s.by == "quality"}
    assert rms == {"60": pytest.approx(0.5), "75": 0.0, "85": 0.0}


@pytest.mark.slow
def test_ranks_go_by_phi_with_missed_spots_and_by_depth_where_asked():
    """The one that answers only easy pairs has the smaller rms, and the lower rank."""
    good, half, pairs = sampler(spread=0.5), shifted(0.2), cases(80)
    easy = scored(lambda t: good(t) if t.number % 2 else silent(t), pairs, name="easy").document
    every = scored(half, pairs, name="every").document
    assert easy.metrics["rms_px"].value < every.metrics["rms_px"].value
    assert [d.method.name for d in ranked_scores([easy, every])] == ["every", "easy"]
    deep = scored(lambda t: replace(half(t), depth_m=t.depth_m), pairs, name="deep").document  # phi as `every`, D exact
    assert [d.method.name for d in ranked_scores([easy, every, deep], "depth")] == ["deep", "every", "easy"]
    # Both are marked: `every` is off by the same in every image. The squares of `easy` are (0.5 * 1.15)^2 of what is
    # possible: 40 +- 5 of 120 in 40 pairs. 25 tests in all leave a mark below 67, where chi^2 is with 1e-3 / 32.
    assert [row[0] for row in leaderboard([easy, every]).rows] == ["every !", "easy !"]
    assert "ranked by phi" in leaderboard([easy, every]).title
    assert "ranked by D" in leaderboard([easy, every], "depth").title


@pytest.mark.slow
def test_worst_images_of_parts_are_those_of_all_at_once():
    """Pictures are made of what is among the worst so far: the end is the same in whatever order errors come."""
    pairs = cases(70)  # five parts
    for make in (sampler(seed=3), shifted(0.2)):
        found = score_outcomes(MethodCard.of("m"), pairs, outcomes(pairs, make), RULES)
        assert found.document.worst == worst_images(found.records, pairs)
        assert len(found.document.worst) == 10


def test_worst_images_first_one_of_a_sample():
    truths = list(cases(15).truths)
    truths[14] = change(truths[14], "down", visible=False, cause="occluded:table")
    truths[14] = change(truths[14], "up", visible=False, cause="occluded:table")

    def answer(t):
        if t.number == 3:
            return constant(t)
        return silent(t) if t.number == 5 else shifted(0.01 * t.number)(t)

    worst = scored(answer, Cases(tuple(truths))).document.worst
    assert [w.sample_id for w in worst[:3]] == ["s0003", "s0005", "s0013"]
    assert len(worst) == len({w.sample_id for w in worst}) == 10
    assert "s0014" not in {w.sample_id for w in worst}  # nothing to see
    assert (worst[1].distance_px, worst[1].answer_px, worst[1].cause) == (None, None, "method")
    shown = worst[2]
    assert shown.answer_px[0] - shown.true_px[0] == pytest.approx(0.13, abs=1e-9)
    assert all(max(w.crop.size) <= 64 and w.crop.holds(w.true_px) for w in worst)
    assert [w.frame is not None for w in worst] == [True] * 3 + [False] * 7
    assert shown.frame.size == (640, 360)


def test_a_position_is_marked_where_the_spot_is_in_crop_and_frame():
    """The brightest pixel holds the true position; in the frame at half size, whose cells share a spot, a neighbour."""
    worst = scored(silent, cases(12)).document.worst[:3]
    for one in worst:
        for picture, off in ((one.crop, 0), (one.frame, 1)):
            image = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.base64))).convert("L"), int)
            y, x = np.unravel_index(int(image.argmax()), image.shape)
            place = np.floor(picture.place(one.true_px))
            assert np.abs(place - [x, y]).max() <= off
            assert image[y, x] > np.median(image) + 10


def test_crops_hold_the_spot_and_end_with_the_image():
    image = np.zeros((100, 200), np.uint16)
    image[60, 50] = 700
    part, (u0, v0) = crop(image, np.array([50.2, 59.8]))
    assert part[60 - v0, 50 - u0] == 255
    assert part.shape == (48, 48)
    corner, origin = crop(image, np.array([1.0, 99.0]))
    assert origin == (0, 75)
    assert corner.shape == (25, 25)
    flat, _ = crop(np.full((100, 200, 3), 7, np.uint8), np.array([50.0, 50.0]))
    assert (flat == 0).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not JSON"),
        ("[]", "does not hold a JSON object"),
        ('{"kind": "other"}', "is no score"),
        ('{"kind": "phibench score", "version": 99}', "has version 99"),
        ('{"kind": "phibench score", "version": 5}', "has version 5, this program reads 6: score again"),
        ('{"kind": "phibench score", "version": 6}', "method"),
    ],
)
def test_a_file_that_is_no_score(tmp_path, text, words):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(DatasetError, match=words) as error:
        read_score(tmp_path / "x.json")
    assert "\n" not in str(error.value)


def test_records_that_do_not_belong(mine, tmp_path):
    path = tmp_path / "a.json"
    written = write_score(path, mine.document, mine.records)
    (tmp_path / "a.parquet").write_bytes(b"something else")
    with pytest.raises(DatasetError, match=r"is not the file that a\.json was written with"):
        read_records(path, written)
    (tmp_path / "a.parquet").unlink()
    with pytest.raises(DatasetError, match="is missing"):
        read_records(path, written)
    with pytest.raises(DatasetError, match=r"ends in \.json"):
        write_score(tmp_path / "a.txt", mine.document, mine.records)


def test_a_sealed_set_is_refused():
    class Sealed(Cases):
        def truth(self, number):
            raise DatasetError("the set is sealed: submit answers instead")

    with pytest.raises(DatasetError, match="sealed"):
        score_outcomes(MethodCard.of("x"), Sealed(cases(3).truths), [Outcome(0, None, 1.0, "error")], RULES)


def test_small_numbers_do_not_read_as_zero():
    assert number(0.00001, 3) == "1.00e-05"
    assert number(0.0, 3) == "0.000"
    assert number(math.nan, 3) == "-"
    assert number(0.5, 3) == "0.500"
    assert number(123.456, 3, significant=True) == "123"


# -- commands ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_several_methods_are_scored_as_each_alone():
    """Pairs are drawn once for all and in parts of 16; what a method gets does not depend on that.

    Each part is asked for before the one before is answered, so that methods work while answers are examined.
    """
    pairs, oracles = cases(40), [sampler(), shifted(0.5)]
    answered_before = []

    def ask(held, numbers):
        answered_before.append(len(told))
        answers = [{o.number: o for o in outcomes(pairs, oracle)} for oracle in oracles]
        return [tuple(answer[number] for answer in answers) for number in numbers]

    told = []
    both = score_methods([MethodCard.of("a"), MethodCard.of("b")], pairs, ask, RULES, told=told.append)
    assert told == list(range(1, 41))
    assert answered_before == [0, 0, 16]
    for one, oracle, name in zip(both, oracles, "ab", strict=True):
        alone = score_outcomes(MethodCard.of(name), pairs, outcomes(pairs, oracle), RULES)
        assert one.records.equals(alone.records)
        assert one.document == alone.document


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    file = tmp_path_factory.mktemp("method") / "half.py"
    file.write_text(
        "from phibench.estimator.methods.registry import METHODS\n"
        "from phibench.estimator.interface import Answer, Spot\n"
        "def moved(s):\n"
        "    return s if s.uv_px is None else Spot((s.uv_px[0] + 0.5, s.uv_px[1]))\n"
        "def extract(pair):\n"
        "    answer = METHODS['raw_maximum_likelihood'](pair)\n"
        "    return Answer(moved(answer.down), moved(answer.up))\n"
    )
    return f"{file}:extract"


def test_score_with_methods_compare_and_report(bench_dataset, half, tmp_path, capsys):
    out = tmp_path / "run.json"
    words = ["score", str(bench_dataset), "--method", "raw_maximum_likelihood", "--method", half]
    assert cli.main([*words, "--preset", "bayer-raw", "--draws", "2", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "raw_maximum_likelihood" in shown
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "run-half-extract.json",
        "run-half-extract.parquet",
        "run-raw_maximum_likelihood.json",
        "run-raw_maximum_likelihood.parquet",
    ]
    one, other = tmp_path / "run-raw_maximum_likelihood.json", tmp_path / "run-half-extract.json"
    assert len(read_score(other).method.sha256) == 64
    records = [read_records(path, read_score(path)) for path in (one, other)]
    key = ["number", "image"]
    both = records[0].join(records[1], on=key, suffix="_half").filter(pl.col("u_px").is_not_null())
    assert len(both) > 0
    # the same pairs, drawn once and shown to both: half a pixel between the answers, to rounding
    assert (both["u_px_half"] - both["u_px"]).to_list() == pytest.approx([0.5] * len(both), abs=1e-9)
    assert cli.main(["compare", str(one), str(other)]) == 0
    shown = capsys.readouterr().out
    assert "raw_maximum_likelihood (run-raw_maximum_likelihood.json)" in " ".join(shown.split())
    assert cli.main(["report", str(one), str(other), "--out", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.slow
def test_several_frames_of_a_position_are_scored_against_their_own_bound(bench_dataset, tmp_path):
    """Bounds fall with the frames, and a score of other frames or another sensor is no score of the same pairs."""
    sensor = SensorFile("bayer-raw", {"read_noise_e": 3.0})
    write_sensor_file(tmp_path / "sensor.toml", sensor)
    files = {"one": [], "six": ["--frames", "6", "6"], "sensor": ["--sensor", str(tmp_path / "sensor.toml")]}
    bounds = {}
    for name, words in files.items():
        out = tmp_path / f"{name}.json"
        chosen = [*words, "--method", "raw_maximum_likelihood", "--preset", "bayer-raw", "--pairs", "2"]
        assert cli.main(["score", str(bench_dataset), *chosen, "--out", str(out)]) == 0
        bounds[name] = read_records(out, read_score(out))["bound_px2"].drop_nulls().to_numpy() ** 0.5
    # sqrt(6) less for pure noise; the single frame's bound knows the room, that of six frames on and off does not,
    # which costs a factor of 1 to sqrt(2); the fixed pattern is a few percent of both
    ratio = bounds["one"] / bounds["six"]
    assert (ratio > 6**0.5 / 2**0.5 * 0.9).all()
    assert (ratio < 6**0.5 * 1.05).all()
    assert read_score(tmp_path / "six.json").pair_set["frames"] == [[6, 6]]
    for other in ("six", "sensor"):
        assert cli.main(["compare", str(tmp_path / "one.json"), str(tmp_path / f"{other}.json")]) == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--preset", "mjpeg"], "give --method"),
        (["--method", "red_centroid", "--bootstrap-seed", "-1"], "--bootstrap-seed -1: must be 0 or above"),
        (["--method", "red_centroid", "--seconds", "0"], "limit seconds = 0.0"),
        (["--method", "red_centroid", "--out", "a.txt"], "ends in .json"),
        (["--method", "red_centroid", "--method", "red_centroid", "--out", "a.json"], "two methods"),
        (["--method", "red_centriod"], "no method 'red_centriod': did you mean 'red_centroid'?"),
        (["--method", "red_centroid", "--pairs", "0"], "pairs = 0: must be 1 or above"),
        (["--method", "red_centroid", "--frames", "6", "0"], "--frames 6 0: give the frames of a position"),
    ],
)
def test_mistakes_are_one_sentence(bench_dataset, capsys, words, sentence):
    assert cli.main(["score", str(bench_dataset), *words]) == 2
    err = capsys.readouterr().err
    assert sentence in err
    assert err.count("\n") == 1


def test_compare_of_what_is_not_there(tmp_path, capsys):
    assert cli.main(["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_method_is_named_by_the_end_of_its_reference():
    assert MethodCard(reference="/home/me/my_phi.py:extract").name == "my_phi.py:extract"
    assert MethodCard.of("a/b.py:f", name="b:f", sha256="1").name == "b:f"


def test_a_report_of_no_files_is_refused(tmp_path, capsys):
    assert cli.main(["report", "--out", str(tmp_path / "page.html")]) == 2
    assert "a report of nothing" in capsys.readouterr().err


def test_the_document_is_strict(mine):
    raw = json.loads(mine.document.model_dump_json())
    with pytest.raises(ValueError, match="surprise"):
        ScoreDocument.model_validate_json(json.dumps({**raw, "surprise": 1}))
    assert isinstance(mine.records, pl.DataFrame)
