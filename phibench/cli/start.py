"""Commands `phibench start`, `demo`, `recipe ...`, `method ...`: first steps, shipped recipes, checks of methods."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from phibench.cli.options import DEFAULT_PRESET, LIMITS, START, Flag, Limits, Preset, methods, shipped

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


_MEANINGS = (
    "Jaccard index: found spots / (visible spots + false answers). Recall: share of the pairs with D within 0.5, 1, 2, "
    "5, 10, 20 %, averaged over these. In brackets: 95 % interval. A star: too few samples for one.",
    "",
)


def demo(*, out: Path = Path("phibench-demo")) -> int:
    """Score two built-in methods and an example on five pairs that are shipped; write one page. It needs no Mitsuba.

    Parameters
    ----------
    out
        Folder to write: pairs, example, scores, and report.html. An example that you have changed is scored again.
    """
    from phibench.benchmark.reports.bench import demo as run_demo
    from phibench.benchmark.reports.bench import open_in_browser
    from phibench.benchmark.reports.track_tables import track_tables
    from phibench.benchmark.scores.score_tables import method_lines, nothing_answered
    from phibench.datasets.common.shown_text import show_grid, table_console

    done = run_demo(out)
    console = table_console(False)
    for table in track_tables([one.document for one in done.scores], beside=False):
        show_grid(console, table)
    for line in (*_MEANINGS, *(line for one in done.scores for line in method_lines(one))):
        console.print(line, emoji=False, highlight=False, markup=False)
    print(f"The page: {done.page}{' is opened' if open_in_browser(done.page) else '; open it in a browser'}")
    print(f"Your method: change {done.example} and give the same command again")
    print(f"The best built-in fit, a second a pair: phibench score {done.pairs} --track find --method chain_fit")
    return int(nothing_answered(done.scores))


recipe = App(name="recipe", group=START, help="List and print the recipes that are shipped.")


@recipe.command(name="list")
def list_recipes() -> int:
    """List the shipped recipes: name, and what it renders."""
    from phibench.datasets.recipe.load import RECIPES

    for path in sorted(RECIPES.glob("*.toml")):
        print(f"{path.stem:24}{_first_sentence(path.read_text(encoding='utf-8'))}")
    return 0


@recipe.command
def show(name: Annotated[str, Parameter(completer=shipped)]) -> int:
    """Print a shipped recipe, to be changed and rendered.

    Parameters
    ----------
    name
        Name as `phibench recipe list` shows it.
    """
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.recipe.load import RECIPES
    from phibench.scenes.validation import nearest

    known = {path.stem: path for path in RECIPES.glob("*.toml")}
    if name not in known:
        raise DatasetError(f"no recipe '{name}' is shipped; {nearest(name, sorted(known))}")
    print(known[name].read_text(encoding="utf-8"), end="")
    return 0


def _first_sentence(text: str) -> str:
    """First sentence of the comment that a recipe begins with, up to a colon."""
    lines = (line.removeprefix("#").strip() for line in text.split("\n\n")[0].splitlines() if line.startswith("#"))
    return " ".join(lines).split(". ")[0].split(": ")[0].rstrip(".")


method = App(name="method", group=START, help="Write, check and list methods, which find the spot in images.")


@method.command(name="list")
def list_methods() -> int:
    """List the methods: built in, optional, and of installed packages."""
    from phibench.benchmark.isolation.method_references import installed_methods
    from phibench.datasets.common.shown_text import TextTable, show_grid, wide_console
    from phibench.estimator.methods.registry import KNOWN
    from phibench.estimator.spots.image_planes import KINDS

    rows = []
    for known in KNOWN.values():
        needs = [text for text, need in (("off frames", known.needs_off), ("boxes", known.needs_boxes)) if need]
        takes = " + ".join(["every image" if known.accepts == KINDS else ", ".join(known.accepts), *needs])
        origin = (known.package or "built in") + ("" if known.installed else ": not installed")
        rows.append((known.name, origin, takes, known.description))
    for point in installed_methods():  # a package that is not imported: what it takes is not known
        owner = point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"
        rows.append((point.name, owner, "", point.value))
    heads = ("method", "from", "takes", "what it does")
    show_grid(wide_console(120), TextTable("Methods", heads, tuple(rows), "lLLL"))
    print("your own: a file and a function in it, my_phi.py:extract; `phibench method new my_phi.py` writes one")
    return 0


@method.command
def check(
    reference: Annotated[str, Parameter(name="--method", completer=methods)],
    *,
    preset: Preset = DEFAULT_PRESET,
    limits: Limits = LIMITS,
    show_output: Flag = False,
) -> int:
    """Try a method on ten easy pairs and say what is wrong; exit code 1 if something is.

    Parameters
    ----------
    reference
        File and function, my_phi.py:extract, or a name that `phibench method list` shows.
    preset
        What the camera delivers: "mjpeg", "yuyv", "srgb8", "bayer-raw" or "mono-raw".
    show_output
        Also show what the method prints: the last 20 lines of every pair.
    """
    from phibench.benchmark.isolation.method_check import PAIRS, check_method
    from phibench.benchmark.isolation.method_references import resolve
    from phibench.datasets.common.progress import Steps, progress_console

    resolve(reference)  # one that is not there is told before anything begins
    with Steps(progress_console(), "easy pairs", PAIRS, announce=True) as steps:
        done = check_method(reference, preset, limits.of_run, told=steps.reach)
    sound = "nothing wrong on ten easy pairs (conventions only: no lamps, no faint spots)"
    for line in done.lines(reference, sound, show_output):
        print(line)
    return 0 if done.ok else 1


@method.command
def new(path: Path) -> int:
    """Write an example method that works, to begin with.

    Parameters
    ----------
    path
        Python file to write; one that is there is not touched.
    """
    from phibench.benchmark.isolation.method_references import write_example

    written = write_example(path)
    print(f"{written}: try it with `phibench method check {written}:extract`")
    return 0
