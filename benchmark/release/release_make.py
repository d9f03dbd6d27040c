"""Release of the benchmark: data sets of frozen recipes, made or reused, as archives with hashes; forecast of its cost.

Two folders are kept apart. `out` is public: archives, `MANIFEST.json`, `SHA256SUMS`, card, licence and Croissant.
`work` is not: it holds the data sets as they are rendered, that of the sealed part with its truth.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from phibench.benchmark.export.export_make import export_frames_sets
from phibench.benchmark.release.release_archives import archive_tasks, json_digest, packed_files
from phibench.benchmark.release.release_parts import (
    DENSE_PAIRS,
    FORMAT,
    MANIFEST,
    STARTER_PAIRS,
    VERSION,
    Archive,
    Manifest,
    ReleasedPart,
    ReleasePart,
    drawn_numbers,
    read_manifest_file,
    same_but_drawn,
)
from phibench.benchmark.sealed.dense_set import (
    DENSE_SEAL,
    DENSE_SET,
    first_pairs,
    pairs_of_sealed,
    seal_dense_set,
    write_dense_set,
)
from phibench.benchmark.sealed.sealed_set import secret_seed
from phibench.datasets.build.forecast import megabytes
from phibench.datasets.build.task_runner import bring_all
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.progress import progress_console
from phibench.datasets.common.shown_text import table_lines
from phibench.datasets.film.film_forecast import films_forecast
from phibench.datasets.film.film_make import make_films
from phibench.datasets.film.film_plan import film_plans
from phibench.datasets.film.film_store import INFO as FILM_INFO
from phibench.datasets.make import cost, make
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import parse_recipe, recipe_files, with_numbers
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import differing_files, filling, read_checksums, with_checksums, write_documents
from phibench.datasets.store.croissant import LICENSE_TEXT, LICENSE_URL, croissant_text, file_object
from phibench.datasets.store.files import sha256, write_text
from phibench.datasets.store.metadata import read_info
from phibench.datasets.store.pair_files import FRAMES_SET
from phibench.datasets.store.temporary_folders import folder_for_work

Seal = Callable[[Path, Path], object]
"""Sealing of a data set: (folder, public folder); `benchmark.sealed.sealed_set.seal`."""
ARCHIVE_BYTES = 500_000_000  # that a fetch that breaks off repeats at most
README = "README.md"
_SEAL = "seal.json"
_IMAGE_BYTES, _IMAGES = 730_000, 4  # of a sealed pair at 1280 x 720; the mean of 40 pairs in three presets
_PAIR_BYTES = {"mjpeg": 450_000, "srgb8": 4_230_000, "bayer-raw": 4_570_000}  # of dev's first pairs, four images each
_SET_BYTES = 500_000  # of the documents of a frames set, about
_DENSE_BYTES = {"dense": 4_000_000, "sealed-dense": 250_000}  # of a pair, with and without planes of truth
_FIRST_SAMPLES = ("frames", "dense")  # kinds that show a part of another data set, whatever more it has


@dataclass(frozen=True)
class ReleaseRequest:
    """All that a release is made from.

    Parameters
    ----------
    parts : parts to make; others that the folder holds stay
    out, work : public folder, and folder of the data sets; neither inside the other
    secret_seed : file with the seed of sealed parts, made if it is not there; None where none is made
    samples : samples of each part that draws its samples, instead of the recipe's number
    use : folders of finished data sets, each taken for the part that it fits
    archive_bytes : an archive holds files up to this size, or one larger file
    """

    parts: Sequence[ReleasePart]
    out: Path
    work: Path
    secret_seed: Path | None
    samples: int | None = None
    use: Sequence[Path] = ()
    archive_bytes: int = ARCHIVE_BYTES
    workers: int | None = None
    console: Console = field(default_factory=progress_console)

    def samples_of(self, part: ReleasePart) -> int | None:
        """Samples to draw; None for a part that draws none."""
        own = part.samples
        if own is None or self.samples is None:
            return own
        return min(own, self.samples) if part.kind in _FIRST_SAMPLES else self.samples

    def source_of(self, part: ReleasePart) -> ReleasePart | None:
        """Part of this release whose frames a part shows, if it is asked for, too."""
        return next((other for other in self.parts if part.source and other.name == part.source), None)

    def frames_of(self, part: ReleasePart) -> dict[str, int]:
        """Pairs of each frames set of a part, by preset."""
        samples = self.samples_of(part)
        return {preset: min(count, samples or count) for preset, count in STARTER_PAIRS.items()}


@dataclass(frozen=True)
class Released:
    """Outcome: the public folder, its manifest, archives written and kept."""

    out: Path
    manifest: Manifest
    made: int
    kept: int

    @property
    def digest(self) -> str:
        """SHA-256 of `MANIFEST.json`, which vouches for all of it."""
        return sha256(self.out / MANIFEST)


def release(request: ReleaseRequest, seal: Seal) -> Released:
    """Make data sets and archives; what is finished is kept, whatever ended the last run.

    Raises
    ------
    DatasetError
        If a recipe is not the frozen one, a folder will not do, a data set that is to be used fits no part or is
        damaged, or the disk is full; in one sentence.
    """
    _check_folders(request)
    used = _assigned(request)
    out = request.out
    with filling(out), folder_for_work(request.work):
        request.work.chmod(stat.S_IRWXU)  # it holds a secret
        manifest = _claimed(out)
        made = kept = 0
        for part in request.parts:
            folder = _dataset(request, part, used, seal)
            manifest, new, old = _packed(request, part, folder, manifest)
            made, kept = made + new, kept + old
        _finish(out, manifest)
    return Released(out, manifest, made, kept)


def forecast_lines(request: ReleaseRequest) -> Iterator[str]:
    """Lines that say what a release takes and holds; nothing is rendered or written."""
    _check_folders(request)
    used = _assigned(request)
    for part in request.parts:
        done = used.get(part.title, request.work / part.title)
        samples = request.samples_of(part)
        count = "" if samples is None else f"{samples} samples, "
        if part.kind == "frames" or part.kind in _DENSE_BYTES:
            yield f"{part.title}: {count}{_frames_cost(request, part, part.title in used)}"
        elif (done / schema.CHECKSUMS).is_file() and part.kind != "sealed":
            paths = [done / name for name in packed_files(done, part.kind == "pairs")]
            size = sum(path.stat().st_size for path in paths if path.is_file())
            yield f"{part.title}: {count}{megabytes(size)}, from {done}"
        elif part.kind == "films":
            yield f"{part.title}: {_film_cost(part)}"
        else:
            forecast = cost(part.recipe, request.work / part.title, samples)
            size = forecast.size if part.kind == "pairs" else (samples or 1) * _IMAGES * _IMAGE_BYTES
            hours = 0.0 if part.title in used else forecast.cpu_s / 3600.0
            rendered = f", rendered layers {megabytes(forecast.size)}" if part.kind == "sealed" else ""
            yield f"{part.title}: {count}about {megabytes(size)}, {hours:.2g} CPU-hours{rendered}"


def _film_cost(part: ReleasePart) -> str:
    plan, films = film_plans(parse_recipe(part.text()), recipe_files(part.recipe))
    forecast = films_forecast(plan, films)
    hours = (forecast.cpu_s + sum(forecast.bakes)) / 3600.0
    return f"{len(films)} films, about {megabytes(forecast.size)} or more, {hours:.2g} CPU-hours"


def _frames_cost(request: ReleaseRequest, part: ReleasePart, is_there: bool) -> str:
    if part.kind in _DENSE_BYTES:
        size = _DENSE_BYTES[part.kind] * min(DENSE_PAIRS, request.samples_of(part) or DENSE_PAIRS)
    else:
        size = sum(_SET_BYTES + _PAIR_BYTES[preset] * count for preset, count in request.frames_of(part).items())
    told = f"about {megabytes(size)}, frames of {part.rendered}"
    if is_there or request.source_of(part) is not None:
        return told
    forecast = cost(part.recipe, request.work / part.rendered, request.samples_of(part))
    return f"{told}, {forecast.cpu_s / 3600.0:.2g} CPU-hours"


# Folders, seed, and data sets that are there.


def _check_folders(request: ReleaseRequest) -> None:
    out, work = request.out.resolve(), request.work.resolve()
    if out.is_relative_to(work) or work.is_relative_to(out):
        raise DatasetError(
            f"--out {out} and --work {work}: one lies in the other; {out} is to be published, so part them"
        )
    for part in request.parts:  # faults of a recipe or a number are said before a folder is made
        if (samples := request.samples_of(part)) is not None:
            parse_recipe(
                with_numbers(part.text(), str(part.recipe), samples, None), str(part.recipe), recipe_files(part.recipe)
            )
    sealed = [part.name for part in request.parts if part.is_sealed]
    if request.secret_seed is None and sealed:
        raise DatasetError(f"part {sealed[0]} is sealed: give --secret-seed FILE, which is made if it is not there")
    if request.secret_seed is not None and (seed := request.secret_seed.resolve()).is_relative_to(out):
        raise DatasetError(f"--secret-seed {seed} lies in {out}, which is to be published; give a file elsewhere")
    if out.is_dir() and not (out / MANIFEST).is_file() and any(not path.name.startswith(".") for path in out.iterdir()):
        raise DatasetError(f"{out} holds other files: give an empty folder, `--out FOLDER`")
    for folder in request.use:
        if folder.resolve().is_relative_to(out):
            raise DatasetError(f"--use {folder} lies in {out}, which is to be published; move it")


def _claimed(out: Path) -> Manifest:
    """Manifest of what the folder holds; an empty one says at least what the folder is for."""
    if not (out / MANIFEST).is_file():
        manifest = Manifest(format=FORMAT, benchmark=VERSION, phibench=version("phibench"), parts={})
        write_text(out / MANIFEST, manifest.text())
        return manifest
    manifest = read_manifest_file(out / MANIFEST, "give another folder, `--out FOLDER`")
    if manifest.benchmark != VERSION:
        held = f"{out} holds version {manifest.benchmark} of the benchmark, and this phibench makes {VERSION}"
        raise DatasetError(f"{held}; give another folder, `--out FOLDER`")
    return manifest.model_copy(update={"phibench": version("phibench")})


def _seed(request: ReleaseRequest, part: ReleasePart, make_it: bool = True) -> int | None:
    """Seed of a part: the recipe's, or the secret one. None if that is still to be drawn."""
    if not part.is_sealed:
        return drawn_numbers(part.text())[0]
    assert request.secret_seed is not None  # `_check_folders`
    return secret_seed(request.secret_seed, make_it)


