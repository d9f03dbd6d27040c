"""The pages: short sentences, short lines, live links, and paths, tests and commands that exist."""

import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS

from phibench.cli.main import app
from phibench.datasets.read import open_dataset
from phibench.scenes.room import default_rig

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/**/*.md", "docs/tutorials/*.py", "datasets/*.md")
    for page in ROOT.glob(pattern)
)
# History is written once and describes commands and files of its time.
HISTORY = {"CHANGELOG.md"}
PRESENT = [page for page in PAGES if page not in HISTORY]
MAX_WORDS = 25
MAX_COLUMNS = 120
MAX_TABLE_COLUMNS = 160
# Words of other places that no reader of the repository can look up.
NOWHERE = re.compile(r"\b(DESIGN|HOUSE|BRIEF)\b|\berrata\.md\b")

FENCE = re.compile(r"^\s*```.*?^\s*```\s*$", re.M | re.S)
FORMULA = re.compile(r"\$\$.*?\$\$", re.S)
CODE = re.compile(r"(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)")
LINK = re.compile(r"!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)[^)]*\)")
SOURCE = re.compile(r"""<(?:img|source)[^>]*?\b(?:src|srcset)="([^"]+)\"""")
REPOSITORY_PATH = re.compile(
    r"\b(?:scenes|render|datasets|estimator|tests|docs)/[\w./*-]*\w\.(?:py|md|toml|csv|png|json)\b"
)
ABBREVIATION = re.compile(
    r"\b(eqs?|figs?|e\.g|i\.e|etc|vs|cf|et al|no|J|Appl|Phys|Opt|Lett|Nat|Soc|Am|Proc|Sec)\.(?=\s)"
)


def read(page: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    return notebook(text) if page.startswith("docs/tutorials/") else text


def notebook(text: str) -> str:
    """Markdown of a Python file with cells: code in fences, commands of the shell without their comment signs."""
    parts = []
    for cell in text.split("\n# %%")[1:]:
        kind, _, body = cell.partition("\n")
        plain = re.sub(r"^# ?", "", body, flags=re.M) if kind.strip() else body
        parts.append(plain if "[markdown]" in kind else f"```\n{plain.strip()}\n```\n")
    return "\n".join(parts)


def in_table(line: str) -> bool:
    return line.lstrip().startswith("|")


def blocks(text: str) -> Iterator[str]:
    """Yield paragraphs and list items: no code, tables, headings, formulas."""
    text = FORMULA.sub("\n\n", FENCE.sub("\n\n", re.sub(r"<!--.*?-->", "", text, flags=re.S)))
    block: list[str] = []
    for line in [*text.split("\n"), ""]:
        item = re.match(r"\s*(?:[*+-]|\d+\.)\s+", line)
        ends = not line.strip() or in_table(line) or line.startswith(("#", "<", "    ", "---"))
        if (ends or item) and block:
            yield " ".join(block)
            block = []
        if not ends or (item and not line.startswith("    ")):
            block.append(line[item.end() :] if item else line.strip().lstrip("> "))


def sentences(block: str) -> list[str]:
    """Split a block; code, a formula and a link's address are one word or none."""
    plain = re.sub(r"\$[^$]+\$", "formula", CODE.sub("code", LINK.sub(r"\1", block)))
    plain = ABBREVIATION.sub(r"\1", plain)
    return [part for part in re.split(r"(?<=[.!?])[)\"*]*\s+", plain) if part]


def words(sentence: str) -> int:
    return sum(any(c.isalnum() for c in word) for word in sentence.split())


def slug(heading: str) -> str:
    """GitHub's anchor of a heading."""
    plain = re.sub(r"[`*]", "", LINK.sub(r"\1", heading)).strip().lower()
    return re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")


@cache
def anchors(page: Path) -> set[str]:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    return {slug(h) for h in re.findall(r"^#+\s+(.*)$", text, re.M)} | set(
        re.findall(r'<a (?:id|name)="([^"]+)"', text)
    )


def code_pieces(text: str) -> Iterator[str]:
    """Yield inline code, and the lines of code blocks."""
    for fence in FENCE.findall(text):
        yield from fence.split("\n")[1:-1]
    rest = FENCE.sub("", text)
    yield from (" ".join(piece.split()) for piece in CODE.findall(rest))
    yield from (line.strip() for line in rest.split("\n") if line.startswith("    ") and not in_table(line))


# None stands in a class. A decorator is one line, or ends with a bracket of its own.
TEST = re.compile(r"^((?:@.*\n(?:[ \])].*\n)*)*)(?:async )?def (test_\w+)\(", re.M)
SLOW = re.compile(r"^@pytest\.mark\.(?:slow|study)$", re.M)
ALL_SLOW = re.compile(r"^pytestmark = pytest\.mark\.(?:slow|study)$", re.M)


@cache
def collected_tests() -> tuple[tuple[str, str, bool], ...]:
    """All tests: (file's source, "file name::function", whether it runs without an option)."""
    return tuple(
        (source, f"{file.name}::{name}", not SLOW.search(marks) and not ALL_SLOW.search(source))
        for file in sorted((ROOT / "tests").rglob("test_*.py"))
        for source in (file.read_text(encoding="utf-8"),)
        for marks, name in TEST.findall(source)
    )


def selects(expression: str, source: str, name: str) -> bool:
    """Whether a ``-k`` expression can select a test; parts of a parameter's name are looked up in the file."""

    def holds(word: str) -> str:
        inside = word.lower() in name.lower() or (not word.isidentifier() and all(p in source for p in word.split("-")))
        return str(inside or f'"{word}"' in source)

    python = re.sub(r"[^\s()]+", lambda m: m[0] if m[0] in ("and", "or", "not") else holds(m[0]), expression)
    return bool(eval(python))  # True, False, and, or, not, brackets: nothing else is left


def long_sentences(text: str) -> list[str]:
    """Sentences of too many words."""
    return [s for block in blocks(text) for s in sentences(block) if words(s) > MAX_WORDS]


def long_lines(text: str) -> list[str]:
    """Lines of too many columns; a single word may be long."""
    return [s for s in text.split("\n") if len(s) > MAX_COLUMNS and not in_table(s) and " " in s.strip()]


def long_rows(text: str) -> list[str]:
    """Rows of tables of too many columns."""
    return [line for line in text.split("\n") if in_table(line) and len(line) > MAX_TABLE_COLUMNS]


def missing_files(text: str) -> list[str]:
    """Paths of the repository that are not there."""
    named = {path for piece in code_pieces(text) for path in REPOSITORY_PATH.findall(piece)}
    return [path for path in sorted(named) if "NAME" not in path and not list(ROOT.glob(path))]


def missing_tests(text: str) -> list[str]:
    """Calls of pytest that select no test, or slow ones alone without an option for them."""
    missing = []
    for piece in code_pieces(text):
        if not re.search(r"\bpytest\b", piece):
            continue
        files = {Path(file).name for file in re.findall(r"\btests/\S+\.py", piece)}
        slow = "--s" in piece or "::" in piece
        tests = [
            (source, name)
            for source, name, quick in collected_tests()
            if (quick or slow) and (not files or name.split("::")[0] in files)
        ]
        for quoted, bare in re.findall(r"""-k\s+(?:"([^"]+)"|(\S+))""", piece):
            if not any(selects(quoted or bare, source, name) for source, name in tests):
                missing.append(piece)
        if not tests:
            missing.append(piece)
    return missing


def unknown_commands(text: str) -> list[str]:
    """Calls of `phibench` that the command line does not have."""
    call = re.compile(r"(?:time )?(?:\S*/)?phibench\s+([a-z][\w-]*)(?:\s+([a-z][\w-]*))?")
    return [piece for piece in code_pieces(text) if (m := call.match(piece)) and not is_command(m[1], m[2])]


