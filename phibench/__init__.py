"""Public interface of phibench: what a user's own program needs.

>>> import phibench
>>> dataset = phibench.open_dataset("out/paper")  # doctest: +SKIP
>>> phibench.score(dataset, "my_phi.py:extract", preset="bayer-raw")  # doctest: +SKIP

Names are imported when they are first used, so that ``import phibench`` loads nothing else. All other modules are
imported by their full names, ``from phibench.scenes.rig import Rig``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phibench.benchmark.isolation.easy_pairs import EasyPairs
    from phibench.benchmark.make_dataset import make
    from phibench.benchmark.scored_dataset import open_dataset
    from phibench.benchmark.scores.score import score
    from phibench.datasets.scene.scene_export import mitsuba_scene
    from phibench.datasets.training import PairDataset
    from phibench.estimator.geometry.phi import phi
    from phibench.estimator.geometry.triangulate import depth_exact
    from phibench.estimator.interface import Answer, Pair, Spot
    from phibench.estimator.spots.simple_spots import find_spot

    __version__: str

__all__ = [
    "Answer",
    "EasyPairs",
    "Pair",
    "PairDataset",
    "Spot",
    "__version__",
    "depth_exact",
    "find_spot",
    "make",
    "mitsuba_scene",
    "open_dataset",
    "phi",
    "score",
]

_HOMES = {
    "Answer": "phibench.estimator.interface",
    "EasyPairs": "phibench.benchmark.isolation.easy_pairs",
    "Pair": "phibench.estimator.interface",
    "PairDataset": "phibench.datasets.training",
    "Spot": "phibench.estimator.interface",
    "depth_exact": "phibench.estimator.geometry.triangulate",
    "find_spot": "phibench.estimator.spots.simple_spots",
    "make": "phibench.benchmark.make_dataset",
    "mitsuba_scene": "phibench.datasets.scene.scene_export",
    "open_dataset": "phibench.benchmark.scored_dataset",
    "phi": "phibench.estimator.geometry.phi",
    "score": "phibench.benchmark.scores.score",
}


def __getattr__(name: str) -> Any:
    """Import a public name on its first use."""
    if name in _HOMES:
        value: Any = getattr(import_module(_HOMES[name]), name)
    elif name == "__version__":
        value = import_module("phibench.datasets.store.provenance").own_version()
    else:
        raise AttributeError(f"module 'phibench' has no attribute '{name}'; it has {', '.join(__all__)}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
