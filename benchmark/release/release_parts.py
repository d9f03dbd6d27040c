"""Frozen benchmark: its version, the released parts with hashes of their recipes, and the models of `MANIFEST.json`.

The recipes of a version never change. `SHA256` over the values of each, comments aside, is written down here, and a
recipe with another one is refused. docs/release.md has the rules and the changelog of the versions.
"""

from __future__ import annotations

import hashlib
import json
import tarfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, FileName, InputFile, Name
from phibench.datasets.recipe.load import recipe_text
from phibench.datasets.store.schema import Document
from phibench.scenes.validation import nearest

VERSION = "4.0"
"""Version of the benchmark. The first number counts sets of recipes, the second one additions that change no sample."""
MANIFEST = "MANIFEST.json"
FORMAT = "phibench release 1"
_BLOCK = tarfile.BLOCKSIZE
Kind = Literal["pairs", "sealed", "films", "frames", "dense", "sealed-dense"]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class ReleasePart:
    """One data set of a release.

    Parameters
    ----------
    name : str
        Last word of its archives' name.
    recipe : str or Path
        Name of a shipped recipe, or a file.
    kind : "pairs", "sealed", "films", "frames", "dense" or "sealed-dense"
    sha256 : str
        Hash of the recipe's values (`content_sha256`).
    source : str
        Of frames and dense pairs: name of the part whose samples they show.
    """

    name: str
    recipe: str | Path
    kind: Kind
    sha256: str
    source: str = ""

    @property
    def title(self) -> str:
        """Name of the released data set."""
        return _title(self.name)

    @property
    def rendered(self) -> str:
        """Name of the data set behind it: its own, or that of the part whose frames it holds."""
        return _title(self.source or self.name)

    @property
    def samples(self) -> int | None:
        """Number of samples of the whole part; None if its recipe draws none."""
        own = drawn_numbers(self.text())[1]
        most = {"frames": max(STARTER_PAIRS.values()), "dense": DENSE_PAIRS}.get(self.kind)
        return own if own is None or most is None else min(own, most)

    @property
    def whole(self) -> int | None:
        """Number of samples that the whole part shows; None if its recipe draws none."""
        own = self.samples
        return own if own is None or self.kind != "sealed-dense" else min(own, DENSE_PAIRS)

    @property
    def is_sealed(self) -> bool:
        """True if its samples are drawn with the secret seed."""
        return self.kind in ("sealed", "sealed-dense")

    def text(self) -> str:
        """Text of the recipe.

        Raises
        ------
        DatasetError
            If its values are not the frozen ones.
        """
        text = recipe_text(self.recipe)
        if content_sha256(text) != self.sha256:
            what = f"recipe {self.recipe} is not the frozen one of version {VERSION} of the benchmark"
            raise DatasetError(f"{what}: a number in it was changed; put it back, or make a data set of another name")
        return text


def _title(name: str) -> str:
    return f"phibench-v{VERSION.split('.')[0]}-{name}"


STARTER_PAIRS = {"mjpeg": 60, "srgb8": 3, "bayer-raw": 3}
"""Pairs of each frames set of the starter part. PNG files keep the noise: 60 pairs in each would have 0.54 GB."""
DENSE_PAIRS = 100
"""Most pairs of a dense part."""
_DEV = "a274640eda114303c9fa7a51185574048483b7e529d3f9916bdac10f89f7ac6b"
_TEST = "32818cd99112fcf5f0125898b2ab538ab9d53cf02fd90089ec9d14457af67aaa"
PARTS = (
    ReleasePart("dev", "bench-dev", "pairs", _DEV),
    ReleasePart("test", "bench-test", "sealed", _TEST),
    ReleasePart("paper", "paper", "pairs", "2487ca0015be181c7164faaccdac0829078d996d81dc8719f9992951b34faa44"),
    ReleasePart(
        "mirrors", "bench-mirrors", "pairs", "45f352f98d2c12a779a89b805240481f519a09e92401dff9ae76ad529bce68fb"
    ),
    ReleasePart("films", "bench-films", "films", "d7e243e791f85a1e0c0e761c5f1ca5377cc839d1a7e1221b5d0a87424c91b9c9"),
    ReleasePart("drives", "bench-drives", "films", "825473dc49345b0f331de47ab49b735d453fcdfafa669aa45dbbb39c4a3926f3"),
    ReleasePart("dense-dev", "bench-dev", "dense", _DEV, source="dev"),
    ReleasePart("dense-test", "bench-test", "sealed-dense", _TEST, source="test"),
    ReleasePart("starter", "bench-dev", "frames", _DEV, source="dev"),
)


