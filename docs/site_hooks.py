"""Hooks of the site: pages that lie elsewhere in the tree, sources that pages link to, and the reference.

A link of a page is relative to the page's place in the repository. Here every file gets a place in the site, and links
are turned towards it. Formulas become MathML, which browsers draw by themselves. Fonts of Matplotlib travel with the
site. Tutorials are executed, and their outputs stand in their pages.
"""

from __future__ import annotations

import hashlib
import html
import logging
import posixpath
import re
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib
import nbformat
from latex2mathml.converter import convert
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))
from run_notebook import executed  # noqa: E402

FOLDERS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
TUTORIALS = ("own_method", "own_rig", "real_frames")
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "datasets/RECIPE.md": "datasets/RECIPE.md",
    "datasets/FORMAT.md": "datasets/FORMAT.md",
}
"""Place in the site of every page that does not lie in docs/."""

REFERENCE = {
    "Public names": ("phibench.estimator.interface", "phibench.datasets.read"),
    "Rig, camera, mirror": (
        "phibench.scenes.rig",
        "phibench.scenes.camera",
        "phibench.scenes.mirror",
        "phibench.scenes.revolved_mirror",
        "phibench.scenes.revolved_profile",
        "phibench.scenes.laser",
        "phibench.scenes.misalignment",
    ),
    "Sensor and frames": (
        "phibench.render.sensor.settings",
        "phibench.render.sensor.camera_chain",
        "phibench.datasets.frames.frame_request",
        "phibench.datasets.frames.frame_source",
    ),
    "Geometry and limits": (
        "phibench.estimator.geometry.triangulate",
        "phibench.estimator.geometry.paper_depth",
        "phibench.estimator.limits.position_bound",
        "phibench.estimator.limits.best_stroke",
    ),
    "Training and export": (
        "phibench.datasets.training",
        "phibench.benchmark.export.export_make",
        "phibench.benchmark.export.pair_rows",
    ),
    "Films and loop": (
        "phibench.datasets.film.film_read",
        "phibench.robot.film.film_estimates",
        "phibench.robot.loop.environment",
        "phibench.robot.loop.simulator",
    ),
}
FONTS = {
    "mathematics-signs.ttf": "DejaVuSerif.ttf",  # has the table MATH, by which browsers set formulas and stretch signs
    "mathematics-letters.ttf": "STIXGeneral.ttf",  # has all letters, Greek italics too, and no such table
    "LICENSE_DEJAVU": "LICENSE_DEJAVU",
    "LICENSE_STIX": "LICENSE_STIX",
}
"""Files of the site's assets and of the fonts that Matplotlib brings; their licences allow copies."""

_LOG = logging.getLogger("mkdocs.hooks.phibench")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.S)
_FUNCTION = re.compile(r"(<m[io]>(?:sin|cos|tan|arccos|arcsin)</m[io]>)")
_LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
_LANGUAGE = {".py": "python", ".toml": "toml", ".csv": "text", ".cff": "yaml", ".txt": "text", "": "text"}


