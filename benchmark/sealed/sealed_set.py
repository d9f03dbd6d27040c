"""Sealed set: maker of a folder of frames without truth and of the hidden truth file; warnings and secret seeds.

seal.json       settings of the set, and the SHA-256 that the truth must have
pairs.jsonl     per pair what a user knows: rig, stroke, sensor, boxes, files
frames/         images: PNG of 8 or 16 bits, or the camera's JPEG
SHA256SUMS      of everything above

The truth stays with the organiser (`frames_set`), and its hash in the seal proves later which it was.

Public strokes and rigs confirm a guessed root seed without a judge, 0.7 us a seed and core. So the system draws 128
bits into a file that nobody else may read: no named stream gives them, no person thinks of them, and no command line
shows them to other users.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import stat
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from phibench.benchmark.pair_sets.dataset_pairs import TASK_VERSION, DatasetPairs, dataset_pairs
from phibench.benchmark.pair_sets.frames_set import Digest, truth_text
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile, Name
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.frames.frame_source import Frames
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import RECIPES, load_recipe
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store.checksums import checksums_text, read_checksums, writing_to
from phibench.datasets.store.files import sha256, write_bytes, write_secret, write_text
from phibench.datasets.store.pair_files import FRAMES, MOST_PAIRS, PAIRS, PublicPair, public_fields
from phibench.datasets.store.schema import CHECKSUMS, SEALED_TRUTH, Document
from phibench.datasets.store.temporary_folders import OwnedFolder, folder_for_work
from phibench.estimator.interface import Pair
from phibench.scenes.random_streams import LARGEST_SEED, LEAST_SECRET_SEED, generator

SEAL = "seal.json"
FORMAT = "phibench sealed set 1"


class Seal(Document):
    """`seal.json`.

    `public_sha256` is the hash of the list of hashes of `pairs.jsonl` and of the frames, `truth_sha256` that of the
    truth's file, which holds a random number of 256 bits, so that nobody can try out truths against it. The id follows
    from both.
    """

    format: Name
    id: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    task_version: Annotated[int, Field(ge=1, le=1000)]
    pairs: Annotated[int, Field(ge=1, le=MOST_PAIRS)]
    public_sha256: Digest
    truth_sha256: Digest
    phibench: Name | None


def seal_id(public_sha256: str, truth_sha256: str) -> str:
    """Id of a seal."""
    return hashlib.sha256(f"{public_sha256}\n{truth_sha256}\n".encode()).hexdigest()[:16]


def public_sha256(hashes: Mapping[str, str]) -> str:
    """Hash of what a method may see: pairs and frames, by relative name."""
    content = {name: digest for name, digest in hashes.items() if name == PAIRS or name.startswith(f"{FRAMES}/")}
    return hashlib.sha256(checksums_text(content).encode()).hexdigest()


def read_seal(folder: Path) -> Seal:
    """Read `seal.json` and check that it fits the folder's list of hashes.

    Raises
    ------
    DatasetError
        In one sentence: no sealed set, damaged, or changed.
    """
    path = folder / SEAL
    if not path.is_file():
        raise DatasetError(f"{folder} is no sealed set: it has no {SEAL}; give what `phibench seal make` wrote")
    if not (folder / CHECKSUMS).is_file():
        raise DatasetError(f"{folder / CHECKSUMS} is missing; download the set again")
    seal = InputFile(path, "download the set again", limit_bytes=SETTINGS_BYTES).document(Seal)
    listed = public_sha256(read_checksums(folder))
    if seal.format != FORMAT or listed != seal.public_sha256 or seal.id != seal_id(listed, seal.truth_sha256):
        raise DatasetError(
            f"{folder}: {SEAL} and {CHECKSUMS} do not belong together, one was changed; download the set again"
        )
    return seal


_FILE_TIME_S = 315532800  # 1980-01-01: a file's own time would tell the order of the work
_SALT_BYTES = 32  # 256 bits: a truth that somebody guesses cannot be tried against the seal
_TRUTH_FILE = "seal_{}" + SEALED_TRUTH


@dataclass(frozen=True)
class Sealed:
    """Result of sealing: the public folder, the truth's file, the seal, and warnings."""

    public: Path
    truth_file: Path
    seal: Seal
    warnings: tuple[str, ...]


