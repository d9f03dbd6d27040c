"""Worker in a method's process: loads it from its file, limits memory, answers pairs (`reply_of`); failures in words.

`isolation.supervisor` starts the worker. It tells how it is isolated, gets a reference, imports the method, gets pairs,
and answers with JSON. Every reply repeats number and nonce of its pair. Standard output and error are the method's
alone.

The address space is limited while the method runs (RLIMIT_AS; kept by Linux). Fatal signals print Python's stack, and
SIGUSR1 prints it at any time: the runner reads the method's line from it.
"""

from __future__ import annotations

import errno
import faulthandler
import importlib
import importlib.util
import inspect
import json
import os
import re
import resource
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from phibench.benchmark.isolation.answers import answer_document, dense_answer_document, to_bytes
from phibench.benchmark.isolation.method_provenance import loaded_names
from phibench.benchmark.isolation.method_references import Reference
from phibench.benchmark.isolation.pair_transport import Connection, ReceivedPair, SharedPages, TransportError, unpack
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.interface import Method
from phibench.scenes.validation import close_names

if TYPE_CHECKING:
    from phibench.estimator.methods.spot_search import SharedWork

_STATM = Path("/proc/self/statm")


def size_bytes() -> int:
    """Address space in use; 0 where the system does not tell."""
    if not _STATM.is_file():
        return 0
    return int(_STATM.read_text().split()[0]) * resource.getpagesize()


