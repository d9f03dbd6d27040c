"""Repeatable noise, drawn in tiles: a pixel's numbers depend on its place and on the names of frame and stage.

The image is cut into tiles of 32 x 32 pixels. The names of a stage give the key of a Philox generator, the tile's row
and column two words of its counter (J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11, 2011).
Changing the counter is cheap, and every tile has 2^64 draws of its own. Poisson draws, which use a variable number of
them, therefore disturb no other tile. A tile is drawn row by row from its first one, over its whole width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.sensor.light import Region
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, philox_key

TILE_PX = 32
Draw = Callable[[np.random.Generator, tuple[slice, slice]], NDArray[Any]]


@dataclass(frozen=True)
class NoiseStream:
    """A named source of noise, such as (data set, seed, sample, "down", "on", draw)."""

    names: tuple[Name, ...]

    def stage(self, *names: Name) -> NoiseStream:
        """Stream of one stage."""
        return NoiseStream((*self.names, *names))

    def generator(self) -> np.random.Generator:
        """Generator for what is drawn once per frame."""
        return np.random.Generator(np.random.Philox(key=philox_key(*self.names)))


def frame_stream(dataset: str, seed: int, sample: str, position: str, laser: bool, draw: int) -> NoiseStream:
    """Stream of one frame: every frame of a data set has its own, so that down and up, on and off are independent."""
    return NoiseStream((dataset, seed, sample, position, "on" if laser else "off", draw))


def whole_tiles(region: Region, size: tuple[int, int]) -> Region:
    """Smallest region of tiles around `region`, in an image of size (height, width).

    A tile is drawn row by row, so that the lowest tiles may end with the region: the rows before are the same.
    """
    tiles = region.grown(size, (TILE_PX, TILE_PX))
    return Region(tiles.u0_px, tiles.v0_px, tiles.u1_px, region.v1_px)


def poisson(stream: NoiseStream, mean: Array, region: Region) -> Array:
    """Poisson draws, shape (h, w); `mean` is that of `region`, which must be of whole tiles."""
    return _by_tiles(stream, region, lambda generator, part: generator.poisson(mean[part]))


def normal(stream: NoiseStream, region: Region) -> Array:
    """Standard normal draws, shape (h, w), on a region of whole tiles."""
    height, width = region.shape

    def draw(generator: np.random.Generator, part: tuple[slice, slice]) -> Array:
        v, u = part[0].start, part[1].start
        return generator.standard_normal((min(TILE_PX, height - v), min(TILE_PX, width - u)))

    return _by_tiles(stream, region, draw)


def row_normal(stream: NoiseStream, region: Region) -> Array:
    """Standard normal draws, one per row, shape (h, 1): the same in every column of the image."""
    column = Region(0, region.v0_px, 1, region.v1_px)
    return normal(stream, column)


def _by_tiles(stream: NoiseStream, region: Region, draw: Draw) -> Array:
    """Put together what `draw` gives for each tile of `region`."""
    bits = np.random.Philox(key=philox_key(*stream.names))
    generator = np.random.Generator(bits)
    state: Any = bits.state
    # plain integers: numpy reads them three times as fast as its own arrays' elements
    state["state"] = {name: words.tolist() for name, words in state["state"].items()}
    state["buffer"] = state["buffer"].tolist()
    result = np.empty(region.shape)
    height, width = region.shape
    for v in range(0, height, TILE_PX):
        for u in range(0, width, TILE_PX):
            # word 0 counts the tile's own draws
            state["state"]["counter"] = (0, (region.v0_px + v) // TILE_PX, (region.u0_px + u) // TILE_PX, 0)
            bits.state = state
            part = slice(v, v + TILE_PX), slice(u, u + TILE_PX)
            result[part] = draw(generator, part)
    return result
