"""The rigs of a data set: `rigs.jsonl`, one line each, rebuilt when they are asked for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from phibench.datasets import layout
from phibench.datasets.codec import from_json, to_json
from phibench.datasets.errors import DatasetError
from phibench.datasets.lines import read_rows
from phibench.datasets.schema import RigInfo
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class Rigs:
    """Rigs by id, as JSON documents: a large data set has as many as samples, and few are looked at."""

    documents: dict[str, dict[str, Any]]

    def __len__(self) -> int:
        return len(self.documents)

    def __getitem__(self, name: str) -> Rig:
        if name not in self.documents:
            raise DatasetError(f"{layout.RIGS} has no rig '{name}'; {nearest(name, list(self.documents)[:20])}")
        if name not in self._built:
            self._built[name] = from_json(Rig, self.documents[name])
        return self._built[name]

    @cached_property
    def _built(self) -> dict[str, Rig]:
        return {}


def rigs_text(rigs: Mapping[str, Rig]) -> str:
    """Text of `rigs.jsonl`; doubles are written so that reading gives the same bits."""
    lines = (json.dumps({"rig": name, "resolved": to_json(rig)}, allow_nan=False) for name, rig in rigs.items())
    return "".join(line + "\n" for line in lines)


def read_rigs(folder: Path) -> Rigs:
    """Rigs of a data set.

    Raises
    ------
    DatasetError
        If the file is missing, or with the number of the first line that is not a rig.
    """
    return Rigs({info.rig: info.resolved for info in read_rows(folder / layout.RIGS, RigInfo)})
