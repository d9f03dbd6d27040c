"""Table of the built-in methods for dense depth, by name. To add one, add an entry to `_ALL`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.dense.dense_interface import DenseAnswer, DenseMethod, DensePair
from phibench.estimator.dense.learned_sweep import dense_learned
from phibench.estimator.dense.panorama_matchers import (
    NEEDS_OPENCV,
    dense_flow,
    dense_sgbm,
    dense_sgbm_exact,
    dense_sift,
)
from phibench.estimator.dense.sweep import dense_stroke, dense_sweep
from phibench.estimator.spots.image_planes import KINDS, kind_of


@dataclass(frozen=True)
class DenseBuiltIn:
    """One built-in dense method; call it like any method.

    Parameters
    ----------
    description : str
        One line.
    source : str
        Where the idea comes from.
    accepts : tuple of str
        Kinds of images, of `image_planes.KINDS`.
    """

    name: str
    function: DenseMethod
    description: str
    source: str
    accepts: tuple[str, ...] = KINDS

    needs = NEEDS_OPENCV
    """Package to install where it is missing, in words."""

    @property
    def installed(self) -> bool:
        """OpenCV can be imported."""
        return find_spec("cv2") is not None

    def refusal(self, pair: DensePair) -> str:
        """Reason that this pair cannot be taken; "" if it can."""
        if not self.installed:
            return self.needs
        kind = kind_of(pair.card)
        return "" if kind in self.accepts else f"takes {', '.join(self.accepts)}, not {kind}"

    def __call__(self, pair: DensePair) -> DenseAnswer:
        """Answer for the pair.

        Raises
        ------
        DatasetError
            If this pair cannot be taken; in one sentence.
        """
        if why := self.refusal(pair):
            raise DatasetError(f"{self.name}: {why}")
        return self.function(pair)


_ALL = (
    DenseBuiltIn(
        "dense_sgbm",
        dense_sgbm,
        "semi-global block matching on panoramas, central model: the published way",
        "H. Hirschmueller, IEEE Trans. PAMI 30, 328 (2008); cv2.StereoSGBM",
    ),
    DenseBuiltIn(
        "dense_sgbm_exact",
        dense_sgbm_exact,
        "the same matches, D by the rig's own rays",
        "cv2.StereoSGBM; midpoint of both rays",
    ),
    DenseBuiltIn(
        "dense_flow",
        dense_flow,
        "dense flow between panoramas, D by the rig's own rays",
        "T. Kroeger and others, ECCV (2016); cv2.DISOpticalFlow",
    ),
    DenseBuiltIn(
        "dense_sift",
        dense_sift,
        "sparse features of both panoramas, D by the rig's own rays",
        "D. G. Lowe, Int. J. Computer Vision 60, 91 (2004); cv2.SIFT",
    ),
    DenseBuiltIn(
        "dense_sweep",
        dense_sweep,
        "sweep over inverse distance by the rig's own rays, then planes fitted to both images",
        "R. T. Collins, CVPR (1996); B. D. Lucas and T. Kanade, IJCAI (1981)",
    ),
    DenseBuiltIn(
        "dense_stroke",
        dense_stroke,
        "the same over all heights of a stroke, where a pair has them (dense score --between)",
        "M. Okutomi and T. Kanade, IEEE Trans. PAMI 15, 353 (1993)",
    ),
    DenseBuiltIn(
        "dense_learned",
        dense_learned,
        "dense_sweep, corrected by a small network of its costs; trained on 30 rooms of bench-dev",
        "docs/train_dense.py",
    ),
)

DENSE_METHODS: dict[str, DenseBuiltIn] = {method.name: method for method in _ALL}
"""All of them, also where OpenCV is missing: `refusal` says so."""

KNOWN = DENSE_METHODS
"""The name by which `benchmark.isolation.method_references` looks in every registry of methods."""
