"""Commands `phibench start`, `phibench demo` and `phibench recipe`: what a newcomer asks for first."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from phibench.cli.completions import recipes
from phibench.cli.options import START

_FIRST = (
    ("phibench demo", "five pairs, three methods, one page: what a score is"),
    ("phibench recipe list", "the recipes that are shipped; `recipe show NAME` prints one"),
    ("phibench dataset make smoke --out out/smoke", "render a small data set: a minute, needs Mitsuba"),
    ("phibench method new my_phi.py", "a commented method that works: put your idea in"),
    ("phibench method check my_phi.py:extract", "ten easy pairs; says in plain words what is wrong"),
    ("phibench score out/smoke --method my_phi.py:extract --preset mjpeg --out mine.json", "an honest score"),
    ("phibench report mine.json --out report.html", "the score as a page, with the worst images"),
    ("phibench measure --down d.jpg --up u.jpg --stroke-m 0.425 --rig rig.toml", "D from two pictures of your own"),
)


def start() -> int:
    """Print the eight commands that a newcomer uses, in their order."""
    for command, meaning in _FIRST:
        print(f"{command}\n    {meaning}")
    return 0


def demo(*, out: Path = Path("phibench-demo")) -> int:
    """Score two built-in methods and an example on five pairs that are shipped; write one page. It needs no Mitsuba.

    Parameters
    ----------
    out
        Folder to write: pairs, example, scores, and report.html. An example that you have changed is scored again.
    """
    from phibench.benchmark.reports.bench import demo as run_demo
    from phibench.benchmark.reports.bench import show
    from phibench.benchmark.scores.score_tables import score_table, text_of

    done = run_demo(out)
    for one in done.scores:
        print(text_of(score_table(one.document)))
    print(f"{done.page}: {'opened' if show(done.page) else 'open it in a browser'}")
    print(f"change {done.example} and give the same command again; the pairs and their truth are {done.pairs}")
    return 0


recipe = App(name="recipe", group=START, help="List and print the recipes that are shipped.")


@recipe.command(name="list")
def list_() -> int:
    """List the shipped recipes: name, and what it renders."""
    from phibench.datasets.recipe.load import RECIPES

    for path in sorted(RECIPES.glob("*.toml")):
        print(f"{path.stem:24}{_first_sentence(path.read_text(encoding='utf-8'))}")
    return 0


@recipe.command
def show(name: Annotated[str, Parameter(completer=recipes(films=True))]) -> int:
    """Print a shipped recipe, to be changed and rendered.

    Parameters
    ----------
    name
        Name as `phibench recipe list` shows it.
    """
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.recipe.load import RECIPES

    known = {path.stem: path for path in RECIPES.glob("*.toml")}
    if name not in known:
        raise DatasetError(f"no recipe '{name}' is shipped; there are {', '.join(sorted(known))}")
    print(known[name].read_text(encoding="utf-8"), end="")
    return 0


def _first_sentence(text: str) -> str:
    """First sentence of the comment that a recipe begins with, up to a colon."""
    lines = (line.removeprefix("#").strip() for line in text.split("\n\n")[0].splitlines() if line.startswith("#"))
    return " ".join(lines).split(". ")[0].split(": ")[0].rstrip(".")