@contextmanager
def memory_limit(limit_bytes: int) -> Iterator[None]:
    """Keep RLIMIT_AS at a limit; taken off afterwards, so that what went wrong can be told."""
    if not _STATM.is_file():
        yield
        return  # the size of a process is not known: no limit
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    lowest = min((x for x in (limit_bytes, soft, hard) if x != resource.RLIM_INFINITY), default=limit_bytes)
    resource.setrlimit(resource.RLIMIT_AS, (lowest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


_MODULE = "phibench_method"


def load_method(reference: Reference) -> Method:
    """Import the method of a reference; runs the code of its file or package.

    Raises
    ------
    MethodError
        If the file has changed, the import fails, the function is missing, is no function, or does not take one pair.
    """
    if reference.kind == "built-in":
        # a second of imports that a user's method need not have
        method: Method = importlib.import_module(reference.place).KNOWN[reference.name]
        return method
    function = function_of_file(reference) if reference.kind == "file" else _from_package(reference)
    require_method(function, _title(reference))
    return function


def place_in(error: BaseException, file: str = "") -> str:
    """Last line of `file` that an exception went through, or the line that raised it: "my_phi.py, line 12, in f"."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename == file] or frames[-1:]
    if not own:
        return ""  # no line of Python, such as in a C library
    frame = own[-1]
    return f"{Path(frame.filename).name}, line {frame.lineno}, in {frame.name}"


def sentence_of(error: BaseException, file: str = "") -> str:
    """An exception in one sentence, with the method's own line."""
    what, place = _in_words(error), place_in(error, file)
    denied = next((cause for cause in _causes(error) if isinstance(cause, PermissionError)), None)
    because = f", because of {_in_words(denied)}" if denied is not None and denied is not error else ""
    return f"{what}{because}{f' ({place})' if place else ''}{_on_relative(error) if file else ''}"


def _in_words(error: BaseException) -> str:
    text = " ".join(_text_of(error).split())[:_LONGEST_MESSAGE]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _on_relative(error: BaseException) -> str:
    """Advice if a file was looked for in the working folder, which is not where the user is."""
    lost = next((cause for cause in _causes(error) if isinstance(cause, FileNotFoundError)), None)
    name = lost.filename if lost is not None else None
    if not isinstance(name, str) or not name or Path(name).is_absolute():
        return ""  # no relative path: another cause
    return "; the working folder is a fresh one: a path beside the method is Path(__file__).with_name('...')"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error, what it was raised because of, and so on."""
    for _ in range(_MOST_CAUSES):
        if error is None:
            return
        yield error
        error = error.__cause__ or error.__context__


def _text_of(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # an exception that cannot say what it is
        return ""


def _title(reference: Reference) -> str:
    return f"{Path(reference.place).name}:{reference.function}" if reference.kind == "file" else reference.name


def function_of_file(reference: Reference) -> Any:
    """Object of a file that a reference names; runs the file's code.

    Raises
    ------
    MethodError
        If the file has changed, its import fails, or there is no such name.
    """
    path = Path(reference.place)
    # a process that is started anew in the middle of a run must not take up an edited file
    if name := reference.changed():
        raise MethodError(f"{name} was changed or removed after it was looked up: run it again")
    sys.path.insert(0, str(path.parent))  # a method may import what lies beside it
    spec = importlib.util.spec_from_file_location(_MODULE, path)
    if spec is None or spec.loader is None:
        raise MethodError(f"{path.name}: Python does not know how to import it")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_MODULE] = module  # dataclasses and pickle look their module up
    try:
        spec.loader.exec_module(module)
    except BaseException as error:  # SystemExit of a script counts as well
        raise MethodError(f"{path.name} cannot be imported: {sentence_of(error, str(path))}") from error
    if not hasattr(module, reference.function):
        raise MethodError(f"{path.name} has no function '{reference.function}': {_advice(reference.function, module)}")
    return getattr(module, reference.function)


def _advice(name: str, module: ModuleType) -> str:
    own = [
        key for key, value in vars(module).items() if inspect.isfunction(value) and value.__module__ == module.__name__
    ]
    guess = close_names(name, own)
    if guess:
        return f"did you mean '{guess[0]}'?"
    return f"it has {', '.join(own)}" if own else "it has no function at all"


def _from_package(reference: Reference) -> Any:
    module, _, attribute = reference.place.partition(":")
    try:
        item: Any = importlib.import_module(module)
        for name in filter(None, attribute.split(".")):
            item = getattr(item, name)
    except BaseException as error:  # SystemExit of a script counts as well
        raise MethodError(f"method '{reference.name}' cannot be imported: {sentence_of(error)}") from error
    return item


def require_method(function: Any, title: str) -> None:
    """Refuse what cannot be called with one pair.

    Raises
    ------
    MethodError
        In one sentence.
    """
    if not callable(function):
        raise MethodError(f"{title} is of type {type(function).__name__}, not a function: write {_call(title)}")
    if inspect.isclass(function):
        raise MethodError(f"{title} is a class: give a function, or an object that can be called with a pair")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # compiled code need not tell
    try:
        signature.bind(object())
    except TypeError:
        raise MethodError(f"{title}{signature} must take one pair and nothing else: {_call(title)}") from None
    if inspect.iscoroutinefunction(function) or inspect.isgeneratorfunction(function):
        raise MethodError(f"{title} is a coroutine or generator: it must return its answer itself")


def _call(title: str) -> str:
    """First line of a method: of a file's its own name, else that of the example."""
    name = title.rpartition(":")[2] if ":" in title else "extract"
    return f"def {name}(pair): ..."


_READ_ONLY = "read-only"  # in numpy's words: "assignment destination is read-only", "output array is read-only"
_LONGEST_MESSAGE = 2000  # of a method's error: a library's may hold an array
_MOST_CAUSES = 32  # a chain of causes may be a circle


def main(line: int, reader: int, isolation: dict[str, Any]) -> None:
    """Load one method and answer pairs until the runner hangs up.

    Parameters
    ----------
    line, reader : int
        Open files: the socket to the runner, and the memory that pairs come in.
    isolation : dict
        Fields of `Isolation`: what this process has, for the runner.
    """
    sys.argv[1:] = []
    connection, pages = Connection(socket.socket(fileno=line)), SharedPages(reader)
    connection.send(to_bytes(isolation))
    faulthandler.enable(all_threads=False)
    faulthandler.register(signal.SIGUSR1, all_threads=False)
    order = json.loads(connection.receive())
    if order["serves"]:
        importlib.import_module(order["serves"]).serve(connection, order)
        return
    nonce, references = order["nonce"], [Reference.of(one) for one in order["references"]]
    try:
        methods = [load_method(reference) for reference in references]
    except MethodError as error:
        connection.send(to_bytes({"nonce": nonce, "fault": str(error)[:_LONGEST_MESSAGE]}))
        return
    file = references[0].place if references[0].kind == "file" else ""
    limits = RunLimits(memory_mb=order["memory_mb"])
    limit_bytes = size_bytes() + int(1e6 * limits.memory_mb)
    folder = str(Path(file).parent) if file else ""
    connection.send(to_bytes({"nonce": nonce, "fault": "", "loaded": loaded_names(folder)}))
    held = None
    with suppress(TransportError):  # the run has hung up
        while True:
            received = unpack(connection.receive(), pages, held)
            if len(methods) > 1:  # one method's pair is not kept: it would count against its limit
                held = received = _shared(received)
            _answer(
                connection, received, lambda one: _reply(methods[one.method], one, limits, limit_bytes, file), folder
            )


def _shared(received: ReceivedPair) -> ReceivedPair:
    """The pair with the work that built-in methods share."""
    from phibench.estimator.methods.spot_search import SharedPair

    pair = received.pair
    return received if isinstance(pair, SharedPair | DensePair) else replace(received, pair=SharedPair.of(pair))


def _answer(
    connection: Connection, received: ReceivedPair, reply: Callable[[ReceivedPair], dict[str, Any]], folder: str
) -> None:
    """Answer one pair, in the process that was asked alone; with the modules, where it has imported further ones."""
    asked = {"number": received.pair.number, "nonce": received.nonce}
    process, before = os.getpid(), _count_modules()
    fields = {**reply(received), **asked}
    answer = to_bytes(fields if _count_modules() == before else {**fields, "loaded": loaded_names(folder)})
    if os.getpid() != process:  # a copy that the method has forked and let return: one answer is enough
        os._exit(0)
    connection.send(answer)


def _count_modules() -> int:
    try:
        return len(sys.modules)
    except TypeError:  # a method may put anything in its place
        return 0


def _reply(method: Method, received: ReceivedPair, limits: RunLimits, limit_bytes: int, file: str) -> dict[str, Any]:
    pair: Any = received.pair

    def ask() -> Any:
        with memory_limit(limit_bytes):
            return method(pair)

    work, encode = getattr(pair, "work", None), answer_encoder(pair)
    reply = (
        reply_of(ask, file, BaseException, limits, encode) if work is None else _reply_with_stages(ask, work, limits)
    )
    for stream in (sys.stdout, sys.stderr):  # what belongs to this pair must be in the pipe before the reply
        with suppress(Exception):  # the method has closed or replaced it
            stream.flush()
    if not received.unchanged():
        return {**reply, "failure": "mutated", "message": "the method wrote into the pair's images: work on a copy"}
    return reply


def _reply_with_stages(ask: Callable[[], Any], work: SharedWork, limits: RunLimits) -> dict[str, Any]:
    """Reply of a built-in method, with CPU-seconds by stage and the wall clock of the results that it found there."""
    work.stages, work.reused_seconds, start = {}, 0.0, time.process_time()
    reply = reply_of(ask, "", BaseException, limits)
    own = time.process_time() - start - work.total
    return {**reply, "stages": work.stages, "own_seconds": own, "reused_seconds": work.reused_seconds}


def answer_encoder(pair: object) -> Callable[[object], dict[str, Any]]:
    """Encoder of the answers that a kind of pair asks for."""
    return dense_answer_document if isinstance(pair, DensePair) else answer_document


def reply_of(
    ask: Callable[[], Any],
    file: str = "",
    caught: type[BaseException] = Exception,
    limits: RunLimits | None = None,
    encode: Callable[[object], dict[str, Any]] = answer_document,
) -> dict[str, Any]:
    """Answer or failure of one pair, with its time, as a document.

    Parameters
    ----------
    ask : calls the method
    file : file of the method, whose line an error names
    caught : what counts as the method's error; anything else passes
    limits : under which the method runs; None if there are none
    encode : gives the document of an answer
    """
    start = time.perf_counter()
    try:
        reply: dict[str, Any] = {"failure": "", "answer": encode(ask())}
    except caught as error:
        reply = _of_exception(error, file, limits)
    return {**reply, "seconds": time.perf_counter() - start}


_NO_MEMORY = re.compile(
    "cannot allocate memory|can't allocate memory|bad_alloc|can't start new thread|failed to map segment", re.IGNORECASE
)
"""Words of libraries that want memory: C's ENOMEM, C++, a thread's stack, a shared library that cannot be mapped."""


def is_out_of_memory(error: BaseException | None) -> bool:
    """Tell an error for want of memory, or one that was raised because of such an error."""
    return any(
        isinstance(cause, MemoryError)
        or (isinstance(cause, OSError) and cause.errno == errno.ENOMEM)
        or lacks_memory(_text_of(cause))
        for cause in _causes(error)
    )


def lacks_memory(text: str) -> bool:
    """Tell a message for want of memory, of a library or of a dying process."""
    return _NO_MEMORY.search(text) is not None


def _of_exception(error: BaseException, file: str, limits: RunLimits | None) -> dict[str, Any]:
    if is_out_of_memory(error):
        text = sentence_of(error, file)
        return {"failure": "memory", "message": limits.memory_sentence(text) if limits else f"out of memory: {text}"}
    if isinstance(error, ValueError) and _READ_ONLY in _text_of(error):
        advice = "the pair's images are read-only: work on a copy, such as pair.down.astype(float)"
        return {"failure": "mutated", "message": f"{sentence_of(error, file)}; {advice}"}
    return {"failure": "error", "message": sentence_of(error, file)}
