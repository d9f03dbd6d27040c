"""Texts of strangers, read back by parsers of the outputs: nothing but text, and the text itself."""

import csv
import html
import io
import re
from collections.abc import Callable
from html.parser import HTMLParser

import pytest

from phibench.datasets.common.shown_text import csv_text, html_text, latex_text, markdown_cell, markdown_text

NASTY = (
    *("<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a & b", "&lt;b&gt;", "[a](http://b)", "![a](b)"),
    *("[a][b]", "[a]: http://b", "http://evil.invalid/x", "www.evil.invalid", "me@evil.invalid", "mailto:a", "`code`"),
    *("*a*", "**a**", "_a_", "__a__", "~~a~~", "a*b*c", "# head", "- item", "* item", "1. item", "> quote", "a|b"),
    *("a\\|b", "a\\", "$\\frac{1}{2}$", "\\input{/etc/passwd}", "100 %", "a^b~c", "=1+1", "+1", "-1", "@sum", "\t=1"),
    *("a\n# b", "a\r\n\r\n<b>", "\x1b[31m", "\u202eabc", "--- | ---", "<!-- x", "{{ 7 * 7 }}", "x" * 5000, ""),
)
PLAIN = ("chain_fit", "0.413 [0.341, 0.471]", "0.0663 [0.0529, 0.0801] **", "1.2 *", "-", "97.7; 0.16", "rms D / %")


def github(text: str) -> str:
    """HTML by CommonMark with GitHub's tables and lines through words."""
    from markdown_it import MarkdownIt

    return MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render(text)


def site(text: str) -> str:
    """HTML by the parser of our own pages, where it is installed."""
    return pytest.importorskip("markdown").markdown(text, extensions=["tables", "footnotes", "attr_list"])


@pytest.mark.parametrize("page_of", [github, site])
def test_markdown_shows_the_text_alone(page_of: Callable[[str], str]) -> None:
    for text in NASTY:
        for shown in (f"* {markdown_text(text)}", f"# {markdown_text(text)}"):
            page = page_of(shown)
            assert set(re.findall(r"</?([a-z0-9]+)", page)) <= {"ul", "li", "h1"}, page
        page = page_of(f"| a | b |\n|---|---|\n| {markdown_cell(text)} | end |")
        cells = re.findall(r"<td>(.*?)</td>", page, re.DOTALL)
        assert len(cells) == 2
        assert cells[1] == "end"
        assert "<" not in cells[0]
        words = " ".join(text.split())
        if words.isprintable() and len(words) < 2000:
            assert html.unescape(cells[0]) == words


def test_tables_of_numbers_are_as_before() -> None:
    for text in PLAIN:
        assert markdown_cell(text) == text


def test_html_has_no_tag_of_a_text() -> None:
    tags: list[str] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: object) -> None:
            tags.append(tag)

    for text in NASTY:
        Parser().feed(f'<p title="{html_text(text)}">{html_text(text)}</p>')
    assert tags == ["p"] * len(NASTY)


def test_latex_has_no_command_of_a_text() -> None:
    """Only what the function itself writes: a backslash before a mark, or one of five words."""
    for text in NASTY:
        shown = latex_text(text)
        rest = re.sub(r"\\(?:[&%$#_{}]|text(?:backslash|asciitilde|asciicircum|less|greater|quotedbl)\{\})", "", shown)
        assert not re.search(r"[\\&%$#_{}~^<>\"\n]", rest), shown


def test_no_cell_of_a_table_is_a_formula() -> None:
    for text in NASTY:
        buffer = io.StringIO()
        csv.writer(buffer).writerow([csv_text(text), "end"])
        [[cell, end]] = csv.reader(io.StringIO(buffer.getvalue()))
        assert end == "end"
        assert not cell.strip().startswith(("=", "+", "-", "@"))
