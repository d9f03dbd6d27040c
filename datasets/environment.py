"""What renders: versions, variant, LLVM, asked of the processes that will do the work."""

from __future__ import annotations

import json
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

from phibench.datasets.cluster import Workers
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_text
from phibench.datasets.provenance import code_sha256, provenance
from phibench.datasets.task import fault_text, worker_name
from phibench.datasets.view_task import start_renderer

Environment = dict[str, Any]
_UNLIKE = ("commit",)  # may differ between two equal runs
_IN_KEYS = ("numpy", "scipy", "mitsuba", "drjit", "OpenEXR", "pillow")


def local_environment() -> Environment:
    """Environment of a fresh process on this machine.

    Raises
    ------
    DatasetError
        If Mitsuba cannot be used.
    """
    command = [sys.executable, "-m", "phibench.datasets.environment"]
    child = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if child.returncode != 0:
        last = (child.stderr.strip().splitlines() or [f"exit status {child.returncode}"])[-1]
        raise DatasetError(f"Mitsuba does not start on this machine ({last}); ask `phibench doctor`")
    return _checked({"this machine": json.loads(child.stdout.splitlines()[-1])})


def remote_environment(workers: Workers, out: Path) -> Environment:
    """Environment of all workers of a scheduler, which must be one and the same.

    Raises
    ------
        DatasetError If a worker lacks phibench or Mitsuba, has other versions than the rest, other code than this
        process, more than one thread, or does not see the folder.
    """
    if threaded := [name for name, count in workers.client.nthreads().items() if count != 1]:
        raise DatasetError(f"worker {threaded[0]} has more than one thread; start workers with --nthreads 1")
    probe = write_text(out.resolve() / f".phibench-tmp-{uuid.uuid4().hex}", "probe")
    try:
        return _checked(workers.client.run(describe, probe, on_error="return"))
    finally:
        probe.unlink(missing_ok=True)


def versions(environment: Environment) -> Environment:
    """What of an environment enters the keys of tasks."""
    packages = {name: environment["packages"][name] for name in _IN_KEYS}
    kept = {key: environment[key] for key in ("python", "machine", "variant", "llvm", "threads_per_process")}
    return {**kept, "packages": packages}


def describe(probe: Path | None = None) -> Environment:
    """Environment of this process; ``{"fault": ...}`` where it cannot render or does not see `probe`."""
    if probe is not None and not probe.is_file():
        return {"fault": f"it does not see the folder {probe.parent}: use one that all machines share"}
    try:
        rendering = start_renderer()
    except Exception as error:
        return {"fault": fault_text(error)}
    return {
        **{key: value for key, value in provenance().items() if key not in _UNLIKE},
        **rendering,
        "worker": worker_name(),
    }


def _checked(found: dict[str, Any]) -> Environment:
    """Return the one environment of all."""
    for name, environment in found.items():
        if isinstance(environment, ModuleNotFoundError):
            raise DatasetError(f"worker {name} has no {environment.name}: install phibench[render,cluster] there")
        if isinstance(environment, BaseException):
            raise DatasetError(f"worker {name} failed: {environment}")
        if "fault" in environment:
            raise DatasetError(f"{name} cannot render: {environment['fault']}")
        if environment["code_sha256"] != code_sha256():
            raise DatasetError(f"worker {name} runs other code than this process: install the same version on both")
    bare = {name: {k: v for k, v in e.items() if k != "worker"} for name, e in found.items()}
    first = next(iter(bare))
    for name, environment in bare.items():
        if environment != bare[first]:
            unlike = [key for key in environment if environment[key] != bare[first].get(key)]
            raise DatasetError(f"workers {first} and {name} differ in {', '.join(unlike)}: their images would too")
    return bare[first]


if __name__ == "__main__":
    print(json.dumps(describe()))
