"""Texts of strangers in what is written for people: names of methods and cameras, notes of files, reasons.

One function for each kind of output, and no output without one. A text stays readable, is one line, and is nothing but
text: no markup, no link, no command, no formula. A terminal has `validation.printable_line`, HTML of templates the
template's own escapes, and JSON its own.

`ShortForm` is our own text: results show a title with lines of names and values, in a terminal and in a notebook.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

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


# -- short form of results ---------------------------------------------------------------------------------------------

_FEW = 4  # values that are shown one by one


class ShortForm:
    """Result whose `repr` is a short table; a notebook shows the same, and not all of its fields."""

    def _title(self) -> str:
        return type(self).__name__

    def _shown(self) -> Mapping[str, Any]:
        """Values by their names, as `short` takes them."""
        return {}

    def __repr__(self) -> str:
        return "\n".join([self._title(), *_lines({name: short(value) for name, value in self._shown().items()})])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _lines(shown: Mapping[str, str]) -> Iterator[str]:
    width = max(map(len, shown), default=0) + 2
    return (f"  {name:{width}}{value}".rstrip() for name, value in shown.items())


def short(value: Any) -> str:
    """Few words for a value: numbers with six digits, arrays of more than four values by shape and range."""
    if value is None:
        return "-"
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, tuple | list) and len(value) <= _FEW:
        return f"({', '.join(map(short, value))})"
    return str(value)


def _array(values: np.ndarray[Any, Any]) -> str:
    if values.ndim == 0:
        return short(values.item())
    if values.size <= _FEW and values.ndim == 1:
        return f"({', '.join(short(one) for one in values.tolist())})"
    text = f"{' x '.join(map(str, values.shape))} {values.dtype}"
    if values.dtype.kind not in "iuf" or not np.isfinite(values).any():
        return text
    return f"{text}, {short(np.nanmin(values).item())} to {short(np.nanmax(values).item())}"