def seal(folder: str | Path, public: str | Path, preset: str | None = None, console: Console | None = None) -> Sealed:
    """Seal one pair of each sample of a finished data set.

    Several pairs of a sample, in other presets or draws of the noise, would help each other: a method that sees all of
    them averages. Presets are dealt out evenly over the samples (`single_pairs`).

    Parameters
    ----------
    folder : data set
        The truth's file, `seal_<id>.truth.json`, is written into it.
    public : folder to write; new or empty
    preset : str, optional
        One preset instead of those of the recipe's `[frames]`.
    console : where progress goes; by default the standard error

    Raises
    ------
    DatasetError
        If the data set or the folder will not do; then nothing is left behind.
    """
    public, console = Path(public), console or progress_console()
    dataset = open_finished(folder)
    check_seed(Path(folder), dataset.recipe.dataset.seed)
    pairs = single_pairs(dataset_pairs(dataset, preset))
    _check_folder(public, Path(folder))
    with writing_to(public), folder_for_work(public.parent), OwnedFolder("seal", public.parent) as work:
        return _seal(pairs, Path(folder), work, public, console)


def single_pairs(pairs: DatasetPairs) -> DatasetPairs:
    """One pair of each sample, in the drawn order: its first draw, in a preset that is drawn for the sample."""
    dataset, draws = pairs.dataset, pairs.pair_draws
    presets = sorted({draw.preset for draw in draws})
    samples = sorted({draw.sample_id for draw in draws})
    order = generator(dataset.info.name, dataset.recipe.dataset.seed, "seal", "presets")
    dealt = {samples[k]: presets[place % len(presets)] for place, k in enumerate(order.permutation(len(samples)))}
    chosen = [draw for draw in draws if draw.draw == 0 and draw.preset == dealt[draw.sample_id]]
    return DatasetPairs(dataset, tuple(replace(draw, number=number) for number, draw in enumerate(chosen)))


def earlier_warnings(folder: Path) -> tuple[str, ...]:
    """A sentence about earlier seals of a data set, whose pairs are of the same samples."""
    earlier = sorted(path.name.split(".")[0] for path in folder.glob(_TRUTH_FILE.format("*")))
    if not earlier:
        return ()
    return (
        f"this data set was sealed before ({', '.join(earlier)}): pairs of the same samples in two published sets help "
        "each other, so publish one of the sets, and make samples with another seed for a second one",
    )


def board_warnings(name: str, recipe: Recipe) -> tuple[str, ...]:
    """A sentence about boards that everybody knows."""
    known = recipe.targets and (RECIPES / f"{name}.toml").is_file()
    if not known or load_recipe(name).targets != recipe.targets:
        return ()
    return (
        f"the boards stand where the shipped recipe '{name}' puts them: whoever knows them gets D from the azimuth, "
        "and phi better than from the images, so seal a set whose boards were moved in a secret copy of the recipe",
    )


def sequence_warnings(recipe: Recipe) -> tuple[str, ...]:
    """A sentence about samples of which some tell where the others are."""
    if recipe.random is None or recipe.random.sequence != "sobol":
        return ()
    return (
        "the samples are of a Sobol sequence: whoever has located some spots finds the others from the public strokes, "
        'so seal a set with sequence = "independent"',
    )


def check_seed(folder: Path, seed: int) -> None:
    """Refuse a seed that can be found: that of a shipped recipe, or any short one.

    Public strokes and rigs confirm a guess without a judge (`secret_seed`).
    """
    if seed < LEAST_SECRET_SEED:
        raise DatasetError(
            f"{folder} cannot be sealed: its seed is shorter than 128 bits, and the rigs in {PAIRS} would show it to "
            "whoever tries all; make the data set anew with `phibench dataset make RECIPE --secret-seed FILE --out "
            "FOLDER`, where the system draws the seed"
        )


