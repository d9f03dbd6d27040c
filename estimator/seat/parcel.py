"""A pair on its way into the method's process: images through a shared file in memory, the rest as a short message.

Measured for four frames of 1280 x 720 x 3 (11 MB): 1.6 ms through shared memory, 36 ms as a pickle over a socket; and
a short message fits into the socket's buffer, so that a process that no longer reads cannot hold its parent up. The
method's process takes a private copy, because a method may keep an image after its pair.
"""

from __future__ import annotations

import mmap
import os
import pickle
import tempfile
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.estimator.seat.pair import Pair

_ALIGNED = 64  # bytes
_IMAGES = ("down", "up", "down_off", "up_off")
_IN_MEMORY = Path("/dev/shm")


class MemoryFile:
    """A nameless file that both processes have open: the parent writes it, the method's process reads it."""

    def __init__(self) -> None:
        folder = _IN_MEMORY if os.access(_IN_MEMORY, os.W_OK) else None
        self._handle, name = tempfile.mkstemp(prefix="phibench-pair-", dir=folder)
        self.reader = os.open(name, os.O_RDONLY)
        Path(name).unlink()

    def write(self, parts: list[memoryview]) -> list[tuple[int, int]]:
        """Write parts one after the other; their (offset, size)."""
        sizes = [part.nbytes for part in parts]
        starts = np.cumsum([0] + [-(-size // _ALIGNED) * _ALIGNED for size in sizes]).tolist()
        os.ftruncate(self._handle, max(starts[-1], _ALIGNED))
        with mmap.mmap(self._handle, max(starts[-1], _ALIGNED)) as space:
            for part, start in zip(parts, starts, strict=False):
                space[start : start + part.nbytes] = part
        return list(zip(starts, sizes, strict=False))

    def close(self) -> None:
        """Give the memory back."""
        os.close(self._handle)
        os.close(self.reader)


@dataclass(frozen=True)
class Parcel:
    """What a method's process unpacked.

    Attributes
    ----------
    pair : Pair
        Its images lie in immutable memory of this process.
    data : bytes
        That memory.
    original : mmap.mmap
        The parent's, read-only.
    """

    pair: Pair
    data: bytes
    original: mmap.mmap

    def unchanged(self) -> bool:
        """Whether the images are what the parent sent, byte for byte; ends the loan of the parent's memory."""
        here, there = (np.frombuffer(x, np.uint64) for x in (self.data, self.original))
        same = bool(np.array_equal(here, there))
        del there
        self.original.close()
        return same


def pack(pair: Pair, memory: MemoryFile) -> bytes:
    """Images into the memory file, all else into the message; nothing but the fields of `Pair` goes along."""
    plain = Pair(**{field.name: getattr(pair, field.name) for field in fields(Pair)})
    images = {name: np.ascontiguousarray(image) for name, image in plain.images.items()}
    views = [image.data.cast("B") for image in images.values()]
    layout = [(name, image.dtype.str, image.shape) for name, image in images.items()]
    nothing: dict[str, Any] = dict.fromkeys(_IMAGES)
    rest = replace(plain, **nothing)
    return pickle.dumps((rest, layout, memory.write(views)), protocol=5)


def unpack(message: bytes, reader: int) -> Parcel:
    """Pair of a message, with images that cannot be written to."""
    rest, layout, places = pickle.loads(message)
    original = mmap.mmap(reader, 0, prot=mmap.PROT_READ)
    data = original[:]
    images = {
        name: np.frombuffer(data, dtype, int(np.prod(shape)), start).reshape(shape)
        for (name, dtype, shape), (start, _) in zip(layout, places, strict=True)
    }
    return Parcel(replace(rest, **images), data, original)
