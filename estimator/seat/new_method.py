"""A file to begin with: the example method of `estimator.seat.example`, word for word."""

from __future__ import annotations

from pathlib import Path

from phibench.datasets.files import write_text
from phibench.estimator.seat.errors import MethodError

_EXAMPLE = Path(__file__).with_name("example.py")


def new_method(path: Path) -> Path:
    """Write the example to a file that is not there yet.

    Raises
    ------
    MethodError
        If the name does not end in .py, or there is something of that name.
    """
    if path.suffix != ".py":
        raise MethodError(f"{path}: the file of a method must end in .py, such as my_phi.py")
    if path.exists():
        raise MethodError(f"{path} is there already and is not overwritten: give another name or remove it")
    return write_text(path, _EXAMPLE.read_text(encoding="utf-8").replace("my_phi.py", path.name))
