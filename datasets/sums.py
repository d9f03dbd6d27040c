"""SHA256SUMS, for ``sha256sum -c``. It is written last: where it is, the data set is complete."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import TEMPORARY_PREFIX, sha256, write_text


def data_files(folder: Path) -> list[str]:
    """Relative names of all data files in a folder, sorted."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if name not in layout.NOT_DATA and TEMPORARY_PREFIX not in name)


def write_sums(folder: Path) -> Path:
    """Hash all data files."""
    return write_text(folder / layout.SUMS, sums_text({name: sha256(folder / name) for name in data_files(folder)}))


def sums_text(hashes: Mapping[str, str]) -> str:
    """Text of the list, sorted by name."""
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))


def read_sums(folder: Path) -> dict[str, str]:
    """Hash by relative name.

    Raises
    ------
    DatasetError
        If the list is missing (the data set is not complete) or not one.
    """
    path = folder / layout.SUMS
    if not path.is_file():
        raise DatasetError(f"{folder} has no {layout.SUMS}: it was not finished; run `phibench dataset make` again")
    entries = [line.split("  ", 1) for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    if any(len(entry) != 2 or len(entry[0]) != 64 for entry in entries):
        raise DatasetError(f"{path} is damaged: a line is not '<SHA-256>  <file>'")
    return {name: digest for digest, name in entries}


def damaged(folder: Path) -> list[str]:
    """One sentence per file that is missing, changed or not listed."""
    listed, present = read_sums(folder), set(data_files(folder))
    faults = [f"{name} is missing" for name in listed if name not in present]
    changed = (name for name in listed if name in present and sha256(folder / name) != listed[name])
    faults += [f"{name} is damaged: its SHA-256 is not the listed one" for name in changed]
    return faults + [f"{name} is not listed in {layout.SUMS}" for name in sorted(present - set(listed))]