def chosen_parts(names: tuple[str, ...]) -> tuple[ReleasePart, ...]:
    """Parts by their last words or whole titles; all where none is named.

    Raises
    ------
    DatasetError
        For a name that is none.
    """
    if not names:
        return PARTS
    known = {word: part for part in PARTS for word in (part.name, part.title)}
    for name in names:
        if name not in known:
            raise DatasetError(f"there is no part '{name}' of the benchmark; {nearest(name, [p.name for p in PARTS])}")
    return tuple(part for part in PARTS if part in [known[name] for name in names])


def content_sha256(text: str) -> str:
    """SHA-256 of a recipe's values as canonical JSON: comments, spaces and order do not count."""
    return _sha256(tomllib.loads(text))


def same_but_drawn(text: str, other: str) -> bool:
    """True if two recipes differ in the seed and in the number of samples at most."""
    return _sha256(_without_numbers(tomllib.loads(text))) == _sha256(_without_numbers(tomllib.loads(other)))


def drawn_numbers(text: str) -> tuple[int, int | None]:
    """Seed of a recipe, and its number of samples; None if it draws none."""
    raw = tomllib.loads(text)
    return raw.get("dataset", {}).get("seed", 0), raw.get("random", {}).get("samples")


def _sha256(values: dict[str, Any]) -> str:
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), default=str)  # TOML has dates
    return hashlib.sha256(text.encode()).hexdigest()


def _without_numbers(values: dict[str, Any]) -> dict[str, Any]:
    rest = dict(values)
    for name, left_out in (("dataset", "seed"), ("random", "samples")):
        if isinstance(table := values.get(name), dict):
            rest[name] = {key: value for key, value in table.items() if key != left_out}
    return rest


# Documents of a release.


class Archive(Document):
    """One archive: a tar file with a share of a data set's files."""

    name: Annotated[FileName, Field(pattern=r"^[^/]+\.tar$")]
    size: Annotated[int, Field(ge=0)]
    sha256: Digest


class ReleasedPart(Document):
    """One data set in `MANIFEST.json`.

    `size` and `files` are those of the unpacked data set. `sums_sha256` is the hash of its `SHA256SUMS`, and with it
    that of every file. `recipe_samples` is the number of the whole part, null where its recipe draws none.
    """

    kind: Kind
    recipe_sha256: Digest
    samples: Annotated[int, Field(ge=0)]
    recipe_samples: Annotated[int, Field(ge=1)] | None = None
    files: Annotated[int, Field(ge=1)]
    size: Annotated[int, Field(ge=1)]
    sums_sha256: Digest
    archives: Annotated[tuple[Archive, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _archives_hold_the_files(self) -> ReleasedPart:
        """Refuse sizes that no archives of these files have: a header, the bytes and less than a block for each."""
        least = self.size + _BLOCK * self.files
        most = least + _BLOCK * self.files + (tarfile.RECORDSIZE + 2 * _BLOCK) * len(self.archives)
        if not least <= self.download <= most:
            raise ValueError(f"{self.download} bytes of archives do not hold {self.files} files of {self.size} bytes")
        if len({archive.name for archive in self.archives}) != len(self.archives):
            raise ValueError("two archives have one name")
        return self

    @property
    def count_text(self) -> str:
        """Number of samples; "3 of 500" where the whole part has another number."""
        whole = self.recipe_samples
        return str(self.samples) if whole in (None, self.samples) else f"{self.samples} of {whole}"

    @property
    def download(self) -> int:
        """Bytes of all archives."""
        return sum(archive.size for archive in self.archives)


class Manifest(Document):
    """`MANIFEST.json` of a release: what it holds, by title. It has no time, no place and no seed."""

    format: Name
    benchmark: Name
    phibench: Name
    parts: dict[Name, ReleasedPart]

    def text(self) -> str:
        """Text of the file, parts sorted."""
        document = self.model_dump(mode="json")
        document["parts"] = {name: document["parts"][name] for name in sorted(document["parts"])}
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def read_manifest_file(path: Path, remedy: str) -> Manifest:
    """Read `MANIFEST.json`.

    Raises
    ------
    DatasetError
        If it is missing, damaged, or of another format.
    """
    file = InputFile(path, remedy, limit_bytes=SETTINGS_BYTES)
    raw = file.json()
    if raw.get("format") != FORMAT:
        raise file.fault(f"is no list of a release of this phibench: its format is not '{FORMAT}'")
    return file.validated(Manifest, raw)