def _assigned(request: ReleaseRequest) -> dict[str, Path]:
    """Folder by title of the part that it fits."""
    folders: dict[str, Path] = {}
    for folder in request.use:
        reasons = {part.title: _misfit(request, part, folder) for part in request.parts}
        fitting = [title for title, reason in reasons.items() if not reason]
        if not fitting:
            told = [reason for reason in reasons.values() if reason != _OTHER] or [_OTHER]
            raise DatasetError(f"--use {folder}: {told[0]}; leave it out, and it is rendered")
        folders |= dict.fromkeys(fitting, folder)  # frames show the same data set as the part that they are of
    return folders


_OTHER = "it is no data set of a recipe that is to be released"


def _misfit(request: ReleaseRequest, part: ReleasePart, folder: Path) -> str:
    """Reason why a folder does not do for a part; empty if it does. Frames are those of their own release."""
    if (shown := request.source_of(part)) is not None:
        return _misfit(request, shown, folder)
    info = FILM_INFO if part.kind == "films" else schema.INFO
    if not (folder / info).is_file() or not (folder / schema.RECIPE).is_file():
        return _OTHER
    file = InputFile(folder / schema.RECIPE, "put the right one back")
    text = file.text()
    file.toml_of(text)
    if not same_but_drawn(text, part.text()):
        return _OTHER
    if not (folder / schema.CHECKSUMS).is_file():
        return "it was not finished; run its `phibench dataset make` again"
    if part.kind != "films" and (left_out := read_info(folder).left_out):
        refused = f"{len(left_out)} of its samples are refused and left out, such as {left_out[0].sample_id}"
        return f"{refused}, and a release has all samples of its recipe"
    seed, samples = drawn_numbers(text)
    wanted = request.samples_of(part)
    if samples != wanted and not (part.kind in _FIRST_SAMPLES and (samples or 0) > (wanted or 0)):
        return f"it has {samples} samples, and {part.title} is to have {wanted} (--samples)"
    if seed != (meant := _seed(request, part, make_it=False)):
        secret = f"the one in {request.secret_seed}" if part.is_sealed else str(meant)
        return f"its seed is not {secret}, which {part.title} needs"
    return ""


