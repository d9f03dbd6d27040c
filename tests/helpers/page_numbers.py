"""Numbers in the page of a study, held against the published document of the study.

A paragraph, bullet or table of `docs/studies/NAME.md` names its sources in HTML comments, which no reader sees:

* `<!-- from: LABEL; LABEL -->`: findings; `settings.draws` or `provenance.date` name other parts of the document. A
  source of another study is written `NAME::LABEL`. Every number of the block must be one of theirs, rounded as printed.
* `<!-- cells: HEAD = LABEL; HEAD = LABEL -->` above a table: each cell below HEAD belongs to the finding whose label
  comes from the pattern, in which `{row}` is the first cell of the row and `{column}` the head. `others` stands for all
  other heads. A cell that holds a verdict must hold that of the finding.
* `<!-- table: CAPTION -->` above a table: its cells are those of the published table of that caption, letter by letter.
  The page may leave out rows and columns.

Numbers that are no results are not looked at: code, links, formulas between `$`, numbers of tables, figures, equations
and sections of the paper, and the confidence of 95 %. Findings that were measured beside a run are in `beside.json`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NUMBER = re.compile(r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w]|\.\d)")
_COMMENT = re.compile(r"<!--\s*(from|cells|table):\s*(.*?)\s*-->", re.DOTALL)
_UNITS = r"(?:px|mpx|mm|m|deg|degrees|mW|ln|%)"
_NO_RESULTS = (
    re.compile(r"`[^`]*`"),
    re.compile(r"\$\$.*?\$\$", re.DOTALL),
    re.compile(r"\$[^$]*\$"),
    re.compile(r"!?\[[^\]]*\]\([^)]*\)"),
    re.compile(r"^\d+\. ", re.MULTILINE),
    re.compile(
        r"\b(?:Tables?|Figures?|[Ee]qs?\.|[Ss]ections?) \(?\d+\)?"
        rf"(?:(?:,| to| and) \(?\d+\)?(?!\.?\d| {_UNITS}\b))*"
    ),
    re.compile(r"\b95 %"),
    re.compile(r"\bodds of 10 to 1\b"),
)
VERDICTS = ("met", "missed", "undecided", "favoured", "disfavoured")


@dataclass(frozen=True)
class Token:
    """A printed number with all that may stand behind it."""

    text: str
    known: tuple[float, ...]

    @property
    def holds(self) -> bool:
        """Whether one of the known numbers gives the text, rounded as printed; without a sign the size counts."""
        return agrees(self.text, self.known)


@dataclass(frozen=True)
class Block:
    """A paragraph, a bullet, or a table of a page, without its comments."""

    text: str
    sources: tuple[str, ...] = ()
    cells: tuple[tuple[str, str], ...] = ()
    table: str = ""


def agrees(text: str, known: Iterable[float]) -> bool:
    """Whether a number gives the text, rounded as printed."""
    mantissa, _, exponent = text.lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    half = 0.5 * 10.0 ** (int(exponent or 0) - digits) * (1.0 + 1e-6)
    value = float(text)
    signed = text[0] in "+-"
    return any(abs((x if signed else abs(x)) - value) <= half for x in known)


def blocks(page: str) -> Iterator[Block]:
    """Blocks of a page; headings, code and pictures are left out. A comment belongs to the block that it touches."""
    page = re.sub(r"^```.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    for part in re.split(r"\n\s*\n", page):
        lines = [line for line in part.splitlines() if not line.startswith(("#", "    "))]
        for piece in re.split(r"\n(?=\s*[*-] )", "\n".join(lines)):
            sources, cells, caption = [], [], ""
            for kind, text in _COMMENT.findall(piece):
                entries = [" ".join(entry.split()) for entry in text.split(";") if entry.strip()]
                if kind == "from":
                    sources += entries
                elif kind == "table":
                    caption = " ".join(text.split())
                else:
                    cells += [(head.strip(), label) for head, label in (entry.split(" = ", 1) for entry in entries)]
            if text := _COMMENT.sub("", piece).strip():
                yield Block(text, tuple(sources), tuple(cells), caption)


class Published:
    """Documents of all studies in a folder, with the findings measured beside them."""

    def __init__(self, folder: Path) -> None:
        self._documents = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")}
        beside = self._documents.pop("beside", {})
        self._findings = {
            name: {row["label"]: row for row in (*document["findings"], *beside.get(name, ()))}
            for name, document in self._documents.items()
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Studies that are published."""
        return tuple(sorted(self._documents))

    def finding(self, study: str, label: str) -> dict[str, Any]:
        """A finding; a label that is not there fails with the nearest ones."""
        if "::" in label:
            study, label = label.split("::", 1)
        found = self._findings[study].get(label)
        assert found is not None, f"{study}: no finding {label!r}"
        return found

    def numbers(self, study: str, source: str) -> tuple[float, ...]:
        """All numbers of a source."""
        name, path = source.split("::", 1) if "::" in source else (study, source)
        head, *keys = path.split(".")
        if head in ("settings", "provenance") and " " not in path:
            value: Any = self._documents[name][head]
            for key in keys:
                value = value[int(key) if key.isdigit() else key]
            return tuple(_all(value))
        return tuple(_all({key: x for key, x in self.finding(name, path).items() if key != "source"}))

    def tokens(self, study: str, block: Block) -> Iterator[Token]:
        """Numbers of a block with what they may be.

        In a table with patterns, heads and first cells are parts of labels: a wrong one fails, as no finding has it.
        """
        if block.cells or block.table:
            yield from self._cells(study, block)
            return
        known = tuple(x for source in block.sources for x in self.numbers(study, source))
        for text in printed(block.text):
            yield Token(text, known)

    def wrong(self, study: str, page: str) -> tuple[list[str], int]:
        """Numbers of a page that are no published ones, with their blocks, and how many were looked at."""
        pairs = [(block, token) for block in blocks(page) for token in self.tokens(study, block)]
        return [f"{token.text} in: {block.text[:90]}" for block, token in pairs if not token.holds], len(pairs)

    def _cells(self, study: str, block: Block) -> Iterator[Token]:
        lines = [_cut(line) for line in block.text.splitlines() if line.startswith("|")]
        heads, rows = lines[0], lines[2:]
        assert rows, f"{study}: no table below the comment in: {block.text[:90]}"
        for row in rows:
            for head, cell in zip(heads[1:], row[1:], strict=True):
                if block.table:
                    known = self._shown(study, block.table, row[0], head, cell)
                else:
                    known = self._known(study, dict(block.cells), row[0], head, cell)
                texts = list(printed(cell))
                for i, text in enumerate(texts):
                    # "value (low to high)": each end is its own
                    yield Token(text, known[i : i + 1] if len(texts) == len(known) else known)

    def _shown(self, study: str, caption: str, first: str, head: str, cell: str) -> tuple[float, ...]:
        heads, *rows = self._documents[study]["shown"][caption]
        (row,) = (row for row in rows if row[0] == first)
        assert row[heads.index(head)] == cell, f"{study}: {first}, {head} is {row[heads.index(head)]}, not {cell}"
        return tuple(_all(cell))

    def _known(self, study: str, patterns: dict[str, str], first: str, head: str, cell: str) -> tuple[float, ...]:
        if cell not in VERDICTS and not list(printed(cell)):
            return ()
        pattern = patterns.get(head, patterns.get("others", ""))
        label = pattern.replace("{row}", first).replace("{column}", head)
        found = self.finding(study, label)
        assert cell not in VERDICTS or found["verdict"] == cell, f"{study}: {label} is {found['verdict']}, not {cell}"
        return tuple(_all([found[key] for key in ("value", "low", "high")]))


def printed(text: str) -> Iterator[str]:
    """Numbers of a text that are results."""
    for pattern in _NO_RESULTS:
        text = pattern.sub(" ", text)
    yield from NUMBER.findall(text)


def _cut(line: str) -> list[str]:
    """Cells of a line, without the marks of code."""
    return [cell.strip().strip("`") for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]


def _all(value: Any) -> Iterator[float]:
    """Every number in a value, those inside of texts too."""
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int | float):
        if math.isfinite(value):
            yield float(value)
    elif isinstance(value, str):
        yield from (float(match) for match in NUMBER.findall(value))
    else:
        for part in value.values() if isinstance(value, dict) else value:
            yield from _all(part)
