"""Texts of strangers made safe to print, short forms of results, and tables for terminals, Markdown, LaTeX and CSV.

Strangers' texts are names of methods and cameras, notes of files, reasons. One function for each kind of output, and no
output without one. A text stays readable, is one line, and is nothing but text: no markup, no link, no command, no
formula. A terminal has `validation.printable_line`, HTML of templates the template's own escapes, and JSON its own.

`ShortForm` is our own text: results show a title with lines of names and values, in a terminal and in a notebook.
"""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from phibench.scenes.validation import printable_line

if TYPE_CHECKING:  # most commands show no table
    from rich.console import Console

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
        """Values by their names, as `short_text` takes them."""
        return {}

    def __repr__(self) -> str:
        return "\n".join([self._title(), *_lines({name: short_text(value) for name, value in self._shown().items()})])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _lines(shown: Mapping[str, str]) -> Iterator[str]:
    width = max(map(len, shown), default=0) + 2
    return (f"  {name:{width}}{value}".rstrip() for name, value in shown.items())


def short_text(value: Any) -> str:
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
        return f"({', '.join(map(short_text, value))})"
    return str(value)


def _array(values: np.ndarray[Any, Any]) -> str:
    if values.ndim == 0:
        return short_text(values.item())
    if values.size <= _FEW and values.ndim == 1:
        return f"({', '.join(short_text(one) for one in values.tolist())})"
    text = f"{' x '.join(map(str, values.shape))} {values.dtype}"
    if values.dtype.kind not in "iuf" or not np.isfinite(values).any():
        return text
    return f"{text}, {short_text(np.nanmin(values).item())} to {short_text(np.nanmax(values).item())}"


# -- tables ------------------------------------------------------------------------------------------------------------

WIDE = 210
"""Columns of a terminal for tables with every interval."""
_MANY = 9  # columns that stand close together


@dataclass(frozen=True)
class TextTable:
    """A table as text.

    Attributes
    ----------
    heads : tuple of str
        A line break parts a head from its unit.
    rows : tuple of rows, each a tuple of str
    columns : str
        A letter each: "r" is a number, "l" a word, "L" a text that may go on on the next line.
    note : str
        A line below the table.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    columns: str
    note: str = ""


def table_console(wide: bool) -> Console:
    """A console for tables: at least 80 columns wide, or `WIDE`."""
    return wide_console(WIDE if wide else 80)


def wide_console(least: int) -> Console:
    """A console with so many columns at least: in a narrow terminal or a pipe a table would lose numbers."""
    from rich.console import Console

    console = Console(markup=False, emoji=False)
    return console if console.width >= least else Console(width=least, markup=False, emoji=False)


def show_grid(console: Console, grid: TextTable) -> None:
    """Print a table to a terminal; text that is too long for it goes on below."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    gap = int(len(grid.heads) < _MANY)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, gap, 0, 0), show_edge=False)
    for name, kind in zip(grid.heads, grid.columns, strict=True):
        table.add_column(name, justify="right" if kind == "r" else "left", overflow="fold", no_wrap=kind != "L")
    for row in grid.rows:
        table.add_row(*map(Text, row))  # as it is: a string would be searched for markup and emoji
    for part in (Text(grid.title, style="bold"), table, *([Text(grid.note)] if grid.note else [])):
        console.print(part)
    console.print()


def text_of(grid: TextTable) -> str:
    """Table as a terminal of 80 columns shows it."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=80, markup=False, emoji=False, color_system=None)
    show_grid(console, grid)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in shown.rstrip().split("\n"))


def markdown(grid: TextTable) -> str:
    """Table in Markdown, a line of text before it."""
    marks = [" --: " if kind == "r" else " :-- " for kind in grid.columns]
    heads, *rows = (tuple(map(markdown_cell, row)) for row in (grid.heads, *grid.rows))
    lines = table_lines(heads, rows, marks)
    note = ("", markdown_text(grid.note)) if grid.note else ()
    return "\n".join((f"{markdown_text(grid.title)}\n", *lines, *note)) + "\n"


def latex(grid: TextTable) -> str:
    """Table in LaTeX, for the package booktabs."""
    lines = [" & ".join(map(latex_text, row)) + r" \\" for row in (grid.heads, *grid.rows)]
    body = [
        rf"\begin{{tabular}}{{{grid.columns.lower()}}}",
        r"\toprule",
        lines[0],
        r"\midrule",
        *lines[1:],
        r"\bottomrule",
    ]
    return "\n".join((f"% {printable_line(grid.title)}", *body, r"\end{tabular}")) + "\n"


def csv_table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """CSV; an empty cell for None."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerows(
        [heads, *(["" if x is None else csv_text(x) if isinstance(x, str) else x for x in row] for row in rows)]
    )
    return buffer.getvalue()
