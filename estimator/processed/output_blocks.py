"""Blocks of a processed output: the raw pixels and codes that each depends on, so that products skip all the zeros.

An output of JPEG depends on the codes of its own block, and those on the raw pixels in and beside it: a sixteenth of a
window's, and of averaged chroma a quarter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from phibench.scenes.frames import Array


@dataclass(frozen=True)
class ByPixel:
    """The transpose of `ChainModel.linear`, shape (r, 3 p), in its compressed rows; `pixels` is each element's row."""

    values: Array
    pixels: NDArray[np.int64]
    codes: NDArray[np.int64]
    ends: NDArray[np.int64]
    count: int

    @classmethod
    def of(cls, linear: sparse.csr_array) -> ByPixel:
        """Transpose of a matrix."""
        turned = sparse.csr_array(linear.T)
        turned.sort_indices()
        pixels = np.repeat(np.arange(turned.shape[0]), np.diff(turned.indptr))
        return cls(turned.data, pixels, turned.indices, turned.indptr, turned.shape[1])

    def spread(self, regression: Array, sigma_e: Array) -> Array:
        """Elements of the way from noise of variance 1 of the raw pixels to the codes."""
        return np.asarray(regression[self.codes] * self.values * sigma_e[self.pixels])

    def support(self, codes: NDArray[np.int64]) -> Support:
        """Part that leads to some codes."""
        number = np.full(max(self.count, int(codes.max()) + 1), -1)  # changes of Y' have no elements
        number[codes] = np.arange(len(codes))
        elements = np.flatnonzero(number[self.codes] >= 0)
        pixels, counts = np.unique(self.pixels[elements], return_counts=True)
        return Support(codes, pixels, elements, number[self.codes[elements]], np.concatenate([[0], np.cumsum(counts)]))


@dataclass(frozen=True)
class Support:
    """Codes and raw pixels of one block; `elements` of `ByPixel`, as compressed rows of these pixels and codes."""

    codes: NDArray[np.int64]
    pixels: NDArray[np.int64]
    elements: NDArray[np.int64]
    columns: NDArray[np.int64]
    ends: NDArray[np.int64]

    def matrix(self, spread: Array) -> sparse.csr_array:
        """Matrix from the block's codes to its pixels, of `ByPixel.spread`."""
        shape = len(self.pixels), len(self.codes)
        return sparse.csr_array((spread[self.elements], self.columns, self.ends), shape=shape)


@dataclass(frozen=True)
class Part:
    """Outputs of one block: its number, codes, columns among the outputs, and the transform between them."""

    number: int
    codes: NDArray[np.int64]
    columns: NDArray[np.int64]
    matrix: Array
