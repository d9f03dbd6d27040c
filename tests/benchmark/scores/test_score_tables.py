"""Tables of scores: their width, their units, and what machines read of them."""

from __future__ import annotations

import csv
import io
import json

import pytest
from helpers.bench_cases import cases, constant, outcomes, sampler, shifted, silent

from phibench.benchmark.reports import figures
from phibench.benchmark.reports.report_page import report_html, report_verdict
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import compare_records, print_comparison
from phibench.benchmark.scores.failure_causes import KINDS
from phibench.benchmark.scores.intervals import Estimate
from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score import score_outcomes, with_isolation
from phibench.benchmark.scores.score_document import MethodCard
from phibench.benchmark.scores.score_tables import (
    HEADS,
    cause_table,
    cell_parts,
    failure_line,
    leaderboard,
    nothing_answered,
    number,
    print_scores,
    refusal_text,
    score_table,
)
from phibench.estimator.interface import Answer, Outcome, Spot

RULES = Rules(resamples=199)
NAMES = ("gaussian_least_squares", "raw_maximum_likelihood", "a_method_of_my_own.py:extract")


@pytest.fixture(scope="module")
def scored():
    oracles = (sampler(), shifted(0.5), lambda t: constant(t) if t.number % 2 else silent(t))
    pairs = cases(20)
    return [
        score_outcomes(MethodCard.of(name), pairs, outcomes(pairs, oracle), RULES)
        for name, oracle in zip(NAMES, oracles, strict=True)
    ]


def widths(text):
    return [len(line) for line in text.splitlines()]


@pytest.mark.parametrize("count", [1, 3])
def test_tables_fit_eighty_columns_and_wide_ones_have_all(scored, capsys, monkeypatch, count):
    monkeypatch.setenv("COLUMNS", "80")
    print_scores(scored[:count], "terminal", "phi", wide=False)
    narrow = capsys.readouterr().out
    assert max(widths(narrow)) <= 80
    assert all(name in narrow for name in NAMES[:count])
    assert "ranked by phi" in narrow
    print_scores(scored[:count], "terminal", "depth", wide=True)
    wide = capsys.readouterr().out
    assert 80 < max(widths(wide)) <= 210
    assert "ranked by D" in wide
    assert "pull" in wide


@pytest.mark.slow
@pytest.mark.parametrize("sentence", ["not isolated: this kernel has no Landlock", "isolated: read ...", ""])
def test_a_score_without_isolation_says_so(scored, capsys, sentence):
    one = with_isolation(scored[0], sentence)
    print_scores([one], "terminal", "phi", wide=True)
    assert ("isolated" in capsys.readouterr().out) == sentence.startswith("not")
    print_scores([one], "json", "phi", wide=False)
    assert json.loads(capsys.readouterr().out)["isolation"] == sentence
    page = report_html([(one.document, one.records)])
    assert f"<p>{one.document.method.name}: {sentence}.</p>" in page or not sentence.startswith("not")
    assert page.count("<p>" + one.document.method.name) == sentence.startswith("not")


def failed(messages):
    """A score of a method that failed on every pair, with these messages in turn."""
    pairs = cases(20)
    said = [Outcome(t.number, None, float("nan"), "error", messages[t.number % len(messages)]) for t in pairs.truths]
    return score_outcomes(MethodCard.of("broken"), pairs, said, RULES)


