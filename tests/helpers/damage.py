"""Damage to the files of a data set."""

from pathlib import Path

from phibench.datasets.store import schema

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
