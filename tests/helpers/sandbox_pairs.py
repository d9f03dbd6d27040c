"""Small pairs for the tests of the sandbox: images of a few pixels that say which pair they are, and a secret truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.interface import Box, Pair
from phibench.estimator.pair_set import PairTruth
from phibench.scenes.rig import Rig

SHAPE = (48, 64)
HEADER = "from phibench.estimator.interface import Answer, Spot\nimport numpy as np\n"
GOOD = "Answer(Spot((float(pair.down[0, 0]), 2.0)), Spot.missing('not looked for'))"


@dataclass(frozen=True)
class SmallPairs:
    """Pairs whose first pixel is their number + 100."""

    count: int = 4
    laser_off: bool = True

    def __len__(self) -> int:
        return self.count

    def pair(self, number: int) -> Pair:
        image = np.full(SHAPE, number + 100, np.uint16)
        off = np.full(SHAPE, 7, np.uint16) if self.laser_off else None
        boxes = (Box(1, 2, 30, 20), Box(3, 4, 30, 20))
        return Pair(number, image, image + 1, Rig(), 0.5, sensor_card("bayer-raw"), off, off, *boxes)

    def truth(self, number: int) -> PairTruth:
        return EasyPairs().truth(number)

    def document(self) -> dict[str, Any]:
        return {"name": "small"}


def method_file(folder: Path, body: str, name: str = "my_phi.py", header: str = HEADER) -> str:
    """Write ``extract`` with the indented lines of `body`; the reference to it."""
    lines = "\n".join(f"    {line}" for line in body.strip("\n").splitlines())
    (folder / name).write_text(f"{header}\n\ndef extract(pair):\n{lines}\n", encoding="utf-8")
    return f"{folder / name}:extract"