@event_priority(100)  # before the reference's reader looks there
def on_config(config: Any) -> Any:
    """Lay out the package as the reference's reader wants it: with `__init__.py` in every folder."""
    package = ROOT / "out" / "site-sources" / "phibench"
    shutil.rmtree(package.parent, ignore_errors=True)
    for folder in FOLDERS:
        for file in (ROOT / folder).rglob("*.py"):
            there = package / file.relative_to(ROOT)
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, there)
    for place in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (place / "__init__.py").touch()
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add tutorials, pages of other folders, sources that pages name, and the reference."""
    linked = set()
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for place, name in FONTS.items():
        files.append(File.generated(config, f"assets/{place}", content=(fonts / name).read_bytes()))
    for name in TUTORIALS:
        for place, content in _tutorial(name).items():
            files.append(File.generated(config, place, content=content))
    for source, place in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=text))
        linked |= _sources(text, source)
    for file in list(files.documentation_pages()):
        if file.src_uri not in PAGES.values():
            linked |= _sources(file.content_string, f"docs/{file.src_uri}")
    for source in sorted(linked):
        text = (ROOT / source).read_text(encoding="utf-8")
        language = _LANGUAGE.get(Path(source).suffix, "text")
        fence = f"---\nsearch: {{exclude: true}}\n---\n\n# {source}\n\n````{language}\n{text}\n````\n"
        files.append(File.generated(config, _source_place(source), content=fence))
    for title, modules in REFERENCE.items():
        body = "\n".join(f"::: {module}\n" for module in modules)
        place = f"reference/{title.lower().replace(', ', '-').replace(' ', '-')}.md"
        files.append(File.generated(config, place, content=f"# {title}\n\n{body}"))
    return files


def _tell(line: str) -> None:
    """Line on the standard error: mkdocs keeps quiet for some minutes."""
    print(line, file=sys.stderr, flush=True)


def _tutorial(name: str) -> dict[str, str | bytes]:
    """Page and pictures of a tutorial, by their places in the site. It is executed once for each state of the code."""
    source = ROOT / "docs" / "tutorials" / f"{name}.py"
    code = [source, *(file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py")))]
    state = hashlib.sha256(b"".join(file.read_bytes() for file in code)).hexdigest()[:16]
    kept = ROOT / "out" / "site-tutorials" / f"{name}-{state}.ipynb"
    if not kept.exists():
        shutil.rmtree(kept.parent / name, ignore_errors=True)
        for old in kept.parent.glob(f"{name}-*.ipynb"):
            old.unlink()
        _tell(f"tutorial {name}: is run, rendering included (its outputs are kept until code or tutorial changes)")
        began = time.monotonic()
        nbformat.write(executed(source, kept.parent / name), kept)
        _tell(f"tutorial {name}: done after {time.monotonic() - began:.0f} s")
    naming = {"unique_key": name, "output_files_dir": f"{name}_files"}
    page, resources = MarkdownExporter().from_notebook_node(nbformat.read(kept, as_version=4), resources=naming)
    pictures = {f"tutorials/{file}": data for file, data in resources["outputs"].items()}
    sample = kept.parent / name / "sample.html"
    if sample.is_file():
        pictures[f"tutorials/{name}_files/sample.html"] = sample.read_bytes()
        page += f"\nThe sample's page as it comes out: [sample.html]({name}_files/sample.html).\n"
    page += f"\nThis page is the file `docs/tutorials/{name}.py`. To run it, with its outputs in a folder of yours:\n"
    page += f"\n    python docs/run_notebook.py docs/tutorials/{name}.py out/{name}\n"
    return {f"tutorials/{name}.md": page, **pictures}


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links towards the places that files have in the site."""
    place = page.file.src_uri
    source = next((name for name, there in PAGES.items() if there == place), f"docs/{place}")

    def turned(link: re.Match[str]) -> str:
        target = _repository_path(link[2], source)
        if target is None:
            return link[0]
        there = posixpath.relpath(_place(target), posixpath.dirname(place) or ".")
        return f"{link[1]}{there}{link[3] or ''}{link[4]}"

    return _LINK.sub(turned, markdown)


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Turn LaTeX, marked by the extension `arithmatex`, into MathML."""

    def formula(found: re.Match[str]) -> str:
        is_block = found[1] == "div"
        latex = html.unescape(found[2]).strip()[2:-2]
        latex, _, number = latex.partition(r"\tag{")
        drawn = convert(latex.strip(), display="block" if is_block else "inline")
        drawn = _FUNCTION.sub(r'<mspace width="0.17em"/>\1', drawn)
        if "\\" in drawn:  # a command that the converter does not know stays as it was written
            _LOG.warning("%s: formula is not understood: %s", page.file.src_uri, latex)
        label = f'<span class="number">({number.rstrip().rstrip("}")})</span>' if number else ""
        return f'<div class="formula">{drawn}{label}</div>' if is_block else drawn

    return _FORMULA.sub(formula, content)


def _place(target: str) -> str:
    """Place in the site of a file of the repository."""
    if target in PAGES:
        return PAGES[target]
    if target.startswith("docs/tutorials/"):
        return f"tutorials/{Path(target).stem}.md"
    if target.startswith("docs/") and Path(target).suffix not in (".py", ".json"):
        return target.removeprefix("docs/")
    return _source_place(target)


def _source_place(source: str) -> str:
    return f"source/{source}.md"


def _sources(text: str, page: str) -> set[str]:
    """Files, neither pages nor pictures, that a page links to."""
    targets = {_repository_path(link[2], page) for link in _LINK.finditer(text)}
    return {t for t in targets if t is not None and _place(t).startswith("source/")}


def _repository_path(link: str, page: str) -> str | None:
    """Path in the repository of a relative link; None for what leads elsewhere or is no file."""
    if "://" in link or link.startswith(("mailto:", "/")):
        return None
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    return path if (ROOT / path).is_file() else None
