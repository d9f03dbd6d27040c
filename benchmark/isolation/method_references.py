"""Look-up of methods by file, built-in name or entry point, hashed but not run; their tasks and example files.

A reference is ``my_phi.py:extract`` (a file and a function in it), the name of a built-in method, or the name under
which an installed package registers a method (entry-point group ``phibench.methods``). It is resolved without running
any code of the method, because the process that resolves it knows the truth.

A method's file comes with the modules beside it that it imports, as the source says: what is imported by a name that
is computed is not among them.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import inspect
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from phibench.benchmark.isolation.method_provenance import package_sha256
from phibench.benchmark.isolation.run_limits import MethodError
from phibench.datasets.common.input_files import MIB, InputFile
from phibench.datasets.store.files import sha256, write_text
from phibench.datasets.store.provenance import code_behind
from phibench.scenes.validation import close_names, printable_line


@dataclass(frozen=True)
class Reference:
    """A method that is there.

    Attributes
    ----------
    name : str
        Of the method: what a score is filed under.
    kind : "file", "built-in" or "package"
    place : str
        Absolute path of the file; module of the built-in registry; ``module:function`` of an entry point.
    function : str
        Function in the file; "" otherwise.
    sha256 : str or None
        Of the file, of the code behind the built-in methods, or of a package's files: `package_sha256`.
    version : str or None
        Distribution and version of a package.
    modules : tuple of (path, SHA-256)
        Files beside the method's that it imports, relative to its folder.
    sees : "image", "pair" or ""
        Whether a built-in method takes each image by itself or both as one point; "" of others: nobody knows.
    """

    name: str
    kind: Literal["file", "built-in", "package"]
    place: str
    function: str = ""
    sha256: str | None = None
    version: str | None = None
    modules: tuple[tuple[str, str], ...] = ()
    sees: Literal["image", "pair", ""] = ""

    @property
    def shares(self) -> bool:
        """True if it runs in one process with others of its kind: those that share the search for a spot."""
        return self.kind == "built-in" and self.place == SPOTS.registry

    def document(self) -> dict[str, Any]:
        """Provenance, as JSON can hold it; of a file its name alone, not where it lies."""
        place = printable_line(Path(self.place).name) if self.kind == "file" else self.place
        return {**asdict(self), "place": place, "modules": dict(self.modules)}

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Reference:
        """From its fields as JSON has them."""
        return cls(**{**fields, "modules": tuple((name, hashed) for name, hashed in fields["modules"])})

    def files(self) -> list[Path]:
        """The method's file and the modules beside it; none of a method that is no file."""
        path = Path(self.place)
        return [path, *(path.parent / name for name, _ in self.modules)] if self.kind == "file" else []

    def changed(self) -> str:
        """Name of the first file of the method that is not as it was when it was looked up; "" if all are."""
        hashes = (self.sha256, *(hashed for _, hashed in self.modules))
        files = zip(self.files(), hashes, strict=False)
        return next((file.name for file, hashed in files if not file.is_file() or sha256(file) != hashed), "")


@dataclass(frozen=True)
class MethodTask:
    """Task that methods are written for.

    Attributes
    ----------
    command : str
        That writes, checks and lists them.
    function : str
        Name of an example's function.
    group : str
        Entry points of installed packages.
    registry : str
        Module whose `KNOWN` holds the built-in ones by name.
    example : str
        File beside this one that `command` new writes, in which the user's file is called as `file`.
    """

    command: str
    function: str
    group: str
    registry: str
    example: str
    file: str


SPOTS = MethodTask(
    "phibench method",
    "extract",
    "phibench.methods",
    "phibench.estimator.methods.registry",
    "example_method.py",
    "my_phi.py",
)
DENSE = MethodTask(
    "phibench dense",
    "depth",
    "phibench.dense_methods",
    "phibench.estimator.dense.dense_methods",
    "../dense/example_dense.py",
    "my_depth.py",
)
GROUP = SPOTS.group


def resolve(reference: str, task: MethodTask = SPOTS) -> Reference:
    """Find a method.

    Raises
    ------
    MethodError
        If the file or its function is missing, the file is not Python, the name is unknown, or two methods share it.
    """
    if reference.endswith(".py") or ".py:" in reference:
        return _of_file(reference, task)
    # a second of imports that a method in a file does not need
    known = importlib.import_module(task.registry).KNOWN
    points = [point for point in installed_methods(task) if point.name == reference]
    if reference in known:
        if points:
            raise MethodError(f"method '{reference}' is built in, and {_owner(points[0])} registers another")
        return _built_in(known[reference], task)
    if len(points) > 1:
        raise MethodError(f"method '{reference}' is registered by {' and by '.join(map(_owner, points))}: remove one")
    if not points:
        raise MethodError(_unknown(reference, list(known), task))
    hashed = package_sha256(points[0].dist, points[0].module)
    return Reference(reference, "package", points[0].value, sha256=hashed, version=_owner(points[0]))


def installed_methods(task: MethodTask = SPOTS) -> tuple[EntryPoint, ...]:
    """Entry points of installed packages, by name; none of them is imported."""
    return tuple(sorted(entry_points(group=task.group), key=lambda point: point.name))


