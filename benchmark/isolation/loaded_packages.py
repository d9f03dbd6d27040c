"""Packages that a method's process has loaded, and the hash of an installed package's files.

The process tells the names of its modules. Versions are looked up outside it, in the metadata of the same environment.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from phibench.datasets.store.files import sha256
from phibench.scenes.validation import printable_line

MOST_NAMES = 4096
"""Modules that a process tells of."""
_LONGEST_NAME = 100  # of a module: what is longer is no package's


def loaded_names(folder: str = "") -> list[str]:
    """Names of this process's packages and modules, without the standard library's and those below `folder`.

    A part of a namespace package stands with its own name, "google.protobuf".
    """
    names = set[str]()
    with suppress(Exception):  # a method may put anything into sys.modules
        for name, module in list(sys.modules.items()):
            if isinstance(name, str) and len(name) <= _LONGEST_NAME and _is_of_others(name, module, folder):
                names.add(_unit(name))
    return sorted(names)[:MOST_NAMES]


def _is_of_others(name: str, module: Any, folder: str) -> bool:
    if name.partition(".")[0] in sys.stdlib_module_names:
        return False  # Python's own
    file = getattr(module, "__dict__", {}).get("__file__")
    return isinstance(file, str) and not (folder and Path(file).is_relative_to(folder))


def _unit(name: str) -> str:
    """First part of a module's name that is no namespace."""
    parts = name.split(".")
    for count in range(1, len(parts)):
        unit = ".".join(parts[:count])
        if getattr(sys.modules.get(unit), "__dict__", {}).get("__file__") is not None:
            return unit
    return name


def packages_of(names: Iterable[str]) -> dict[str, str | None]:
    """Installed packages to which modules belong, with their versions; a module of none has the version None.

    Modules of no package whose names begin with an underscore are left out: they are parts of an installation.
    """
    owners, versions = _owners(_places()), dict[str, str | None]()
    for name in names:
        candidates = owners.get(name.partition(".")[0], ())
        packages = [
            package for package in dict.fromkeys(candidates) if len(candidates) == 1 or _has(package, name)
        ] or candidates
        versions |= {printable_line(package): _version(package) for package in packages}
        if not packages and not name.startswith("_"):
            versions[printable_line(name)] = None
    return dict(sorted(versions.items()))


def _places() -> tuple[tuple[str, int], ...]:
    """Folders of the search path with their times, which an installation changes."""
    paths = [Path(path) for path in sys.path if Path(path).is_dir()]
    return tuple((str(path), path.stat().st_mtime_ns) for path in paths)


@lru_cache(maxsize=1)
def _owners(places: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """Packages by name of a top-level module: a third of what a score of few pairs takes here."""
    return packages_distributions()


@cache
def _files(package: str) -> frozenset[str]:
    try:
        return frozenset(file.as_posix() for file in distribution(package).files or ())
    except PackageNotFoundError:
        return frozenset()


def _has(package: str, name: str) -> bool:
    place = name.replace(".", "/")
    return any(file.startswith((f"{place}/", f"{place}.")) for file in _files(package))


def _version(package: str) -> str | None:
    try:
        return printable_line(distribution(package).version)
    except PackageNotFoundError:
        return None


def package_sha256(owner: Distribution | None, module: str) -> str | None:
    """SHA-256 of the files of an installed package, by name; None if they cannot be found.

    Parameters
    ----------
    owner : distribution that the files' list (RECORD) belongs to
    module : str
        Name of a module in it. The files beside it count where the list does not hold it: of an editable installation,
        or of a package without a list.
    """
    top = module.partition(".")[0]
    files = dict(_listed(owner))
    if not any(name.startswith((f"{top}/", f"{top}.")) for name in files):
        files = dict(_beside(top))
    return _hash(files) if files else None


_OF_INSTALLERS = {"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"}
_BYTECODE = (".pyc", ".pyo")


def _listed(owner: Distribution | None) -> Iterator[tuple[str, Path]]:
    """Files of a distribution's list that lie in its folder; scripts elsewhere hold paths of the machine."""
    for file in getattr(owner, "files", None) or ():
        path, name = Path(str(file.locate())), file.as_posix()
        if ".." not in file.parts and not name.endswith(_BYTECODE) and file.name not in _OF_INSTALLERS:
            yield name, path


_MOST_FILES = 20_000  # of a package: what is beyond is not hashed


def _beside(top: str) -> Iterator[tuple[str, Path]]:
    """Files of a package or module that is found by its name; nothing of it is run."""
    try:
        spec = find_spec(top)
    except (ImportError, ValueError, AttributeError):  # its parent cannot be imported, or is no package
        return
    if spec is None:
        return
    for folder in spec.submodule_search_locations or ():
        paths = (path for path in sorted(Path(folder).rglob("*")) if path.is_file())
        for count, path in enumerate(paths):
            if count == _MOST_FILES:
                return
            if not path.name.endswith(_BYTECODE):
                yield f"{top}/{path.relative_to(folder).as_posix()}", path
    if not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)


def _hash(files: Mapping[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        hashed = sha256(path) if path.is_file() else "missing"
        digest.update(f"{name}\0{hashed}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()
