"""`phibench methods`, `phibench check` and `phibench new-method`: what there is, what is wrong, and how to begin.

A file to begin with: the example method of `estimator.seat.example`, word for word.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

if TYPE_CHECKING:
    from rich.table import Table


_TABLE_WIDTH = 120
_EXAMPLE = Path(__file__).parents[1] / "sandbox" / "example_method.py"


def register(app: App) -> None:
    """Add the commands to an application."""
    app.command(methods)
    app.command(check)
    app.command(new_method, name="new-method")


def methods() -> int:
    """List the methods: built in, optional, and of installed packages."""
    from rich.console import Console

    console = Console()
    # as in `score`: a table cut off at the width of a pipe would lose words
    console = console if console.width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)
    console.print(_table())
    console.print(
        "your own: a file and a function in it, my_phi.py:extract; `phibench new-method my_phi.py` writes one"
    )
    return 0


def check(method: str, *, preset: str = "bayer-raw", seconds: float = 10.0, memory_mb: float = 4096.0) -> int:
    """Try a method on ten easy pairs and say what is wrong; exit code 1 if something is.

    Parameters
    ----------
    method
        File and function, my_phi.py:extract, or a name that `phibench methods` lists.
    preset
        What the camera delivers: "bayer-raw", "mono-raw", "srgb8" or "mjpeg".
    seconds
        Time limit of a pair.
    memory_mb
        Memory limit, on top of what the imports take.
    """
    from phibench.estimator.sandbox.check import check_method
    from phibench.estimator.sandbox.resolve import Limits

    done = check_method(method, preset, Limits(seconds, memory_mb))
    for note in done.notes:
        print(note)
    for fault in done.faults:
        print(f"wrong: {fault}")
    print(f"{method}: " + ("nothing wrong on ten easy pairs" if done.ok else f"{len(done.faults)} wrong"))
    return 0 if done.ok else 1


def new_method(path: Path) -> int:
    """Write an example method that works, to begin with.

    Parameters
    ----------
    path
        Python file to write; one that is there is not touched.
    """
    written = _write_example(path)
    print(f"{written}: try it with `phibench check {written}:extract`")
    return 0


def _table() -> Table:
    from rich.table import Table

    from phibench.estimator.methods.registry import KNOWN
    from phibench.estimator.sandbox.resolve import installed

    table = Table("method", "from", "takes", "what it does")
    for method in KNOWN.values():
        needs = [text for text, need in (("off frames", method.needs_off), ("boxes", method.needs_boxes)) if need]
        takes = " + ".join([_kinds(method.accepts), *needs])
        origin = "built in" if not method.package else method.package
        if method.installed:
            table.add_row(method.name, origin, takes, method.description)
        else:
            table.add_row(method.name, f"{origin}: not installed", takes, method.description, style="dim")
    for point in installed():
        owner = point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"
        table.add_row(point.name, owner, "", point.value)
    return table


def _kinds(accepts: tuple[str, ...]) -> str:
    from phibench.estimator.spots.image_planes import KINDS

    return "every image" if accepts == KINDS else ", ".join(accepts)


def _write_example(path: Path) -> Path:
    """Write the example to a file that is not there yet.

    Raises
    ------
    MethodError
        If the name does not end in .py, or there is something of that name.
    """
    from phibench.datasets.store.files import write_text
    from phibench.estimator.sandbox.resolve import MethodError

    if path.suffix != ".py":
        raise MethodError(f"{path}: the file of a method must end in .py, such as my_phi.py")
    if path.exists():
        raise MethodError(f"{path} is there already and is not overwritten: give another name or remove it")
    return write_text(path, _EXAMPLE.read_text(encoding="utf-8").replace("my_phi.py", path.name))
