"""What the tests of sealed sets and of submissions share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phibench.benchmark.sealed.submission import unseal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.checksums import checksums_text, read_checksums
from phibench.datasets.store.files import sha256

METHOD = """\
import numpy as np
from phibench.estimator.interface import Answer, Spot

def extract(pair):  # brightest pixel: deterministic, and of this pair; pair 1 fails
    if pair.number == 1:
        raise ValueError("no spot")
    image = pair.down if pair.down.ndim == 2 else pair.down[..., 0]
    v, u = np.unravel_index(int(image.argmax()), image.shape)
    found = Spot((float(u), float(v)), ((0.1, 0.01), (0.01, 0.2)), 0.5, "normal")
    return Answer(found, Spot.missing("not looked for"), 2.0)
"""


SECRET_SEED = 506190453285116840605544309743580276109
"""Of 128 bits above 2^128, as a set that is sealed must have; drawn once."""


def with_secret_seed(folder: Path, out: Path) -> Path:
    """Copy of a data set whose frames are drawn from a secret seed; the layers are those of the old one."""
    shutil.copytree(folder, out)
    document = json.loads((out / "dataset.json").read_text())
    document["recipe"]["dataset"]["seed"] = SECRET_SEED
    (out / "dataset.json").write_text(json.dumps(document, indent=1) + "\n")
    listed = {**read_checksums(out), "dataset.json": sha256(out / "dataset.json")}
    (out / "SHA256SUMS").write_text(checksums_text(listed))
    return out


def tampered(change: Callable[[dict[str, Any]], Any], path: Path, out: Path) -> Path:
    document = json.loads(path.read_text())
    change(document)
    out.write_text(json.dumps(document, sort_keys=True, separators=(",", ":")) + "\n")
    return out


def refusal(public: Path, truth: Path, submission: Path) -> str:
    with pytest.raises(DatasetError) as caught:
        unseal(public, truth, submission)
    message = str(caught.value)
    assert "\n" not in message
    return message