def _seal(pairs: DatasetPairs, folder: Path, work: Path, public: Path, console: Console) -> Sealed:
    rows = {}
    with Steps(console, "pairs", len(pairs)) as steps:
        for number in _by_sample(pairs):
            rows[number] = _write_pair(work, *pairs.pair_and_frames(number))
            steps.advance()
    lines = (json.dumps(rows[k].model_dump(mode="json"), allow_nan=False) + "\n" for k in range(len(pairs)))
    write_text(work / PAIRS, "".join(lines))
    listed = _hashes(work)
    content = public_sha256(listed)
    # a secret is the one number that must not come from a named stream
    text = truth_text([pairs.truth(k) for k in range(len(pairs))], secrets.token_hex(_SALT_BYTES), content)
    truth_sha256 = hashlib.sha256(text.encode()).hexdigest()
    document = Seal(
        format=FORMAT,
        id=seal_id(content, truth_sha256),
        task_version=TASK_VERSION,
        pairs=len(pairs),
        public_sha256=content,
        truth_sha256=truth_sha256,
        phibench=version("phibench"),
    )
    write_text(work / SEAL, json.dumps(document.model_dump(mode="json"), indent=1) + "\n")
    write_text(work / CHECKSUMS, checksums_text(_hashes(work)))
    warnings = earlier_warnings(folder)
    truth_file = write_secret(folder / _TRUTH_FILE.format(document.id), text)  # first: no seal without its truth
    _publish(work, public)
    name, recipe = pairs.dataset.info.name, pairs.dataset.recipe
    warnings += (*sequence_warnings(recipe), *board_warnings(name, recipe))
    return Sealed(public, truth_file, document, warnings)


def _by_sample(pairs: DatasetPairs) -> list[int]:
    """Numbers in the order in which layers are read once; the files' names and times do not show it."""
    return sorted(range(len(pairs)), key=lambda number: pairs.pair_draws[number].sample_id)


def _write_pair(work: Path, pair: Pair, frames: Frames) -> PublicPair:
    files = {}
    for name, frame in frames.by_name.items():
        end = "png" if frame.jpeg is None else "jpg"
        files[name] = f"{FRAMES}/{pair.number:06d}-{name}.{end}"
        write_bytes(work / files[name], png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
    return PublicPair(**public_fields(pair, files))


def _hashes(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256(path) for path in files}


def _check_folder(public: Path, folder: Path) -> None:
    where = public.resolve()
    if where == folder.resolve() or folder.resolve() in where.parents:
        raise DatasetError(f"{public} lies inside the data set, which holds the truth; give a folder outside, --out")
    if public.exists() and (not public.is_dir() or any(public.iterdir())):
        raise DatasetError(f"{public} exists and is not an empty folder; give a new one, --out")


def _publish(work: Path, public: Path) -> None:
    """Give every file the same time, then the folder its name."""
    umask = os.umask(0)
    os.umask(umask)
    work.chmod(0o777 & ~umask)  # a temporary folder is its owner's alone
    for path in (*work.rglob("*"), work):
        os.utime(path, (_FILE_TIME_S, _FILE_TIME_S))
    if public.exists():
        public.rmdir()
    work.replace(public)


# -- secret seeds ------------------------------------------------------------------------------------------------------


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
        _draw_seed(path)
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


def _draw_seed(path: Path) -> None:
    """Write a new seed: 2^128, which marks it as one, and 128 bits."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, stat.S_IRUSR | stat.S_IWUSR)
    with os.fdopen(handle, "w", encoding="ascii") as file:
        file.write(f"{LEAST_SECRET_SEED + secrets.randbits(128)}\n")
        file.flush()
        os.fsync(file.fileno())
