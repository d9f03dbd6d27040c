"""The site: its navigation leads to pages that exist, its formulas are understood, and it works from disk."""

from __future__ import annotations

import ast
import html
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
CHROMIUM = next((name for name in ("chromium", "chromium-browser", "google-chrome") if shutil.which(name)), "")
ELSEWHERE = {
    "index.md": "README.md",
    "datasets/RECIPE.md": "datasets/RECIPE.md",
    "datasets/FORMAT.md": "datasets/FORMAT.md",
}
FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+?)\$", re.S)
CODE = re.compile(r"```.*?```|`[^`]*`", re.S)


class Loader(yaml.SafeLoader):
    """YAML of mkdocs, whose tags name Python objects."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


def navigation(part: Any) -> Iterator[str]:
    """Every page of the navigation."""
    if isinstance(part, str):
        yield part
    for entry in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from navigation(entry)


def test_every_page_of_the_navigation_exists_and_every_page_is_reached() -> None:
    config = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)
    places = list(navigation(config["nav"]))
    assert len(places) == len(set(places)) > 30
    for place in places:
        source = ROOT / ELSEWHERE.get(place, f"docs/{place}")
        notebook = source.with_suffix(".py") if place.startswith("tutorials/") else source
        assert place.startswith("reference/") or notebook.is_file(), place
    linked = "".join(page.read_text(encoding="utf-8") for page in [*ROOT.glob("docs/*.md"), ROOT / "README.md"])
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name in places or f"{page.name})" in linked or f"{page.name}#" in linked, page


def test_pages_stand_in_two_lists_and_those_to_use_it_are_short() -> None:
    """README and the navigation have the same lists. Words are counted as `wc -w` does, columns of tables included."""
    config = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)
    lists = {heading: list(navigation(part)) for entry in config["nav"] for heading, part in entry.items()}
    readme = (ROOT / "README.md").read_text(encoding="utf-8").split("## All pages")[1]
    use, why = readme.split("To use it:")[1].split("To know why:")
    for heading, text in (("To use it", use), ("To know why", why.split("`make docs`")[0])):
        linked = {link.removeprefix("docs/") for link in re.findall(r"\]\(([\w/]+\.md)\)", text)}
        alone = ("index.md", "tutorials/", "studies/")  # README itself; tutorials and studies have lists of their own
        assert linked == {page for page in lists[heading] if not page.startswith(alone)}
    pages = [ROOT / ELSEWHERE.get(page, f"docs/{page}") for page in lists["To use it"]]
    sources = [page.with_suffix(".py") if "tutorials" in page.parts else page for page in pages]
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in sources) <= 60_000


def test_every_formula_of_the_pages_is_understood() -> None:
    convert = pytest.importorskip("latex2mathml.converter").convert
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "datasets").glob("*.md")]
    formulas = [(page, a or b) for page in pages for a, b in FORMULA.findall(CODE.sub("", page.read_text("utf-8")))]
    assert len(formulas) > 40
    for page, latex in formulas:
        # a command that the converter does not know stays in its output with its backslash
        assert "\\" not in convert(re.sub(r"\\tag\{\d+\}", "", latex).strip()), (page, latex)
    assert "\\" in convert(r"\unknowable x")


def fonts() -> dict[str, str]:
    """Font files by their names in the site, of the hooks' source: its imports are not all here."""
    tree = ast.parse((ROOT / "docs" / "site_hooks.py").read_text(encoding="utf-8"))
    named = (node for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "FONTS")
    return dict(ast.literal_eval(next(named).value))


def test_a_mathematics_font_travels_with_the_site() -> None:
    """Every letter of the formulas is in it, also in italics: browsers draw a letter x as U+1D465, and h as U+210E."""
    import matplotlib
    from fontTools.ttLib import TTFont

    convert = pytest.importorskip("latex2mathml.converter").convert
    here = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    signs, letters = (TTFont(here / fonts()[f"mathematics-{name}.ttf"]) for name in ("signs", "letters"))
    assert "MATH" in signs
    assert {0x20, 0x28, 0x221A, 0x2211} <= set(signs.getBestCmap())
    assert all((here / name).is_file() for name in fonts().values())
    style = (ROOT / "docs" / "assets" / "site.css").read_text(encoding="utf-8")
    assert {name for name in fonts() if name.endswith(".ttf")} == set(re.findall(r'url\("(.*?)"\)', style))
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "datasets").glob("*.md")]
    formulas = [a or b for page in pages for a, b in FORMULA.findall(CODE.sub("", page.read_text("utf-8")))]
    drawn = "".join(convert(re.sub(r"\\tag\{\d+\}", "", latex).strip()) for latex in formulas)
    texts = {html.unescape(text) for text in re.findall(r"<m[ion][^>]*>([^<]+)<", drawn)}
    wanted = {ord(sign) for text in texts for sign in text} | {italic(text) for text in texts if len(text) == 1}
    assert len(wanted) > 60
    assert [f"U+{code:04X}" for code in sorted(wanted - set(letters.getBestCmap()))] == []


def italic(letter: str) -> int:
    """Code point that a browser draws for one letter alone (MathML Core, appendix on italics); Latin and Greek."""
    code = ord(letter)
    if letter == "h":
        return 0x210E
    for first, last, start in (("A", "Z", 0x1D434), ("a", "z", 0x1D44E), ("Α", "Ω", 0x1D6E2), ("α", "ω", 0x1D6FC)):
        if ord(first) <= code <= ord(last):
            return start + code - ord(first)
    return code


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.mark.study
def test_the_site_loads_nothing_from_the_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 60
    loads = re.compile(r"""<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)=["']?https?://[^>]*>""")
    # a link to the page's own address is no load
    found = {tag for page in pages for tag in loads.findall(page.read_text("utf-8")) if 'rel="canonical"' not in tag}
    assert not found
    formulas = (site / "limits.html").read_text("utf-8")
    assert formulas.count("<math") > 8
    assert "arithmatex" not in formulas
    assert all((site / "assets" / name).stat().st_size > 1000 for name in fonts())


@pytest.mark.study
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_the_search_works_from_disk(site: Path, tmp_path: Path) -> None:
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--virtual-time-budget=20000", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path}", "--dump-dom", f"{(site / 'index.html').as_uri()}?q=Alhazen"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "CONSOLE" not in done.stderr
    assert re.search(r"[1-9]\d* matching document", done.stdout)
    assert "model.html" in done.stdout


@pytest.mark.parametrize("fails", [False, True])
def test_make_docs_tells_what_it_does_and_shows_pip_where_it_fails(tmp_path: Path, fails: bool) -> None:
    """The environment's Python is a script that warns as pip does, and fails or not."""
    (tmp_path / "bin").mkdir()
    for name, text in {"python": f"echo WARNING: a location; exit {int(fails)}", "mkdocs": "exit 0"}.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    for stamp in (".phibench-ready", ".phibench-complete"):  # in this order: the second needs the first
        (tmp_path / stamp).touch()
    child = subprocess.run(
        ["make", "--no-print-directory", "docs", f"VENV={tmp_path}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (child.returncode == 0) == (not fails)
    assert ("WARNING: a location" in child.stderr) == fails
    lines = child.stdout.splitlines()
    assert lines[0] == "Installing what the site needs"
    assert (lines[-1] == "out/site/index.html" and "tutorials are to be run" in lines[1]) == (not fails)
