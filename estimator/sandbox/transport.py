"""Transport of pairs and answers between the runner and a method's process.

Messages go over a socket: 8 bytes of length (big-endian), then so many bytes, with a deadline. Images go through a
shared file in memory, the rest of a pair in a short message.

Four frames of 1280 x 720 x 3 bytes, 11 MB, take 14 ms this way, private copy and comparison included. As a pickle
through a socket they take 85 ms (`tests/benchmark_timings/test_sandbox_timing.py`). A short message fits into the
socket's buffer, so that a process that no longer reads cannot hold the runner up. The method's process takes a private
copy, because a method may keep an image after its pair.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import struct
import tempfile
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.estimator.interface import Pair

_LENGTH = struct.Struct("!Q")
LARGEST = 1 << 24  # bytes; images do not go this way


class TransportError(Exception):
    """The other side is gone or does not keep to the protocol."""


class Connection:
    """One end of a socket pair.

    Parameters
    ----------
    end : socket.socket
        Of a connected pair.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    def send(self, message: bytes, seconds: float | None = None) -> None:
        """Send a message.

        Raises
        ------
        TimeoutError
            If the other side does not take it in so many seconds; None waits for ever.
        TransportError
            If the other side is gone.
        """
        self._socket.settimeout(seconds)
        try:
            self._socket.sendall(_LENGTH.pack(len(message)) + message)
        except TimeoutError:
            raise
        except OSError as error:
            raise TransportError(str(error)) from error

    def receive(self, seconds: float | None = None) -> bytes:
        """Wait for a message; raises as `send`."""
        end = None if seconds is None else time.monotonic() + seconds
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size, end))
        if length > LARGEST:
            raise TransportError(f"message of {length} bytes exceeds the limit of {LARGEST}")
        return self._exactly(length, end)

    def close(self) -> None:
        """Close this end."""
        self._socket.close()

    def _exactly(self, count: int, end: float | None) -> bytes:
        parts, missing = [], count
        while missing:
            self._socket.settimeout(None if end is None else max(end - time.monotonic(), 1e-6))
            try:
                part = self._socket.recv(missing)
            except TimeoutError:
                raise
            except OSError as error:
                raise TransportError(str(error)) from error
            if not part:
                raise TransportError("the other side is gone")
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)


_ALIGNED = 64  # bytes of a cache line; any type of pixel may begin there
_IMAGES = ("down", "up", "down_off", "up_off")
_IN_MEMORY = Path("/dev/shm")


class MemoryFile:
    """A nameless file that both processes have open: the parent writes it, the method's process reads it."""

    def __init__(self) -> None:
        folder = _IN_MEMORY if os.access(_IN_MEMORY, os.W_OK) else None
        self._handle, name = tempfile.mkstemp(prefix="phibench-pair-", dir=folder)
        self.reader = os.open(name, os.O_RDONLY)
        # both processes hold it open: without a name it is gone with the last of them, even after a crash
        Path(name).unlink()
        self._space: mmap.mmap | None = None

    def write(self, parts: list[memoryview]) -> list[int]:
        """Write parts one after the other; where each begins, and where the last ends."""
        starts = np.cumsum([0] + [-(-part.nbytes // _ALIGNED) * _ALIGNED for part in parts]).tolist()
        space = self._at_least(max(starts[-1], _ALIGNED))
        for part, start in zip(parts, starts, strict=False):
            space[start : start + part.nbytes] = part
        return list(starts)

    def _at_least(self, size: int) -> mmap.mmap:
        """Mapped memory, kept from pair to pair: new pages cost more than the copy."""
        if self._space is None or len(self._space) < size:
            os.ftruncate(self._handle, size)
            self._space = mmap.mmap(self._handle, size)
        return self._space

    def close(self) -> None:
        """Give the memory back."""
        if self._space is not None:
            self._space.close()
        os.close(self._handle)
        os.close(self.reader)


class SharedPages:
    """The memory file as the method's process sees it: read-only.

    Parameters
    ----------
    reader : int
        Open file.
    """

    def __init__(self, reader: int) -> None:
        self._reader = reader
        self._pages: mmap.mmap | None = None

    def first(self, size: int) -> mmap.mmap:
        """Pages that hold so many bytes, or more."""
        if self._pages is None or len(self._pages) < size:
            self._pages = mmap.mmap(self._reader, 0, prot=mmap.PROT_READ)
        return self._pages


@dataclass(frozen=True)
class ReceivedPair:
    """A pair as a method's process has it.

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
        """Compare the images with what the runner sent, byte for byte."""
        count = len(self.data) // 8  # whole words are compared faster; the size is a multiple of `_ALIGNED`
        here, there = (np.frombuffer(x, np.uint64, count) for x in (self.data, self.original))
        return bool(np.array_equal(here, there))


def pack(pair: Pair, memory: MemoryFile) -> bytes:
    """Images into the memory file, all else into the message; nothing but the fields of `Pair` goes along."""
    plain = Pair(**{field.name: getattr(pair, field.name) for field in fields(Pair)})
    images = {name: np.ascontiguousarray(image) for name, image in plain.images.items()}
    views = [image.data.cast("B") for image in images.values()]
    layout = [(name, image.dtype.str, image.shape) for name, image in images.items()]
    nothing: dict[str, Any] = dict.fromkeys(_IMAGES)
    rest = replace(plain, **nothing)
    return pickle.dumps((rest, layout, memory.write(views)), protocol=5)


def unpack(message: bytes, shared: SharedPages) -> ReceivedPair:
    """Pair of a message, with images that cannot be written to."""
    rest, layout, starts = pickle.loads(message)
    original = shared.first(starts[-1])
    data = original[: starts[-1]]
    images = {
        name: np.frombuffer(data, dtype, int(np.prod(shape)), start).reshape(shape)
        for (name, dtype, shape), start in zip(layout, starts, strict=False)
    }
    return ReceivedPair(replace(rest, **images), data, original)
