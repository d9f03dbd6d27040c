"""Pages of the studies: every number in them is one of the published document, rounded as printed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.page_numbers import Block, Published, agrees, blocks, printed

from phibench.studies.framework import read_settings
from phibench.studies.run import NAMES, StudyDocument, find_study

PAGES = Path(__file__).resolve().parents[2] / "docs" / "studies"


@pytest.fixture(scope="module")
def published() -> Published:
    return Published(PAGES)


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def _page(name: str) -> str:
    return (PAGES / f"{name}.md").read_text(encoding="utf-8")


def test_every_study_has_page_and_document(published: Published) -> None:
    assert set(published.names) == set(NAMES)
    for name in NAMES:
        document = StudyDocument.model_validate_json((PAGES / f"{name}.json").read_text(encoding="utf-8"))
        assert (document.name, document.quick) == (name, False)
        assert set(document.settings) == set(read_settings(find_study(name)).model_dump(mode="json"))


def test_every_number_is_a_published_one(published: Published, name: str) -> None:
    wrong, checked = published.wrong(name, _page(name))
    assert not wrong, "\n".join(wrong)
    assert checked, f"{name}.md states no number"


def test_the_pages_have_many_numbers(published: Published) -> None:
    assert sum(published.wrong(name, _page(name))[1] for name in NAMES) > 2000


@pytest.mark.parametrize(
    ("page", "wrong", "checked"),
    [
        ("D is 2.5 m.\n<!-- from: depth -->", 0, 1),  # a small study may state one number
        ("<!-- from: settings.depth_m -->\nD is 2.5 m.", 0, 1),
        ("D is 2.6 m.\n<!-- from: depth -->", 1, 1),
        ("<!-- from: depth -->\n\nD is 2.5 m.", 1, 1),  # an empty line parts them
        ("D is 2.5 m.", 1, 1),
        ("D comes back.\n<!-- from: depth -->", 0, 0),
    ],
)
def test_a_small_page_passes_and_fails(tmp_path: Path, page: str, wrong: int, checked: int) -> None:
    document = {"settings": {"depth_m": 2.5}, "findings": [{"label": "depth", "value": 2.5}]}
    (tmp_path / "echo.json").write_text(json.dumps(document), encoding="utf-8")
    found = Published(tmp_path).wrong("echo", f"# Echo 7\n\n{page}\n")
    assert (len(found[0]), found[1]) == (wrong, checked)


def test_a_changed_number_is_found(published: Published, name: str) -> None:
    """Another last digit; a block with many numbers may hold the changed one as well, once or in one case of 20."""
    found = checked = 0
    for block in blocks(_page(name)):
        for token in published.tokens(name, block):
            for by in (1, 3, 5, 8):
                checked += 1
                found += not agrees(_changed(token.text, by), token.known)
    assert found >= min(0.95 * checked, checked - 1), f"{found} of {checked}"


def _changed(text: str, by: int) -> str:
    last = max(i for i, digit in enumerate(text.partition("e")[0]) if digit.isdigit())
    return text[:last] + str((int(text[last]) + by) % 10) + text[last + 1 :]


@pytest.mark.parametrize(
    ("text", "known", "holds"),
    [
        ("5.79", [5.794], True),
        ("5.79", [5.796], False),
        ("27", [27.4], True),
        ("-0.98", [-0.98], True),
        ("0.98", [-0.98], True),
        ("+0.98", [-0.98], False),
        ("1e-9", [1e-9], True),
        ("1.3e-5", [1.34e-5], True),
        ("1.3e-5", [1.4e-5], False),
        ("3", [], False),
    ],
)
def test_rounding_as_printed(text: str, known: list[float], holds: bool) -> None:
    assert agrees(text, known) == holds


def test_numbers_that_are_no_results_are_left_alone() -> None:
    text = "Tables 1 to 3, eq. (7), `h = 0.3`, $x^2$, [page 4](a5.md), Figure 9, 95 %: D^2.00 (1.96 to 2.05), 19 of 25."
    assert list(printed(text)) == ["2.00", "1.96", "2.05", "19", "25"]
    assert list(printed("Table 1 has 7 rows; phi_1, h1, 1.5e-3 px")) == ["7", "1.5e-3"]


def test_blocks_take_their_comments() -> None:
    page = "# Title 1\n\n* One 1.\n  <!-- from: a; b\n  c -->\n* Two 2.\n\n    code 3\n\n"
    page += "<!-- cells: x = l {row} -->\n| r | x |\n"
    assert list(blocks(page)) == [
        Block("* One 1.", ("a", "b c")),
        Block("* Two 2."),
        Block("| r | x |", (), (("x", "l {row}"),)),
    ]
