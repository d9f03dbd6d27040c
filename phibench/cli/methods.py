"""Commands `phibench method ...`: write a method, check it on easy pairs, list those that there are."""

from __future__ import annotations

from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from phibench.cli.completions import methods
from phibench.cli.options import DEFAULT_PRESET, LIMITS, START, Limits, Preset, wide_console

if TYPE_CHECKING:
    from rich.table import Table


_TABLE_WIDTH = 120  # where the output is no terminal


method = App(
    name="method",
    group=START,
    help="Write, check and list methods, which find the spot in images.",
)


@method.command(name="list")
def list_() -> int:
    """List the methods: built in, optional, and of installed packages."""
    console = wide_console(_TABLE_WIDTH)
    console.print(_table())
    console.print(
        "your own: a file and a function in it, my_phi.py:extract; `phibench method new my_phi.py` writes one"
    )
    return 0


@method.command
def check(
    reference: Annotated[str, Parameter(name="--method", completer=methods)],
    *,
    preset: Preset = DEFAULT_PRESET,
    limits: Limits = LIMITS,
    show_output: Annotated[bool, Parameter(negative="")] = False,
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
    from phibench.benchmark.isolation.check import PAIRS, check_method
    from phibench.benchmark.isolation.resolve import resolve
    from phibench.datasets.common.progress import Steps, progress_console

    resolve(reference)  # one that is not there is told before anything begins
    with Steps(progress_console(), "easy pairs", PAIRS, announce=True) as steps:
        done = check_method(reference, preset, limits.of_run, told=steps.reach)
    for number, text in done.printed if show_output else ():
        print(f"printed for pair {number}:\n{indent(text, '    ')}")
    if done.printed and not show_output:
        print("the method prints something: --show-output shows it")
    for note in done.notes:
        print(note)
    for fault in done.faults:
        print(f"wrong: {fault}")
    sound = "nothing wrong on ten easy pairs (conventions only: no lamps, no faint spots)"
    print(f"{reference}: {sound if done.ok else f'{len(done.faults)} wrong'}")
    return 0 if done.ok else 1


@method.command
def new(path: Path) -> int:
    """Write an example method that works, to begin with.

    Parameters
    ----------
    path
        Python file to write; one that is there is not touched.
    """
    from phibench.benchmark.isolation.resolve import write_example

    written = write_example(path)
    print(f"{written}: try it with `phibench method check {written}:extract`")
    return 0


def _table() -> Table:
    from rich.table import Table

    from phibench.benchmark.isolation.resolve import installed
    from phibench.estimator.methods.registry import KNOWN

    table = Table("method", "from", "takes", "what it does")
    for method in KNOWN.values():
        needs = [text for text, need in (("off frames", method.needs_off), ("boxes", method.needs_boxes)) if need]
        takes = " + ".join([_kinds(method.accepts), *needs])
        origin = "built in" if not method.package else method.package
        if method.installed:
            table.add_row(method.name, origin, takes, method.description)
        else:
            table.add_row(method.name, f"{origin}: not installed", takes, method.description, style="dim")
    for point in installed():  # a package that is not imported: what it takes is not known
        owner = point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"
        table.add_row(point.name, owner, "", point.value)
    return table


def _kinds(accepts: tuple[str, ...]) -> str:
    from phibench.estimator.spots.image_planes import KINDS

    return "every image" if accepts == KINDS else ", ".join(accepts)
