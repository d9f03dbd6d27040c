"""Texts of strangers in what is written for people: names of methods and cameras, notes of files, reasons.

One function for each kind of output, and no output without one. A text stays readable, is one line, and is nothing but
text: no markup, no link, no command, no formula. A terminal has `validation.printable_line`, HTML of templates the
template's own escapes, and JSON its own.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence

from phibench.scenes.validation import printable_line

_MOST = 2000  # signs of a stranger's text

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    '"': r"\textquotedbl{}",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
}

# What Markdown takes for more than text, in the dialects of GitHub and of the site. Marks between blanks, digits in
# brackets and a low line within a word are text in all of them and stay, so that tables of numbers read as before.
_MARKDOWN = re.compile(
    r"[&<`$\\]"  # entities, tags, code, formulas, escapes
    r"|(?<!\S)[*~_]++(?=\S)|(?<=[^\s*~_])[*~]++|(?<=\w)_+(?!\w)|(?<![\w\s])_+"  # emphasis
    r"|!(?=\[)|\](?=[(\[:])"  # pictures and links
    r"|:(?=//)|(?<=\bwww)\.|(?<=\w)@(?=\w)|(?<=mailto):",  # addresses
    re.IGNORECASE,
)
_BLOCK = re.compile(r"^(?:[-+*](?=\s|$)|[#>=|:]|-{2,}|\d{1,9}(?=[.)](?:\s|$)))")  # lists, heads, tables
_FORMULA = re.compile(r"\s*[=+\-@\t\r]")


def html_text(text: str) -> str:
    """Text for HTML, between tags and in attributes."""
    return html.escape(printable_line(text, _MOST))


def markdown_text(text: str) -> str:
    """Text for Markdown: an item, a head or part of a sentence."""
    line = printable_line(text, _MOST)
    begin = _BLOCK.match(line)
    head, rest = (_entities(begin), line[begin.end() :]) if begin else ("", line)
    return head + _MARKDOWN.sub(_entities, rest)


def markdown_cell(text: str) -> str:
    """Text for a cell of a table in Markdown, where no block begins."""
    return _MARKDOWN.sub(_entities, printable_line(text, _MOST)).replace("|", "\\|")


def _entities(match: re.Match[str]) -> str:
    return "".join(f"&#{ord(c)};" for c in match[0])


def latex_text(text: str) -> str:
    """Text for LaTeX, outside formulas."""
    return "".join(_LATEX.get(c, c) for c in printable_line(text, _MOST))


def csv_text(text: str) -> str:
    """Text for a cell of CSV: spreadsheets take one that begins with =, +, - or @ for a formula, so it gets a quote."""
    line = printable_line(text, _MOST)
    return f"'{line}" if _FORMULA.match(line) else line


def table_lines(heads: Sequence[str], rows: Iterable[Sequence[str]], marks: Sequence[str] = ()) -> list[str]:
    """Lines of a Markdown table, whose cells are Markdown already; `marks` stand below the heads, such as " --: "."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return [lines[0], f"|{'|'.join(marks or ['---'] * len(heads))}|", *lines[1:]]
