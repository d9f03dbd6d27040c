"""Sealing a data set: frames and what a user knows go out, the truth stays, and its hash says which truth it was."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import tempfile
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from phibench.datasets.codec import to_json
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import TEMPORARY_PREFIX, WriteError, sha256, write_bytes, write_text
from phibench.datasets.frame_files import png_bytes
from phibench.datasets.frames import Frames
from phibench.datasets.progress import Steps
from phibench.datasets.read import open_finished
from phibench.datasets.recipe import Recipe
from phibench.datasets.recipe_file import RECIPES, load_recipe
from phibench.datasets.sums import sums_text
from phibench.estimator.bench.dataset_pairs import TASK_VERSION, DatasetPairs, dataset_pairs
from phibench.estimator.bench.seal_layout import (
    FORMAT,
    FRAMES,
    PAIRS,
    SEAL,
    SUMS,
    PublicBox,
    PublicPair,
    Seal,
    public_sha256,
    seal_id,
)
from phibench.estimator.bench.truth_file import truth_text
from phibench.estimator.seat.pair import Box, Pair

_FILE_TIME_S = 315532800  # 1980-01-01: a file's own time would tell the order of the work
_SALT_BYTES = 32
_SEED_BITS = 56


@dataclass(frozen=True)
class Sealed:
    """What sealing wrote: the public folder, the truth's file, the seal, and sentences to heed."""

    public: Path
    truth_file: Path
    seal: Seal
    warnings: tuple[str, ...]


def seal(folder: str | Path, public: str | Path, preset: str | None = None, console: Console | None = None) -> Sealed:
    """Seal the takes of a finished data set.

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
    public, console = Path(public), console or Console(stderr=True)
    pairs = dataset_pairs(open_finished(folder), preset)
    _check_folder(public, Path(folder))
    try:
        public.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX, dir=public.parent))
        try:
            return _seal(pairs, Path(folder), work, public, console)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        text = str(error) if isinstance(error, WriteError) else f"could not write to {public}: {error}"
        raise DatasetError(f"{text}; then run the same command again") from error


def sequence_warnings(recipe: Recipe) -> tuple[str, ...]:
    """A sentence about samples of which some tell where the others are."""
    if recipe.random is None or recipe.random.sequence != "sobol":
        return ()
    return (
        "the samples are of a Sobol sequence: whoever has located some spots finds the others from the public strokes, "
        'so seal a set with sequence = "independent"',
    )


def seed_warnings(name: str, seed: int) -> tuple[str, ...]:
    """Sentences about a seed that everybody knows or can find; none about a good one."""
    if (RECIPES / f"{name}.toml").is_file() and load_recipe(name).dataset.seed == seed:
        return (
            f"seed {seed} is that of the shipped recipe '{name}': whoever has phibench can render the same truth, so "
            "seal a set that was made with --seed and a secret number",
        )
    if seed < 2**_SEED_BITS:
        return (
            f"seed {seed} is short: the rigs in {PAIRS} show which seed they were drawn from to whoever tries all, so "
            f"seal a set that was made with a random --seed above 2^{_SEED_BITS}",
        )
    return ()


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
    write_text(work / SUMS, sums_text(_hashes(work)))
    truth_file = write_text(folder / f"seal_{document.id}.truth.json", text)  # first: no seal without its truth
    _publish(work, public)
    recipe = pairs.dataset.info.recipe["dataset"]
    warnings = (*seed_warnings(pairs.dataset.info.name, recipe["seed"]), *sequence_warnings(pairs.dataset.recipe))
    return Sealed(public, truth_file, document, warnings)


def _by_sample(pairs: DatasetPairs) -> list[int]:
    """Numbers in the order in which layers are read once; the files' names and times do not show it."""
    return sorted(range(len(pairs)), key=lambda number: pairs.takes[number].sample_id)


def _write_pair(work: Path, pair: Pair, frames: Frames) -> PublicPair:
    files = {}
    for name, frame in frames.by_name.items():
        end = "png" if frame.jpeg is None else "jpg"
        files[name] = f"{FRAMES}/{pair.number:06d}-{name}.{end}"
        write_bytes(work / files[name], png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
    return PublicPair(
        number=pair.number,
        files=files,
        stroke_m=pair.stroke_m,
        rig=to_json(pair.rig),
        card=to_json(pair.card),
        box_down=_box(pair.box_down),
        box_up=_box(pair.box_up),
        beam=None if pair.beam is None else to_json(pair.beam),
    )


def _box(box: Box | None) -> PublicBox | None:
    return None if box is None else PublicBox(**asdict(box))


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
    work.chmod(0o777 & ~umask)
    for path in (*work.rglob("*"), work):
        os.utime(path, (_FILE_TIME_S, _FILE_TIME_S))
    if public.exists():
        public.rmdir()
    work.replace(public)
