"""Small release of four parts, and what tests of releases and of fetching do with it."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phibench.benchmark.release.release_make import Released, ReleaseRequest
from phibench.benchmark.release.release_parts import ReleasePart, content_sha256

ROOT = Path(__file__).parents[2]


def part_of(name: str, recipe: str, kind: Any) -> ReleasePart:
    path = ROOT / "tests" / recipe
    return ReleasePart(name, path, kind, content_sha256(path.read_text(encoding="utf-8")))


SMALL, FILMS = part_of("small", "smallest.toml", "pairs"), part_of("films", "films.toml", "films")
STARTER = ReleasePart("starter", SMALL.recipe, "frames", SMALL.sha256, source="small")


@dataclass(frozen=True)
class Made:
    """A release of four parts, and the sealed data set behind one of them."""

    request: ReleaseRequest
    released: Released

    @property
    def out(self) -> Path:
        return self.request.out


def ask(folder: Path, parts: list[ReleasePart], **options: Any) -> ReleaseRequest:
    return ReleaseRequest(
        parts, folder / "public", folder / "work", folder / "seed", workers=1, archive_bytes=100_000, **options
    )


def snapshot(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
