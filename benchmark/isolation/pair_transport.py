"""Transport of pairs and answers between runner and a method's process: messages by socket, images in shared memory.

Messages go over a socket: 8 bytes of length (big-endian), then so many bytes, with a deadline. Images go through
shared memory, the rest of a pair in a short message with a nonce, which the reply repeats.

Four frames of 1280 x 720 x 3 bytes, 11 MB, take 14 ms this way, private copy and comparison included. As a pickle
through a socket they take 85 ms (`tests/benchmark_timings/test_sandbox_timing.py`). A short message fits into the
socket's buffer, so that a process that no longer reads cannot hold the runner up. The method's process takes a private
copy, because a method may keep an image after its pair.

On Linux the memory is sealed: the method's process can neither cut it short, which would kill the runner with SIGBUS,
nor write to it.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import pickle
import select
import socket
import struct
import sys
import tempfile
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.interface import Image, Pair

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

    def receive(self, seconds: float | None = None, most: int = LARGEST) -> bytes:
        """Wait for a message of `most` bytes or less; raises as `send`."""
        end = None if seconds is None else time.monotonic() + seconds
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size, end))
        if length > most:
            raise TransportError(f"message of {length} bytes exceeds the limit of {most}")
        return self._exactly(length, end)

    def is_silent(self) -> bool:
        """Tell that the other side is there and has said nothing since the last message."""
        events = select.poll()
        events.register(self._socket, select.POLLIN)
        return not events.poll(0)

    def hang_up(self) -> None:
        """Tell the other side that it is over; a thread that waits for a message is woken."""
        with contextlib.suppress(OSError):  # it is over already
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close this end."""
        self._socket.close()

    def _exactly(self, count: int, end: float | None) -> bytes:
        parts, missing = [], count
        while missing:
            # 0 would mean not to wait
            self._socket.settimeout(None if end is None else max(end - time.monotonic(), 1e-6))
            try:
                data = self._socket.recv(missing)
            except TimeoutError:
                raise
            except OSError as error:
                raise TransportError(str(error)) from error
            if not data:
                raise TransportError("the other side is gone")
            parts.append(data)
            missing -= len(data)
        return b"".join(parts)


_ALIGNED = 64  # bytes of a cache line; any type of pixel may begin there
AnyPair = Pair | DensePair
_FRAMES_OF = "frames of "  # before an image's name: its single frames
_IN_MEMORY = Path("/dev/shm")
LEAST_BYTES = 1 << 26
"""Memory for a pair, as address space: pages that nothing is written to take none."""
_SEALS = 0x1 | 0x2 | 0x4 | 0x10  # F_SEAL_SEAL, SHRINK, GROW, FUTURE_WRITE (Linux 5.1) of linux/fcntl.h
_OLD_SEALS = 0x1 | 0x2 | 0x4  # for a system without the last one


class MemoryFile:
    """A nameless file in memory: the runner writes it, the method's process has it open for reading.

    On Linux it is a memfd, sealed once it is mapped: its size stays, and nobody else can map it for writing.

    Parameters
    ----------
    size : int
        Bytes.
    """

    def __init__(self, size: int = LEAST_BYTES) -> None:
        self.size = size
        self._handle, self.reader = _memory_handles(size)
        self._space = mmap.mmap(self._handle, size)
        if sys.platform == "linux" and hasattr(fcntl, "F_ADD_SEALS"):
            with contextlib.suppress(OSError):  # a file in /dev/shm cannot be sealed
                _seal(self._handle)

    def write(self, parts: list[memoryview]) -> list[int]:
        """Write parts one after the other; where each begins, and where the last ends."""
        starts = np.cumsum([0] + [aligned_bytes(view.nbytes) for view in parts]).tolist()
        for view, start in zip(parts, starts, strict=False):
            self._space[start : start + view.nbytes] = view
        return list(starts)

    def close(self) -> None:
        """Give the memory back."""
        self._space.close()
        os.close(self._handle)
        os.close(self.reader)


