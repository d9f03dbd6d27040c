"""Secret root seeds of sealed sets, in files that nobody else may read.

Public strokes and rigs confirm a guessed seed without a judge, 0.7 us a seed and core. So the system draws 128 bits: no
named stream gives them, no person thinks of them, and no command line shows them to other users.
"""

from __future__ import annotations

import os
import secrets
import stat
from pathlib import Path

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.scenes.random_streams import LARGEST_SEED, LEAST_SECRET_SEED


def secret_seed(path: Path, make_it: bool = True) -> int | None:
    """Seed of a file; one that is not there yet is drawn, or None without `make_it`.

    Raises
    ------
    DatasetError
        If others may read the file, or it holds no seed of 128 bits; in one sentence.
    """
    if not path.exists():
        if not make_it:
            return None  # a dry run draws none
        path.parent.mkdir(parents=True, exist_ok=True)
        _draw(path)
    if path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise DatasetError(f"{path} may be read by others; run `chmod 600 {path}`, or draw another seed if it was seen")
    text = InputFile(path, "give a file with one whole number", limit_bytes=SETTINGS_BYTES).text().strip()
    is_number = text.isascii() and text.isdigit() and len(text) <= len(str(LARGEST_SEED))
    if not (is_number and LEAST_SECRET_SEED <= int(text) <= LARGEST_SEED):
        raise DatasetError(
            f"{path} holds no secret seed: it is a whole number from 2^128 to 2^129 - 1, drawn by the system; name a "
            "file that is not there, and it is drawn"
        )
    return int(text)


def _draw(path: Path) -> None:
    """Write a new seed: 2^128, which marks it as one, and 128 bits."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, stat.S_IRUSR | stat.S_IWUSR)
    with os.fdopen(handle, "w", encoding="ascii") as file:
        file.write(f"{LEAST_SECRET_SEED + secrets.randbits(128)}\n")
        file.flush()
        os.fsync(file.fileno())