def _dataset(request: ReleaseRequest, part: ReleasePart, used: Mapping[str, Path], seal: Seal) -> Path:
    """Folder whose files are to be packed: made, if need be, or used."""
    folder = used.get(part.title, request.work / part.rendered)
    shows_another = (part.kind == "frames" or part.kind in _DENSE_BYTES) and not _misfit(request, part, folder)
    if part.title not in used and not shows_another:
        part.text()  # the frozen one, or an error
        if part.kind == "films":
            make_films(part.recipe, folder, request.workers, request.console)
        else:
            samples, seed = request.samples_of(part), _seed(request, part)
            make(part.recipe, folder, request.workers, request.console, samples=samples, seed=seed)
    if part.kind == "frames":
        return _frames(request, part, folder)
    if part.kind in _DENSE_BYTES:
        return _dense(request, part, folder)
    if part.kind != "sealed":
        return folder
    public = request.work / f"{part.title}-public"
    if (public / _SEAL).is_file():
        file = InputFile(public / _SEAL, "remove the folder")
        number = file.json().get("id")
        if not isinstance(number, str) or not re.fullmatch("[0-9a-f]{16}", number):
            raise file.fault("has no id of a seal")
        if (folder / f"seal_{number}.truth.json").is_file():
            return public
        raise DatasetError(
            f"{public} is sealed with a truth that {folder} does not have; remove one of the two folders"
        )
    seal(folder, public)
    return public