def _built_in(method: Any, task: MethodTask) -> Reference:
    if not method.installed:
        raise MethodError(f"method '{method.name}' {method.needs}")
    sees: Literal["image", "pair"] = "image" if task is SPOTS and not method.joint else "pair"
    return Reference(method.name, "built-in", task.registry, sha256=code_behind(task.registry), sees=sees)


def _of_file(reference: str, task: MethodTask) -> Reference:
    text, colon, function = reference.rpartition(":")
    if not colon or not function.isidentifier():
        file = Path(text if colon else reference).name
        raise MethodError(f"method '{reference}': say which function is meant, such as {file}:{task.function}")
    path = Path(text).absolute()
    if not path.is_file():
        if path.is_dir():
            raise MethodError(f"method '{reference}': {path} is a folder; name the file with the function in it")
        advice = f"`{task.command} new {text}` writes an example"
        raise MethodError(f"method '{reference}': the file {path} is not there; {advice}")
    if path.name != printable_line(path.name):
        raise MethodError(f"method '{printable_line(path.name)}': give the file a name of at most 200 printable signs")
    parsed_file(path)
    hashed, modules = sha256(path), tuple((name, sha256(path.parent / name)) for name in modules_beside(path))
    # names of files may hold bytes that are no text, and what a terminal obeys
    return Reference(f"{printable_line(path.stem)}:{function}", "file", str(path), function, hashed, modules=modules)


def code_of_function(function: Any) -> dict[str, Any]:
    """Hashes of a function's file and of the modules beside it, as `Reference` has them; of a cell that of its source.

    The values are None and empty where Python cannot tell the source.
    """
    code = function if inspect.isroutine(function) else type(function)
    try:
        path = Path(inspect.getsourcefile(code) or "")
        if path.is_file():
            return {
                "sha256": sha256(path),
                "modules": {name: sha256(path.parent / name) for name in modules_beside(path)},
            }
        return {"sha256": hashlib.sha256(inspect.getsource(code).encode()).hexdigest()}
    except (OSError, TypeError):  # code of a notebook or of a builtin has no file
        return {"sha256": None}


def modules_beside(path: Path) -> list[str]:
    """Files in the folder of a Python file that it imports, and that these import: paths from there, sorted."""
    folder, modules, waiting = path.parent, set[Path](), [path]
    while waiting:
        for file in _imported(waiting.pop(), folder):
            if file != path and file not in modules:
                modules.add(file)
                waiting.append(file)
    return sorted(file.relative_to(folder).as_posix() for file in modules)


def _imported(file: Path, folder: Path) -> Iterator[Path]:
    """Files below a folder that a file imports, packages with their `__init__.py`."""
    try:
        nodes = list(ast.walk(parsed_file(file)))
    except (MethodError, OSError):
        return  # the worker says what is wrong with it
    package = file.parent.relative_to(folder).parts
    for node in nodes:
        if isinstance(node, ast.Import):
            names = [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: max(len(package) + 1 - node.level, 0)] if node.level else ()
            base = (*above, *(node.module.split(".") if node.module else ()))
            names = [(*base, alias.name) for alias in node.names] or [base]
        else:
            continue  # no import
        for name in names:
            yield from _files_of(name, folder)


def _files_of(name: tuple[str, ...], folder: Path) -> Iterator[Path]:
    """Files that an import of a dotted name runs; the last part may be a name in a module."""
    for count in range(1, len(name) + 1):
        place = folder.joinpath(*name[:count])
        for file in (place / "__init__.py", place.parent / f"{place.name}.py"):
            if file.is_file():
                yield file
                break  # Python takes the first, too


_MOST_BYTES = 16 * MIB  # of a method's file


def parsed_file(path: Path) -> ast.Module:
    """Syntax tree of a Python file that can be compiled; nothing of it is run.

    Raises
    ------
    MethodError
        If Python cannot read the file.
    """
    try:
        tree = ast.parse(InputFile(path, "give a Python file", limit_bytes=_MOST_BYTES).read(), str(path))
        compile(tree, str(path), "exec", 0, True)
        return tree
    except SyntaxError as error:
        line = "" if error.lineno is None else f", line {error.lineno}"
        raise MethodError(f"{path.name}{line}: {error.msg}: Python cannot read the file") from error
    except (RecursionError, MemoryError) as error:
        raise MethodError(f"{path.name}: an expression is nested too deeply: Python cannot read the file") from error
    except ValueError as error:
        raise MethodError(f"{path.name}: {error}: Python cannot read the file") from error


def _owner(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"


def _unknown(name: str, built_in: list[str], task: MethodTask) -> str:
    known = [*built_in, *(point.name for point in installed_methods(task))]
    guess = close_names(name, known)
    advice = f"did you mean '{guess[0]}'?" if guess else f"`{task.command} list` lists what there is."
    own = f"{task.file}:{task.function}"
    return f"no method '{name}': {advice} A method of your own is given as file and function, {own}"


def write_example(path: Path, task: MethodTask = SPOTS) -> Path:
    """Write the example method to a file that is not there yet.

    Raises
    ------
    MethodError
        If the name does not end in .py, or there is something of that name.
    """
    if path.suffix != ".py":
        raise MethodError(f"{path}: the file of a method must end in .py, such as {task.file}")
    if path.exists():
        raise MethodError(f"{path} is there already and is not overwritten: give another name or remove it")
    example = Path(__file__).parent / task.example
    return write_text(path, example.read_text(encoding="utf-8").replace(task.file, path.name))