def unknown_targets(text: str) -> list[str]:
    """Targets that the Makefile does not have."""
    targets = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    named = {m[1] for piece in code_pieces(text) if (m := re.match(r"(?:time )?make ([a-z][\w-]*)", piece))}
    return sorted(named - targets)


def is_command(name: str, sub: str | None) -> bool:
    """Whether the command line has this command; of a group, the subcommand too."""
    if name not in app:
        return False
    group = [key for key in app[name] if not key.startswith("-")]
    return not group or sub is None or sub in group


CHECKS = (long_sentences, long_lines, long_rows, missing_files, missing_tests, unknown_commands, unknown_targets)


@pytest.mark.parametrize("page", PRESENT)
def test_a_page_is_short_and_names_what_exists(page):
    text = read(page)
    assert {check.__name__: faults for check in CHECKS if (faults := check(text))} == {}


def test_links_are_alive():
    dead = []
    for page in PAGES:
        text = CODE.sub("", FENCE.sub("", read(page)))
        for target in [target for _, target in LINK.findall(text)] + SOURCE.findall(text):
            path, _, anchor = target.partition("#")
            if re.match(r"\w+:", path):
                continue
            file = (ROOT / page).parent / path if path else ROOT / page
            if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
                dead.append((page, target))
    assert not dead


def test_the_citation_has_the_version_of_the_package():
    (cited,) = re.findall(r"^version: (\S+)$", read("CITATION.cff"), re.M)
    assert cited == tomllib.loads(read("pyproject.toml"))["project"]["version"]