def _frames(request: ReleaseRequest, part: ReleasePart, folder: Path) -> Path:
    """Frames sets of the first samples; another data set, or another number of samples, has a folder of its own."""
    pairs = request.frames_of(part)
    digest = json_digest([sha256(folder / schema.CHECKSUMS), pairs])[:12]
    out = request.work / f"{part.title}-{digest}"
    if not (out / schema.CHECKSUMS).is_file() and (faults := differing_files(folder, read_checksums(folder))):
        raise DatasetError(f"{folder}: {faults[0]}; run `phibench dataset repair {folder}`")
    return export_frames_sets(folder, pairs, out, workers=request.workers, console=request.console)


def _dense(request: ReleaseRequest, part: ReleasePart, folder: Path) -> Path:
    """Dense set of the first samples; of a sealed part its public form."""
    most = min(DENSE_PAIRS, request.samples_of(part) or DENSE_PAIRS)
    digest = json_digest([sha256(folder / schema.CHECKSUMS), most])[:12]
    dataset, out = open_finished(folder), request.work / f"{part.title}-{digest}"
    if not (out / schema.CHECKSUMS).is_file() and (faults := differing_files(folder, read_checksums(folder))):
        raise DatasetError(f"{folder}: {faults[0]}; run `phibench dataset repair {folder}`")
    if part.kind == "dense":
        return write_dense_set(first_pairs(dataset, most), out)
    public = request.work / f"{part.title}-{digest}-public"
    if (public / schema.CHECKSUMS).is_file():
        return public
    return seal_dense_set(write_dense_set(pairs_of_sealed(dataset, most), out), public)


# Archives.


