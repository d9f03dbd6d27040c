"""Import a method, in the process that will run it."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from phibench.datasets.files import sha256
from phibench.estimator.seat.errors import MethodError
from phibench.estimator.seat.pair import Method
from phibench.estimator.seat.reference import Reference
from phibench.scenes.names import close_names

_MODULE = "phibench_method"


def load(reference: Reference) -> Method:
    """Import the method of a reference; runs the code of its file or package.

    Raises
    ------
    MethodError
        If the file has changed, the import fails, the function is missing, is no function, or does not take one pair.
    """
    if reference.kind == "built-in":
        from phibench.estimator.methods.registry import KNOWN  # a second of imports that a user's method need not have

        return KNOWN[reference.name]
    function = _from_file(reference) if reference.kind == "file" else _from_package(reference)
    _require_method(function, _title(reference))
    return function


def place_in(error: BaseException, file: str = "") -> str:
    """Last line of `file` that an exception went through, or the line that raised it: "my_phi.py, line 12, in f"."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename == file] or frames[-1:]
    if not own:
        return ""
    frame = own[-1]
    return f"{Path(frame.filename).name}, line {frame.lineno}, in {frame.name}"


def sentence_of(error: BaseException, file: str = "") -> str:
    """An exception in one sentence, with the method's own line."""
    text = " ".join(str(error).split())
    what = f"{type(error).__name__}: {text}" if text else type(error).__name__
    place = place_in(error, file)
    return f"{what} ({place})" if place else what


def _title(reference: Reference) -> str:
    return f"{Path(reference.place).name}:{reference.function}" if reference.kind == "file" else reference.name


def _from_file(reference: Reference) -> Any:
    path = Path(reference.place)
    # a process that is started anew in the middle of a run must not take up an edited file
    if not path.is_file() or sha256(path) != reference.sha256:
        raise MethodError(f"{path.name} was changed or removed after it was looked up: run it again")
    sys.path.insert(0, str(path.parent))  # a method may import what lies beside it
    spec = importlib.util.spec_from_file_location(_MODULE, path)
    if spec is None or spec.loader is None:
        raise MethodError(f"{path.name}: Python does not know how to import it")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_MODULE] = module  # dataclasses and pickle look their module up
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
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
        found: Any = importlib.import_module(module)
        for name in filter(None, attribute.split(".")):
            found = getattr(found, name)
    except BaseException as error:
        raise MethodError(f"method '{reference.name}' cannot be imported: {sentence_of(error)}") from error
    return found


def _require_method(function: Any, title: str) -> None:
    if not callable(function):
        raise MethodError(f"{title} is of type {type(function).__name__}, not a function: write def extract(pair): ...")
    if inspect.isclass(function):
        raise MethodError(f"{title} is a class: give a function, or an object that can be called with a pair")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # compiled code need not tell
    try:
        signature.bind(object())
    except TypeError:
        raise MethodError(f"{title}{signature} must take one pair and nothing else: def extract(pair): ...") from None
    if inspect.iscoroutinefunction(function) or inspect.isgeneratorfunction(function):
        raise MethodError(f"{title} is a coroutine or generator: it must return an Answer itself")