def _memory_handles(size: int) -> tuple[int, int]:
    """File for reading and writing, and the same for reading alone."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("phibench-pair", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(handle, size)
        return handle, os.open(f"/proc/self/fd/{handle}", os.O_RDONLY)
    folder = _IN_MEMORY if os.access(_IN_MEMORY, os.W_OK) else None
    handle, name = tempfile.mkstemp(prefix="phibench-pair-", dir=folder)
    reader = os.open(name, os.O_RDONLY)
    # both processes hold it open: without a name it is gone with the last of them, even after a crash
    Path(name).unlink()
    os.ftruncate(handle, size)
    return handle, reader


def _seal(handle: int) -> None:
    try:
        fcntl.fcntl(handle, fcntl.F_ADD_SEALS, _SEALS)
    except OSError:  # Linux before 5.1
        fcntl.fcntl(handle, fcntl.F_ADD_SEALS, _OLD_SEALS)


def aligned_bytes(count: int) -> int:
    """Bytes that a part takes in the memory, at least."""
    return -(-max(count, 1) // _ALIGNED) * _ALIGNED


def needed_bytes(pair: AnyPair) -> int:
    """Memory that the images of a pair take."""
    return sum(aligned_bytes(image.nbytes) for image in _arrays(pair).values())


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
            # no more than a pair takes: mapped memory counts against the method's limit
            self._pages = mmap.mmap(self._reader, size, prot=mmap.PROT_READ)
        return self._pages


@dataclass(frozen=True)
class ReceivedPair:
    """A pair as a method's process has it.

    Attributes
    ----------
    pair : Pair or DensePair
        Its images lie in immutable memory of this process.
    data : bytes
        That memory.
    original : mmap.mmap
        The parent's, read-only.
    nonce : str
        Of the question; the reply repeats it.
    method : int
        Which of the process's methods is asked.
    """

    pair: AnyPair
    data: bytes
    original: mmap.mmap
    nonce: str = ""
    method: int = 0

    def unchanged(self) -> bool:
        """Compare the images with what the runner sent, byte for byte."""
        count = len(self.data) // 8  # whole words are compared faster; the size is a multiple of `_ALIGNED`
        here, there = (np.frombuffer(x, np.uint64, count) for x in (self.data, self.original))
        return bool(np.array_equal(here, there))


def _arrays(pair: AnyPair) -> dict[str, Image]:
    """Images of a pair by name, and the single frames behind them where there are several."""
    return {**pair.images, **{_FRAMES_OF + name: stack for name, stack in (pair.frames or {}).items()}}


def pack(pair: AnyPair, memory: MemoryFile, nonce: str = "", method: int = 0) -> bytes:
    """Images into the memory file, all else into the message; nothing but the fields of the pair's kind goes along."""
    kind = DensePair if isinstance(pair, DensePair) else Pair
    plain: Any = kind(**{field.name: getattr(pair, field.name) for field in fields(kind)})
    images = {name: np.ascontiguousarray(image) for name, image in _arrays(plain).items()}
    views = [image.data.cast("B") for image in images.values()]
    layout = [(name, image.dtype.str, image.shape) for name, image in images.items()]
    nothing: dict[str, Any] = dict.fromkeys((*kind.IMAGE_NAMES, "frames"))
    rest = replace(plain, **nothing)
    return pickle.dumps((rest, layout, memory.write(views), nonce, method), protocol=5)


def repeat_message(nonce: str, method: int) -> bytes:
    """Message that asks another method of the same process for the pair that it got last."""
    return pickle.dumps((nonce, method), protocol=5)


def unpack(message: bytes, shared: SharedPages, held: ReceivedPair | None = None) -> ReceivedPair:
    """Pair of a message, with images that cannot be written to; of `repeat_message` the one that is held."""
    parts = pickle.loads(message)
    if held is not None and len(parts) == 2:
        return replace(held, nonce=parts[0], method=parts[1])
    rest, layout, starts, nonce, method = parts
    original = shared.first(starts[-1])
    data = original[: starts[-1]]
    images = {
        name: np.frombuffer(data, dtype, int(np.prod(shape)), start).reshape(shape)
        for (name, dtype, shape), start in zip(layout, starts, strict=False)
    }
    frames = {name.removeprefix(_FRAMES_OF): images.pop(name) for name in tuple(images) if name.startswith(_FRAMES_OF)}
    pair = replace(rest, **images, frames=MappingProxyType(frames) if frames else None)
    return ReceivedPair(pair, data, original, nonce, method)