def _packed(request: ReleaseRequest, part: ReleasePart, folder: Path, manifest: Manifest) -> tuple[Manifest, int, int]:
    """Archives of one part, and the manifest with it; numbers of archives written and kept."""
    out = request.out
    title = part.title
    members = packed_files(folder, part.kind == "pairs")
    tasks = archive_tasks(title, folder, members, request.archive_bytes)
    parts = dict(manifest.parts)
    if parts.pop(title, None) is not None:
        write_text(out / MANIFEST, manifest.model_copy(update={"parts": parts}).text())
    (out / schema.CHECKSUMS).unlink(missing_ok=True)  # until all is there the release is not finished
    state = request.work / f"{title}-archives"
    brought = bring_all({task.name: task for task in tasks.values()}, out, 1, request.console, title, state=state)
    archives = [
        Archive(name=name, size=(out / name).stat().st_size, sha256=digest) for name, digest in brought.hashes.items()
    ]
    for path in out.glob(f"{title}-[0-9][0-9][0-9].tar"):
        if path.name not in tasks:
            path.unlink()  # of an earlier release with more files
    count = _sample_count(part, folder)
    parts[title] = ReleasedPart(
        kind=part.kind,
        recipe_sha256=part.sha256,
        samples=count,
        recipe_samples=part.whole,
        files=len(members),
        size=sum((folder / name).stat().st_size for name in members),
        sums_sha256=sha256(folder / schema.CHECKSUMS),
        archives=tuple(archives),
    )
    manifest = manifest.model_copy(update={"parts": parts})
    write_text(out / MANIFEST, manifest.text())
    return manifest, len(brought.made), len(tasks) - len(brought.made)


def _sample_count(part: ReleasePart, folder: Path) -> int:
    """Pairs of a data set, of a sealed one or of the largest frames set, or films."""
    frames = f"{next(iter(STARTER_PAIRS))}/{FRAMES_SET}"
    name, key = {
        "pairs": (schema.INFO, "samples"),
        "sealed": (_SEAL, "pairs"),
        "films": (FILM_INFO, "films"),
        "frames": (frames, "samples"),
        "dense": (DENSE_SET, "pairs"),
        "sealed-dense": (DENSE_SEAL, "pairs"),
    }[part.kind]
    file = InputFile(folder / name, "run `phibench dataset repair`")
    value = file.json().get(key)
    if isinstance(value, bool) or not isinstance(value, int | list):
        raise file.fault(f"does not say how many {key} there are")
    return len(value) if isinstance(value, list) else value


# What lies beside the archives.


def _finish(out: Path, manifest: Manifest) -> None:
    hashes = {archive.name: archive.sha256 for part in manifest.parts.values() for archive in part.archives}
    title = f"phibench-v{VERSION.split('.')[0]}"
    about = (
        f"Benchmark of phibench, version {VERSION}: pairs and films of a laser spot in a mirror, with the exact truth, "
        "and pairs whose truth is sealed. MANIFEST.json lists the parts."
    )
    objects = [file_object(name, "application/x-tar", hashes[name]) for name in sorted(hashes)]
    objects.append(file_object(MANIFEST, "application/json", sha256(out / MANIFEST)))
    documents = {
        MANIFEST: (out / MANIFEST).read_bytes(),
        schema.CROISSANT: croissant_text(title, about, f"{VERSION}.0", objects).encode(),
        "LICENSE": LICENSE_TEXT.encode(),
        README: _card(title, manifest).encode(),
    }
    write_documents(out, with_checksums(documents, hashes))


def _card(title: str, manifest: Manifest) -> str:
    lines = ["---", "license: cc-by-4.0", f"pretty_name: {title}", "---", "", f"# {title}", ""]
    lines += [f"Version {VERSION} of the benchmark of phibench, made with phibench {manifest.phibench}.", ""]
    lines += ["    phibench fetch NAME --from PLACE-OF-THIS-FOLDER --out FOLDER", ""]
    kinds = {"pairs": "pairs with truth", "sealed": "pairs, truth sealed", "films": "films with truth"}
    kinds["frames"] = f"frames with truth: {', '.join(STARTER_PAIRS)}"
    kinds |= {"dense": "dense pairs with truth", "sealed-dense": "dense pairs, truth sealed"}
    rows = [
        (f"`{name}`", kinds[one.kind], one.count_text, f"{one.files}", megabytes(one.size), f"{len(one.archives)}")
        for name, one in sorted(manifest.parts.items())
    ]
    lines += table_lines(("name", "content", "samples", "files", "unpacked", "archives"), rows)
    return "\n".join([*lines, "", f"Licence: [CC BY 4.0]({LICENSE_URL}).", ""])
