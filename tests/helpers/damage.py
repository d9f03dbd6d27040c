"""Damage to the files of a data set."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from phibench.datasets.build.journal import FolderHead, Journal
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text, data_files, read_checksums
from phibench.datasets.store.files import sha256, write_bytes, write_text
from phibench.datasets.store.metadata import manifest_documents
from phibench.datasets.store.schema import ManifestRow
from phibench.datasets.verify import file_faults

AMBIENT, TRUTH = schema.view_file("h0.000", "ambient"), schema.view_file("h0.500", "truth")


SPOT, OTHER_SPOT = "spots/seen-near-h0.500-down.exr", "spots/seen-near-h0.500-up.exr"


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) * 2 // 3] ^= 1
    path.write_bytes(data)


def swap(folder: Path, a: str, b: str) -> None:
    (folder / a).rename(folder / "aside")
    (folder / b).rename(folder / a)
    (folder / "aside").rename(folder / b)


def write_manifest(folder: Path, rows: Sequence[ManifestRow]) -> None:
    """Write both forms."""
    for name, data in manifest_documents(rows).items():
        write_bytes(folder / name, data)


def write_checksums(folder: Path) -> None:
    """Hash all data files."""
    hashes = {name: sha256(folder / name) for name in data_files(folder)}
    write_text(folder / schema.CHECKSUMS, checksums_text(hashes))


def sign(folder: Path) -> None:
    """Let SHA256SUMS and the journal vouch for the files as they are now."""
    write_checksums(folder)
    hashes = read_checksums(folder)
    with Journal(folder) as journal:
        for name, entry in journal.entries.items():
            files = {file: hashes.get(file, digest) for file, digest in entry.files.items()}
            journal.entries[name] = dataclasses.replace(entry, files=files)
        texts = ((folder / name).read_text(encoding="utf-8") for name in (schema.INFO, schema.RECIPE))
        journal.begin(FolderHead(*texts), list(journal.entries))


def flip_bit(path: Path, bit: int) -> None:
    """Flip one bit of a file, counted from its first byte's lowest."""
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def unseen_flips(folder: Path, count: int) -> dict[str, list[int]]:
    """Flipped bits that verification of the files does not see: `count` random ones in a file of each kind."""
    random, missed = np.random.default_rng(0), dict[str, list[int]]()
    names = {*read_checksums(folder), schema.CHECKSUMS, schema.JOURNAL, schema.SENSITIVITIES}
    # of views, spots and previews one of each: they are read alike
    kinds = {name.split("/")[-1] if name.startswith("views") else name.split("/")[0]: name for name in sorted(names)}
    assert len(kinds) == 16
    for name in kinds.values():
        for bit in map(int, random.integers(0, 8 * (folder / name).stat().st_size, count)):
            flip_bit(folder / name, bit)
            if not file_faults(folder)[0]:
                missed.setdefault(name, []).append(bit)
            flip_bit(folder / name, bit)
    assert file_faults(folder)[0] == []
    return missed
