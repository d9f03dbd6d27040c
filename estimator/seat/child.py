"""The process in which a method runs: ``python -m phibench.estimator.seat.child SOCKET MEMORY``.

It gets numbers of two open files, a reference and pairs, and answers with JSON. What the method prints goes elsewhere.
The fatal signals print Python's stack, and SIGUSR1 does so at any time: the parent reads the method's line from it.
"""

from __future__ import annotations

import faulthandler
import json
import os
import signal
import socket
import sys
import threading
import time
from typing import Any

from phibench.estimator.seat.address_space import limited, size_bytes
from phibench.estimator.seat.answer_text import answer_text, to_bytes
from phibench.estimator.seat.channel import Channel, ChannelError
from phibench.estimator.seat.errors import MethodError
from phibench.estimator.seat.loader import load, sentence_of
from phibench.estimator.seat.pair import Method
from phibench.estimator.seat.parcel import Parcel, SharedPages, unpack
from phibench.estimator.seat.reference import Reference

_READ_ONLY = "read-only"  # in numpy's words: "assignment destination is read-only", "output array is read-only"
_ORPHAN_SECONDS = 2.0


def main() -> None:
    """Load one method and answer pairs until the parent hangs up."""
    line, reader = (int(text) for text in sys.argv[1:])
    sys.argv[1:] = []
    channel, pages = Channel(socket.socket(fileno=line)), SharedPages(reader)
    faulthandler.enable(all_threads=False)
    faulthandler.register(signal.SIGUSR1, all_threads=False)
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    order = json.loads(channel.receive())
    reference = Reference(**order["reference"])
    try:
        method = load(reference)
    except MethodError as error:
        channel.send(to_bytes({"fault": str(error)}))
        return
    file = reference.place if reference.kind == "file" else ""
    limit = size_bytes() + int(order["memory_bytes"])
    channel.send(to_bytes({"fault": ""}))
    try:
        while True:
            parcel = unpack(channel.receive(), pages)
            channel.send(to_bytes(_reply(method, parcel, limit, file)))
    except ChannelError:
        return


def _reply(method: Method, parcel: Parcel, limit: int, file: str) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        with limited(limit):
            answer = method(parcel.pair)
        reply: dict[str, Any] = {"failure": "", "answer": answer_text(answer)}
    except MemoryError as error:
        reply = {"failure": "memory", "message": f"more memory than the limit: {sentence_of(error, file)}"}
    except BaseException as error:
        reply = _of_exception(error, file)
    reply["seconds"] = time.perf_counter() - start
    if not parcel.unchanged():
        return {**reply, "failure": "mutated", "message": "the method wrote into the pair's images: work on a copy"}
    return reply


def _of_exception(error: BaseException, file: str) -> dict[str, Any]:
    if isinstance(error, ValueError) and _READ_ONLY in str(error):
        advice = "the pair's images are read-only: work on a copy, such as pair.down.astype(float)"
        return {"failure": "mutated", "message": f"{sentence_of(error, file)}; {advice}"}
    return {"failure": "error", "message": sentence_of(error, file)}


def _end_with_parent(parent: int) -> None:
    """Leave when the parent has died: nobody else would end a method that hangs."""
    while os.getppid() == parent:
        time.sleep(_ORPHAN_SECONDS)
    os._exit(1)


if __name__ == "__main__":
    main()
