"""Messages between a method's process and its parent: a length and so many bytes over a socket, with a deadline."""

from __future__ import annotations

import socket
import struct
import time

_LENGTH = struct.Struct("!Q")
LARGEST = 1 << 24  # bytes; images do not go this way


class ChannelError(Exception):
    """The other side is gone or does not keep to the protocol."""


class Channel:
    """One end of the line.

    Parameters
    ----------
    line : socket.socket
        Of a connected pair.
    """

    def __init__(self, line: socket.socket) -> None:
        self._line = line

    def send(self, message: bytes, seconds: float | None = None) -> None:
        """Send a message.

        Raises
        ------
        TimeoutError
            If the other side does not take it in so many seconds; None waits for ever.
        ChannelError
            If the other side is gone.
        """
        self._line.settimeout(seconds)
        try:
            self._line.sendall(_LENGTH.pack(len(message)) + message)
        except TimeoutError:
            raise
        except OSError as error:
            raise ChannelError(str(error)) from error

    def receive(self, seconds: float | None = None) -> bytes:
        """Wait for a message; raises as `send`."""
        end = None if seconds is None else time.monotonic() + seconds
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size, end))
        if length > LARGEST:
            raise ChannelError("a message that is none")
        return self._exactly(length, end)

    def close(self) -> None:
        """Close this end."""
        self._line.close()

    def _exactly(self, count: int, end: float | None) -> bytes:
        parts, missing = [], count
        while missing:
            self._line.settimeout(None if end is None else max(end - time.monotonic(), 1e-6))
            try:
                part = self._line.recv(missing)
            except TimeoutError:
                raise
            except OSError as error:
                raise ChannelError(str(error)) from error
            if not part:
                raise ChannelError("the other side is gone")
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)
