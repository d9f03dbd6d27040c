"""What a method's process is given of the machine: a short environment, in which no data set's path stands."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from phibench.datasets.one_thread import ONE_THREAD

_KEPT = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|LANG|LC_\w+|TZ|VIRTUAL_ENV|PYTHONHOME|LD_LIBRARY_PATH|DYLD_LIBRARY_PATH|XDG_CACHE_HOME"
    r"|(OMP|MKL|OPENBLAS|NUMBA|CUDA|NVIDIA|TORCH|TF|JAX|XLA)_\w+"
)


def environment(folder: str, inherited: Mapping[str, str]) -> dict[str, str]:
    """Environment of a method's process: names that libraries need, and a folder of its own for temporary files.

    Parameters
    ----------
    folder : str
        The working directory.
    inherited : mapping
        The parent's environment.
    """
    kept = {name: value for name, value in inherited.items() if _KEPT.fullmatch(name)}
    paths = [str(Path(part).absolute()) for part in inherited.get("PYTHONPATH", "").split(os.pathsep) if part]
    if paths:
        kept["PYTHONPATH"] = os.pathsep.join(paths)
    return {**ONE_THREAD, **kept, "PWD": folder, "TMPDIR": folder, "PYTHONDONTWRITEBYTECODE": "1"}
