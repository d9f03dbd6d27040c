"""The report as a page: complete, self-contained, readable by a machine that reads aloud."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.bench_cases import Cases, cases, change, constant, outcomes, sampler, shifted, silent, truth_itself
from PIL import Image

from phibench.benchmark.reports import figures
from phibench.benchmark.reports.figures import (
    EmbeddedFigure,
    cause_bars,
    error_panels,
    has_open_marks,
    plain_number,
    pull_histogram,
)
from phibench.benchmark.reports.report_page import report_html, report_verdict, write_report
from phibench.benchmark.reports.report_sections import Section, time_section
from phibench.benchmark.reports.results_page import read_parts, told_programs
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.failure_causes import CAUSES
from phibench.benchmark.scores.score import score_outcomes
from phibench.benchmark.scores.score_document import Declared, Flag, MethodCard
from phibench.benchmark.scores.score_files import read_score, write_score
from phibench.benchmark.scores.score_tables import division_and_rig, scores_csv
from phibench.cli import main as cli
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.interface import Answer, Spot

RULES = Rules(resamples=199)


class Page(HTMLParser):
    """Tags with their attributes, headings, and whether tags are closed in their order."""

    VOID = ("meta", "img", "br", "image", "circle", "path", "link", "hr", "input", "use")

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def of(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def mixed(t):
    if t.number % 7 == 0:
        return silent(t)
    return constant(t) if t.number % 11 == 0 else sampler(seed=5)(t)


def scored(name, oracle, pairs=None):
    pairs = pairs or cases(40)
    result = score_outcomes(MethodCard.of(name), pairs, outcomes(pairs, oracle), RULES)
    return result.document, result.records


@pytest.fixture(scope="module")
def scores():
    flag = Flag(quantity="D", part="all pairs", ratio=924.0, pairs=40, chance=0.0)
    half, records = scored("half", shifted(0.5))
    flagged = half.model_copy(update={"flags": [flag]})
    return [scored("ideal", sampler()), scored("mixed <b>&", mixed), (flagged, records)]


@pytest.fixture(scope="module")
def html(scores):
    return report_html(scores)


def test_the_page_fetches_nothing_and_runs_nothing(html):
    page = Page(html)
    assert page.of("script") == []
    assert page.of("link") == []
    for attribute in ("src", "href"):
        places = [attributes[attribute] for _, attributes in page.tags if attribute in attributes]
        assert places
        assert all(place.startswith(("data:image/", "#")) for place in places)
    assert "url(" not in html
    assert "@import" not in html


def test_a_method_that_knows_more_than_the_images_is_marked(html):
    text = " ".join(Page(html).text.split())
    assert "! half knows more than the images: D 924 times better than the images allow (all pairs, 40;" in text
    assert "half !" in text
    assert "ideal !" not in text


def test_pictures_have_words_and_tables_have_heads(html):
    page = Page(html)
    keys = [attributes for attributes in page.of("img") if attributes.get("class") == "key"]
    assert len(keys) == 6  # beside the names, which say it
    assert {attributes["alt"] for attributes in keys} == {""}
    drawn = [attributes for attributes in page.of("img") if attributes.get("class") != "key"]
    assert len(drawn) == 9 + 3 + 2 + 1 + 1  # curves, maps, radius, causes, pulls
    assert all(len(attributes["alt"]) > 60 for attributes in drawn)
    shown = [attributes for attributes in page.of("svg") if "aria-hidden" not in attributes]
    assert all(attributes.get("role") == "img" and attributes.get("aria-label") for attributes in shown)
    assert len(shown) == 60 + 9  # ten crops, each without and with marks, and three frames of each method
    assert len(page.of("caption")) == len(page.of("table")) >= 5
    assert all(attributes.get("scope") in ("row", "col") for attributes in page.of("th"))
    assert page.of("html")[0]["lang"] == "en-GB"
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {a["href"][1:] for a in page.of("a")} <= set(ids)


def test_the_page_begins_with_who_is_best_and_what_fails(html, scores):
    text = " ".join(Page(html[html.index("<main>") : html.index("</main>") + 7]).text.split())
    phi = scores[0][0].metrics["rank_phi_rad"]
    assert text.startswith("phibench report cases.")
    assert f"ideal is best by phi: {1000 * phi.value:.3g} mrad" in text[:120]
    guesses = {"ideal": scores[0][0], "guess": scored("guess", constant)[0]}
    assert "Less than half of the spots: guess." in report_verdict(guesses, "phi")
    assert "False detections in 20 % of the images or more: guess." in report_verdict(guesses, "depth")
    assert report_verdict({"guess": guesses["guess"]}, "phi") == "No method finds a spot on these pairs."
    whole = {name: one.model_copy(update={"pair_set": {"hinted": 0}}) for name, one in guesses.items()}
    found = whole["ideal"].metrics["find"]
    first = f"Track find: ideal, {found.value:.3g} [{found.low:.3g}, {found.high:.3g}]. Track depth: ideal, "
    assert report_verdict(whole, "phi").startswith(first)


def test_a_dark_page_and_a_narrow_one_have_their_rules(html):
    assert "prefers-color-scheme: dark" in html
    assert "@media (max-width: 700px)" in html
    page = Page(html)
    assert (
        len(page.of("details")) == len(page.of("summary")) == 3 + 3 + 4
    )  # worst, strata, causes + failures + metrics + JSON


def test_narrow_pages_name_every_number(html):
    """There the tables of metrics have no heads: a row becomes a card, and each number has its head beside it."""
    tables = re.findall(r'<table class="[^"]*cards[^"]*">.*?</table>', html, re.S)
    assert len(tables) == 1 + 3
    for table in tables:
        cells = Page(table).of("td")
        assert len(cells) > 10
        assert all(attributes["data-head"] for attributes in cells)
    assert len(re.findall("<caption>", html)) == len(re.findall("<caption><span>", html))


@pytest.fixture(scope="module")
def few_samples():
    """A score of three pairs, and its page."""
    few = scored("ideal", sampler(), cases(3))
    return few[0], report_html([few])


def test_too_few_samples_for_an_interval_are_a_star(html, few_samples):
    _, few = few_samples
    assert few.count('title="under 5 samples">*</span>') > 10
    assert "(under 5 samples)" not in few[few.index("<h3") :]
    assert "Every image has a right position." in few
    assert "under 5 samples" not in html[html.index('<table class="cards">') :].split("</table>")[0]


def test_causes_that_occur_are_counted(html):
    """Of 80 images of the mixed method 12 have no answer and 6 a false one; all others have a right position."""
    table = html[html.index("Images without a right position by cause") :].split("</table>")[0]
    assert re.findall(r'<th scope="col">(\w+)</th>', table) == ["method"]
    assert re.findall(r"<td[^>]*>(.*?)</td>", table) == ["0", "0", "12 / 6 / 0"]
    assert "Every image has a right position." not in html


@pytest.mark.slow
def test_causes_are_defined(html):
    assert all(text in Page(html).text for text in CAUSES.values())


@pytest.mark.parametrize(
    ("x", "text"), [(0.002, "0.002"), (0.5, "0.5"), (20.0, "20"), (50000.0, "50\u202f000"), (1e-5, "0.00001")]
)
def test_ticks_are_plain_numbers(x, text):
    assert plain_number(x) == text


def test_names_are_text_not_markup(html):
    assert "mixed <b>&amp;" not in html
    assert "mixed &lt;b&gt;&amp;" in html


def test_a_name_is_no_formula(scores):
    """Matplotlib takes text between two dollar signs for TeX, and refuses what is none."""
    name = "$\\frac{1}$"
    assert name in base64.b64decode(cause_bars({name: scores[1][0]}).source.split(",")[1]).decode()


def test_methods_are_in_the_order_of_their_ranks(html):
    text = Page(html).text
    assert text.index("ideal") < text.index("half") < text.index("mixed")


def test_the_leaderboard_has_its_numbers(html, scores):
    text = " ".join(Page(html).text.split())
    rate = scores[1][0].metrics["detection_rate"]
    assert f"[{100 * rate.low:.3g}, {100 * rate.high:.3g}]" in html
    phi = scores[2][0].metrics["rank_phi_rad"]
    assert f"{1000 * phi.value:.3g}" in text  # mrad, as everywhere on the page


CALIBRATED = {"calibration": "0" * 64, "calibrated_from": {"spots": True}}


def told(kind="", pair_set=(), **word):
    """Division and rig of a score, with the word of its author."""
    document, _ = scored("m", sampler())
    card = MethodCard.of("m", kind=kind, **Declared(**word).fields(kind))
    return division_and_rig(document.model_copy(update={"method": card, "pair_set": dict(pair_set)}))


@pytest.mark.slow
def test_division_and_rig_are_the_authors_word_and_what_the_pairs_gave():
    assert told() == ("open", "nominal")
    assert told(division="closed", self_calibrates=True) == ("closed", "self-calibrated")
    assert told("built-in", division="open", self_calibrates=True) == ("closed", "nominal")  # phibench says it
    assert told(pair_set=CALIBRATED, self_calibrates=True)[1] == "calibrated"  # measured distances are more
    assert told(pair_set={**CALIBRATED, "calibrated_from": {"spots": False}})[1] == "self-calibrated"
    assert MethodCard.model_validate_json('{"reference": "chain_fit", "kind": "built-in"}').division == "closed"
    with pytest.raises(DatasetError, match="division 'half': give closed or open"):
        Declared("half")


def test_division_and_rig_stand_beside_every_method(html, scores, tmp_path, capsys):
    assert html.count('<td class="word" data-head="division">open</td>') == len(scores)
    assert html.count('<td class="word" data-head="rig">nominal</td>') == len(scores)
    (score, table) = scores[0]
    card = MethodCard.of("own.py:f", division="closed", self_calibrates=True)
    own = score.model_copy(update={"method": card, "pair_set": {**score.pair_set, "hinted": 0}})
    write_score(tmp_path / "own.json", own, table)
    assert cli.main(["results", str(tmp_path / "own.json")]) == 0
    page = capsys.readouterr().out
    row = "| own.py:f | closed | self-calibrated |"
    assert page.count(row) == 3  # the tracks find and depth, and the ranking
    assert scores_csv([own]).splitlines()[1].startswith("own.py:f,closed,self-calibrated,")


def test_pictures_are_pictures(html):
    for attributes in Page(html).of("img"):
        head, data = attributes["src"].split(",", 1)
        raw = base64.b64decode(data)
        if "svg" in head:
            assert raw.startswith(b"<?xml")
            assert b"</svg>" in raw
        else:
            assert np.ptp(np.asarray(Image.open(io.BytesIO(raw)).convert("L"))) > 100


@pytest.mark.slow
def test_the_same_scores_give_the_same_page(html, scores):
    assert report_html(scores) == html


# -- a page of what is unusual: two sets, a name twice, nothing found, no bound, hidden spots, a section ------------


def hidden(n=12):
    """Pairs without bounds whose spot is hidden in the second image."""
    truths = [change(t, "down", bound_px2=None) for t in cases(n).truths]
    return Cases(tuple(change(t, "up", visible=False, cause="occluded:table") for t in truths), name="others")


@pytest.fixture(scope="module")
def crowded(scores):
    """Its figures are put together and not drawn: what is compared are words."""
    section = Section(
        "Tilt of the camera",
        ("Predicted and measured.",),
        (EmbeddedFigure("data:image/png;base64,AAAA", "nothing"),),
        ((("tilt", "error"), ("0.5 deg", "0.9 %")),),
    )
    first = [scores[0], scores[0], scored("constant", constant), scored("silent", silent)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "encoded_figure", lambda *_: b"")
        return report_html([*first, scored("truth", truth_itself, hidden())], [section])


def test_other_pairs_make_another_ranking(crowded):
    page = Page(crowded)
    assert page.text.count("Pairs: ") == 2
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_methods_of_one_name_are_told_apart(crowded):
    assert "ideal (1)" in crowded
    assert "ideal (2)" in crowded


def test_without_a_covariance_there_is_no_histogram(scores, crowded):
    assert pull_histogram({"half": scores[2][1]}) is None
    assert crowded.count("No method claims a covariance.") == 1
    assert "these included:\n</p>" not in crowded  # no sentence that begins a list of nothing


def test_rightly_unanswered_and_wrongly_answered_are_told_apart(crowded):
    assert "0 / 12 / 0" in Page(crowded).text  # the truth's position of a hidden spot is a false detection


def test_sections_follow(crowded):
    page = Page(crowded)
    assert "Tilt of the camera" in page.text
    assert "0.9 %" in page.text
    assert {"src": "data:image/png;base64,AAAA", "alt": "nothing"} in page.of("img")


def test_a_report_of_nothing_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="a report of nothing"):
        write_report([], tmp_path / "page.html")


@pytest.fixture(scope="module")
def score_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    for name, oracle in (("half", shifted(0.5)), ("tenth", shifted(0.1)), ("mixed", mixed)):
        write_score(folder / f"{name}.json", *scored(name, oracle))
    return sorted(folder.glob("*.json"))


def test_results_are_one_page_in_each_form(score_files, tmp_path, capsys):
    words = ["results", *map(str, score_files), "--against", "half"]
    page, html = tmp_path / "results.md", tmp_path / "results.html"
    assert cli.main([*words, "--out", str(page), "--html", str(html), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)  # the document and nothing else
    (part,) = document["parts"]
    assert (part["against"], list(part["differences"])) == ("half", ["tenth", "mixed"])
    found = part["differences"]["tenth"]["rms_px"]
    assert found["difference"] == pytest.approx(-0.4, abs=1e-9)
    text = page.read_text()
    assert "| tenth | " in text.partition("**Method minus half**")[2]
    assert max(len(line) for line in text.split("\n") if line.startswith("|")) <= 160
    assert max(len(line) for line in text.split("\n") if not line.startswith("|")) <= 120
    read = Page(html.read_text())
    assert len(read.of("table")) == 7  # sources, and six of the part
    assert all(box["tabindex"] == "0" for box in read.of("div") if box.get("class") == "wide")
    again = tmp_path / "again.md"
    assert cli.main([*words, "--out", str(again)]) == 0
    assert again.read_bytes() == page.read_bytes()


@pytest.mark.slow
def test_scores_of_fewer_pairs_are_told_of(score_files, tmp_path, capsys, monkeypatch):
    """One method was scored on 25 of the 40 pairs."""
    few = tmp_path / "few.json"
    write_score(few, *scored("few", shifted(0.3), cases(25)))
    files = [str(score_files[0]), str(few)]
    assert cli.main(["results", *files, "--out", str(tmp_path / "results.md")]) == 0
    text = (tmp_path / "results.md").read_text()
    assert "25 pairs are counted here, other numbers elsewhere: half (40); such scores do not compare." in text
    assert "40 pairs are counted here, other numbers elsewhere: few (25); such scores do not compare." in text
    assert len(re.findall(r"^## .*, (?:25|40) pairs$", text, re.M)) == 2
    monkeypatch.setattr(figures, "encoded_figure", lambda *_: b"")  # words are the subject
    assert cli.main(["report", *files, "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert page.count("pairs are counted here, other numbers elsewhere") == 2
    capsys.readouterr()
    assert cli.main(["compare", *files]) == 0
    said = capsys.readouterr().out
    assert f"{files[0]} counts 40 pairs and {few} 25: the differences are over the pairs that both have" in said
    assert cli.main(["compare", *map(str, score_files[:2])]) == 0
    assert "counts" not in capsys.readouterr().out


@pytest.mark.slow
def test_points_without_an_interval_are_open_and_explained(few_samples, monkeypatch):
    """Each stratum of three pairs has fewer than five samples; with two hundred, those of distance have more."""
    few, page = few_samples
    assert "Open marks: too few samples for an interval." in page
    assert has_open_marks(few)
    many = scored("ideal", sampler(), cases(200))
    assert not has_open_marks(many[0])
    with monkeypatch.context() as undrawn:
        undrawn.setattr(figures, "encoded_figure", lambda *_: b"")
        assert "Open marks" not in report_html([many])
    for document, is_open in ((few, True), (many[0], False)):
        drawn = base64.b64decode(error_panels({"ideal": document})[0].source.split(",")[1]).decode()
        assert ("fill: #ffffff; stroke: #0072b2" in drawn) == is_open


@pytest.mark.parametrize("command", ["report", "results", "compare"])
def test_a_score_of_another_version_ends_in_a_sentence(command, score_files, tmp_path, capsys):
    old = tmp_path / "old.json"
    old.write_text(json.dumps({**json.loads(score_files[0].read_text()), "version": 1}))
    out = [] if command == "compare" else ["--out", str(tmp_path / "page.html")]
    assert cli.main([command, str(score_files[1]), str(old), *out]) == 2
    said = capsys.readouterr().err
    assert "old.json has version 1, this program reads" in said
    assert "Traceback" not in said
    assert not (tmp_path / "page.html").exists()


def test_results_of_nothing_or_of_one_method_twice_are_refused(score_files, tmp_path):
    copy = tmp_path / score_files[0].name
    for suffix in (".json", ".parquet"):
        shutil.copy(score_files[0].with_suffix(suffix), tmp_path)
    with pytest.raises(DatasetError, match="another score of the same pairs"):
        read_parts([score_files[0], copy])
    with pytest.raises(DatasetError, match="results of nothing"):
        read_parts([])


@pytest.mark.slow
def test_results_leave_out_who_takes_none_of_the_pairs(tmp_path):
    """`chain_fit` is what others are compared with by default: on raw pixels the best method stands in."""
    why = "takes srgb8, yuyv, mjpeg, not bayer-raw"
    files = []
    for name, oracle in (("ideal", sampler()), ("chain_fit", lambda _: Answer(Spot.missing(why), Spot.missing(why)))):
        files.append(tmp_path / f"{name}.json")
        write_score(files[-1], *scored(name, oracle))
    (part,) = read_parts(files)
    assert [one.method.name for one in part.scores] == ["ideal"]
    assert part.against == "ideal"
    assert part.differences == {}
    assert f"chain_fit is not compared: it {why}" in part.notes


def test_the_report_says_where_the_time_went():
    times = {"mjpeg": {"draw": 0.5, "detect": 0.25}, "bayer-raw": {"draw": 0.4}}
    (table,) = time_section(times).tables
    assert table[1:] == (("draw", "500.0", "400.0"), ("detect", "250.0", ""), ("all", "750.0", "400.0"))


def test_scores_in_the_formats_of_others(tmp_path, capsys):
    """What each format requires, as its specification of November 2026 says it; numbers are the score's own."""
    yaml = pytest.importorskip("yaml")
    score, table = scored("half", shifted(0.5))
    score = score.model_copy(update={"pair_set": {"presets": ["mjpeg"], "hinted": 0}})
    write_score(tmp_path / "half.json", score, table)
    score = read_score(tmp_path / "half.json")
    words = ["results", str(tmp_path / "half.json"), "--records", str(tmp_path / "r"), "--dataset-id", "org/bench"]
    assert cli.main([*words, "--organization", "Us"]) == 0
    capsys.readouterr()
    written = sorted((tmp_path / "r" / "every_eval_ever").glob("*.json"))
    assert len(written) == 1
    record = json.loads(written[0].read_text())
    required = {"schema_version", "evaluation_id", "retrieved_timestamp", "source_metadata", "model_info"}
    assert required | {"eval_library", "evaluation_results"} <= set(record)
    assert set(record) <= required | {
        "evaluation_timestamp",
        "eval_library",
        "evaluation_results",
    }  # the schema allows no others
    results = {one["evaluation_name"].split(",")[0]: one for one in record["evaluation_results"]}
    for name, one in results.items():
        metric, told = score.metrics[name], one["score_details"]
        assert told["score"] == metric.value
        assert one["metric_config"]["lower_is_better"] is (metric.better == "lower")
        interval = told["uncertainty"].get("confidence_interval")
        assert (interval is None) == (metric.low is None)
        assert interval is None or (interval["lower"], interval["upper"]) == (metric.low, metric.high)
        assert one["source_data"]["hf_repo"] == "org/bench"
    assert {"find", "average_recall", "rms_px"} <= set(results)
    (entries,) = [yaml.safe_load(path.read_text()) for path in (tmp_path / "r" / ".eval_results").glob("*.yaml")]
    assert [entry["dataset"]["task_id"] for entry in entries] == ["find_mjpeg", "depth_mjpeg"]
    assert all(entry["dataset"]["id"] == "org/bench" and isinstance(entry["value"], float) for entry in entries)
    assert cli.main([*words[:-1], "bench", "--organization", "Us"]) == 2
    assert "give ORGANIZATION/NAME" in capsys.readouterr().err
    assert cli.main([*words[:-2]]) == 2
    assert "--records needs --dataset-id and --organization" in capsys.readouterr().err


def test_commits_of_one_version_are_told_together() -> None:
    programs = ["phibench 0.6.0 (commit bb)", "phibench 0.5.0 (commit cc)", "phibench 0.6.0 (commit aa)", "not told"]
    told = "not told, phibench 0.5.0 (commit cc), phibench 0.6.0 (commit aa, bb)"
    assert told_programs(set(programs)) == told