def test_a_method_that_fails_on_every_pair_is_told_in_a_sentence(scored, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    one = failed(["KeyError: 'red'"])
    print_scores([one], "terminal", "phi", wide=False)
    shown = capsys.readouterr().out
    first = "first pair: sample s0000, draw 0, mjpeg"
    assert shown.count(f"broken: failed on all 20 pairs, each time with error: KeyError: 'red'; {first}\n") == 1
    assert shown.count("KeyError") == 1
    assert "no spot detected" not in shown
    rows = [line.split() for line in shown.splitlines()]
    assert [row for row in rows if "-" in row] == []
    # title, head, rule, both ranks, found, false, two with missed counted, and the sentence
    assert 8 <= len([row for row in rows if row]) <= 12
    print_scores([scored[0], one], "terminal", "phi", wide=False)
    shown = capsys.readouterr().out
    assert shown.count("KeyError") == 1
    assert "most frequent causes" in shown


@pytest.mark.slow
@pytest.mark.parametrize(
    ("messages", "words"),
    [
        (["a"], "all 20 pairs, each time with error: a"),
        (["a", "b", "b"], "all 20 pairs, 13 times with error: b"),
        ([str(i) for i in range(20)], "all 20 pairs, for example with error: 0"),
        ([""], "all 20 pairs, each time with error"),
    ],
)
def test_the_most_frequent_failure_is_named(scored, messages, words):
    line = failure_line(failed(messages).records)
    assert line.startswith(f"failed on {words}; first pair: sample s00")
    assert line.endswith(", draw 0, mjpeg")
    assert failure_line(scored[2].records) == ""
    assert nothing_answered([scored[2], failed(messages)])
    assert not nothing_answered(scored)


def test_kinds_of_causes_are_named_by_what_they_are(scored):
    """Half of the answers of the last are false, the others have no position: "missed" would be both."""
    for documents in ([scored[2].document], [one.document for one in scored]):
        grid = cause_table(documents)
        assert [head for head in grid.heads if head in ("missed", *KINDS.values())] == list(KINDS.values())
        place, row = grid.heads.index("no answer"), grid.rows[-1]
        assert row[place : place + 3] == ("20", "20", "0")


def test_a_comparison_fits_eighty_columns(scored, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    differences = compare_records(scored[0].records, scored[1].records, RULES, "tests")
    print_comparison(differences, "one (a.json)", "other (b.json)", "terminal", wide=False)
    assert max(widths(capsys.readouterr().out)) <= 80
    print_comparison(differences, "one", "other", "json", wide=False)
    read = json.loads(capsys.readouterr().out)
    assert (
        read["rank_phi_rad"]["difference"] == next(d for d in differences if d.name == "rank_phi_rad").difference.value
    )
    print_comparison(differences, "one", "other", "csv", wide=False)
    assert len(list(csv.DictReader(io.StringIO(capsys.readouterr().out)))) == len(differences)


def test_csv_and_json_hold_the_doubles_of_the_score(scored, capsys):
    print_scores(scored, "csv", "phi", wide=False)
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    print_scores(scored, "json", "phi", wide=False)
    documents = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["method"] for row in rows] == [document["method"]["name"] for document in documents]
    known = {one.document.method.name: one.document.metrics for one in scored}
    checked = 0
    for row, document in zip(rows, documents, strict=True):
        for name in METRICS:
            expected = known[row["method"]][name]
            assert document["metrics"][name]["value"] == expected.value  # jq .metrics.rms_px.value
            for end in ("value", "low", "high"):
                text, x = row[name if end == "value" else f"{name}_{end}"], getattr(expected, end)
                assert text == "" if x is None else float(text) == x
                checked += 1
    assert checked == 3 * 3 * len(METRICS)


def test_markdown_and_latex_have_the_table(scored, capsys):
    print_scores(scored, "markdown", "phi", wide=False)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert len(lines) == 5
    assert {line.count("|") for line in lines} == {lines[0].count("|")}
    assert "| rank phi mrad |" in lines[0]
    print_scores(scored, "latex", "phi", wide=False)
    text = capsys.readouterr().out
    assert r"gaussian\_least\_squares" in text
    assert r"rank D \%" in text
    assert text.count(r"\\") == 4


def test_one_unit_per_quantity():
    units = {name: METRICS[name].shown[1] for name in METRICS}
    assert {unit for name, unit in units.items() if "phi_rad" in name} == {"mrad"}
    assert {unit for name, unit in units.items() if name.endswith("_rate") or "relative" in name} == {"%"}
    assert {unit for name, unit in units.items() if name.endswith("_px") and not name.startswith("eff")} == {"px"}
    assert set(HEADS) <= set(METRICS)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00001, "1.00e-05"), (0.0123456, "0.0123"), (123.456, "123"), (1234.56, "1235"), (0.0, "0"), (-0.5, "-0.5")],
)
def test_three_digits(value, text):
    assert number(value, 3, significant=True) == text


def test_an_interval_from_nothing_begins_at_nothing():
    """Quantiles of the share of 1 of 2 samples come as 8e-52; a small number that is one stays."""
    shown = [cell_parts(Estimate(0.5, low, 1.0), 100.0, 3, significant=True)[1] for low in (8e-52, 1e-5)]
    assert shown == ["[0, 100]", "[0.001, 100]"]


@pytest.mark.slow
def test_a_method_that_takes_none_of_the_pairs_is_not_ranked_and_not_blamed(scored, capsys, monkeypatch):
    """It answers every pair with its refusal: neither last in the table nor a failure in the report's headline."""
    why = "takes srgb8, yuyv, mjpeg, not bayer-raw"

    def refuses(_):
        return Answer(Spot.missing(why), Spot.missing(why))

    pairs = cases(20)
    other = score_outcomes(MethodCard.of("chain_fit", kind="built-in"), pairs, outcomes(pairs, refuses), RULES)
    assert refusal_text(other.records) == why
    assert [refusal_text(one.records) for one in scored] == ["", "", ""]
    assert nothing_answered([other])
    assert not nothing_answered([*scored, other])  # it is told, and the others are scored
    print_scores([*scored, other], "terminal", "phi", wide=False)
    out = " ".join(capsys.readouterr().out.split())
    assert f"chain_fit: not compared: it {why}" in out
    assert out.count("chain_fit") == 1
    monkeypatch.setattr(figures, "encoded_figure", lambda *_: b"")  # words are the subject
    html = report_html([(one.document, one.records) for one in (*scored, other)])
    assert f"chain_fit is not compared: it {why}." in html
    assert html.count("chain_fit") == 1
    blamed = next(line for line in html.splitlines() if "Less than half of the spots" in line)
    assert "chain_fit" not in blamed.partition("is not compared")[0].rpartition("Less than half")[2].partition(".")[0]


@pytest.mark.parametrize(
    ("pair_set", "heads", "text"),
    [
        ({"hinted": 0, "boxes_px": None, "track": "find"}, ["find\nJ", "recall\nD"], "Jaccard index"),
        ({"track": "localise", "boxes_px": 64}, ["error\n/ bound"], "error / bound"),
        ({"hinted": 3}, [], "rms error of phi"),
    ],
)
def test_what_ranks_the_tracks_of_a_score_comes_first(scored, pair_set, heads, text):
    documents = [one.document.model_copy(update={"pair_set": pair_set}) for one in scored]
    assert list(leaderboard(documents).heads[1 : 1 + len(heads)]) == heads
    assert leaderboard(documents).heads[1 + len(heads)] == "rank phi\nmrad"
    assert score_table(documents[0]).rows[0][0].startswith(text)


def test_the_cause_of_the_method_itself_has_words(scored):
    (one,) = scored[:1]
    wrong = {cause: dict.fromkeys(KINDS, 0) for cause in one.document.causes}
    wrong["method"]["missed"] = 3
    document = one.document.model_copy(update={"causes": wrong})
    assert "most of the others are missed by its own fault: the light was there" in report_verdict(
        {"one": document}, "phi"
    )
    assert cause_table([document, document]).rows[0][-1] == "the method's own 3"
