"""A worker that finds one sample's certificate out of tolerance."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from phibench.datasets.build import spot_task
from phibench.datasets.build.tasks import BuildTask, Done, Failed
from phibench.datasets.build.tasks import perform as do
from phibench.render.optics.certificate import Certificate, certify

REFUSED = "random-000001"


def perform(task: BuildTask, out: Path, code: str | None = None) -> Done | Failed:
    """Do a task as a worker does; the chief rays of one sample are out of tolerance by a hundredth of a pixel."""
    if task.name != f"spot {REFUSED}":
        return do(task, out, code)
    with patch.object(spot_task, "certify", _off):
        return do(task, out, code)


def _off(*arguments: Any) -> Certificate:
    return replace(certify(*arguments), chief_difference_px=0.01, passed=False)