def test_the_default_rig_is_that_of_the_page():
    camera, mirror = default_rig().camera, default_rig().mirror
    index, z_c_m = mirror.refractive_index(650.0), default_rig().T_camera_sphere.t[2]
    stated = (
        ("mirror radius", f"{1e3 * mirror.radius_m:.0f} mm"),
        ("mirror index", f"{index.real:.3f} + {index.imag:.3f} i"),
        ("image, pixel pitch", f"{camera.width_px} x {camera.height_px}, {camera.pixel_pitch_um} um"),
        ("focal length", f"{camera.fx_px:.0f} px"),
        ("principal point", f"({camera.cx_px}, {camera.cy_px}) px"),
        ("distortion", "-0.026, 1.06, -3.40"),
        ("f-number", f"{camera.f_number} (2.0 to 2.8), aperture radius {1e3 * camera.aperture_radius_m:.3f} mm"),
        ("lens centre to sphere centre", f"{z_c_m} m"),
        ("optical blur", f"sigma {camera.blur_sigma_px} px"),
    )
    rows = [line for line in read("docs/model.md").split("\n") if in_table(line)]
    for name, value in stated:
        (row,) = [row for row in rows if row.startswith(f"| {name}")]
        assert value in row


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_the_examples_of_the_page_run(page, tiny_dataset, tmp_path, monkeypatch):
    """On a small data set in place of `paper`, with one pair to score."""
    monkeypatch.chdir(tmp_path)
    first, names = open_dataset(tiny_dataset)[0].row.sample_id, {}
    examples = re.findall(r"^```python\n(.*?)^```", read(page), re.M | re.S)
    assert examples
    for example in examples:
        for old, new in (
            ("table2-d3.180-h0.425", first),
            ("out/paper", str(tiny_dataset)),
            (".score(dataset", ".score(dataset[:1]"),
        ):
            example = example.replace(old, new)
        exec(example, names)


RUNS = re.compile(
    r"`[^`]*\b(pytest|phibench|make|python|mkdocs|buildah|du|cffconvert|git|\.ci/run)\b"
    r"|^`(-m |--slow|\w+\.py|docs/\w+\.py|dataset )|^same\b|^the same\b|^\(|\]\("
)


def test_measurements_have_commands():
    """A figure without a command that repeats it cannot be checked: a command, a note with one, or a link to it."""
    checked, without = 0, []
    for page in sorted((ROOT / "docs" / "measurements").glob("*.md")):
        column = None
        for line in page.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
            if not line.startswith("|"):
                column = None
            elif column is None:
                column = cells.index("command") if "command" in cells else -1
            elif column >= 0 and not cells[0].startswith("---"):
                checked += 1
                if not RUNS.search(cells[column]):
                    without.append(f"{page.name}: {line[:80]}")
    assert checked > 300
    assert without == []


def test_pages_that_are_excused_exist():
    assert set(PAGES) >= HISTORY


def test_nothing_is_named_that_only_the_authors_have():
    suffixes = {".py", ".md", ".toml", ".csv", ".json", ".ini", ".cff", ""}
    folders = (*DISTRICTS, "phibench", "tests", "docs")
    files = [f for folder in folders for f in (ROOT / folder).rglob("*") if f.is_file() and f.suffix in suffixes]
    assert len(files) > 300
    found = [
        f.relative_to(ROOT).as_posix()
        for f in [*files, *ROOT.glob("*.md"), ROOT / "Makefile"]
        if f != Path(__file__) and "__pycache__" not in f.parts and NOWHERE.search(f.read_text(encoding="utf-8"))
    ]
    assert not found


def test_the_checks_see_faults():
    row = "| " + "x" * MAX_TABLE_COLUMNS
    faults = ("word " * 26 + ".", "a " + "b" * MAX_COLUMNS, row, "`docs/no.md`", "`pytest -k no_such_test`")
    for check, fault in zip(CHECKS, (*faults, "`phibench paint`", "`make tea`"), strict=True):
        assert len(check(fault)) == 1, check
        assert not check("`pytest -k test_links_are_alive`, `make test`, `phibench demo`, `docs/model.md`"), check
    long = "One " + "word " * 24 + "more."
    assert [words(s) for s in sentences(long + " Short one. See eq. (4) of `a b c` in [a page](x.md).")] == [26, 2, 8]
    assert list(blocks("# A\n\none\ntwo\n* three\n  four\n\n| t |\n\n    code\n$$\nx\n$$\nend")) == [
        "one two",
        "three four",
        "end",
    ]
    assert selects("pages and not links", "", "test_pages.py::test_lines")
    assert not selects("pages and not links", "", "test_pages.py::test_links")
    assert selects("chain and mjpeg-5000", "('mjpeg', 5000)", "t.py::test_chain")
    assert is_command("dataset", "make")
    assert not is_command("dataset", "bake")
    assert not is_command("paint", None)
    assert notebook('---\n# %% [markdown]\n# A [b](c).\n\n# %% language="bash"\n# phibench no\n\n# %%\nx = 1') == (
        "A [b](c).\n\n```\nphibench no\n```\n\n```\nx = 1\n```\n"
    )
    assert slug("What `make dataset` writes") == "what-make-dataset-writes"
