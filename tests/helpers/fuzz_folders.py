"""Fuzz targets of files in a folder that a command goes on with: claims, seals, kept draws, baked rooms, imports.

Not a test file. They need a data set, which `smallest_dataset` is.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from helpers.fuzz_targets import jpeg
from helpers.valid_files import TEXT, Kind, changed, compact, digest, png, public_rows
from PIL import Image
from rich.console import Console

from phibench.benchmark.export import export_make
from phibench.benchmark.export.pair_rows import ExportRequest
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.release import release_make
from phibench.benchmark.release.release_make import ReleaseRequest
from phibench.benchmark.release.release_parts import PARTS
from phibench.benchmark.reports.bench import SHIPPED
from phibench.benchmark.scores.score_document import MethodCard, ScoreDocument
from phibench.benchmark.scores.worst_images import EncodedPicture
from phibench.benchmark.sealed import dense_submission, rebuilt_score, score_check
from phibench.benchmark.sealed.dense_set import DENSE_SEAL, DENSE_SET, DENSE_TRUTH, DenseSeal, DenseSet
from phibench.benchmark.sealed.dense_submission import (
    ANSWERS,
    DenseAnswerLine,
    DenseSubmission,
    SealedDensePairs,
)
from phibench.benchmark.sealed.sealed_set import public_sha256
from phibench.benchmark.sealed.submission import check_complete
from phibench.calibration.captures import imported_set
from phibench.calibration.sensor_fit import fit_sensor
from phibench.calibration.sensor_fit.capture_folder import read_header
from phibench.datasets.build import dataset_build, draws_file
from phibench.datasets.build.dataset_build import held_head
from phibench.datasets.build.journal import Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film import moving_camera
from phibench.datasets.frames import frame_files
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import load_recipe, recipe_text
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text, read_checksums
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.layers import write_exr
from phibench.datasets.store.metadata import parse_info
from phibench.datasets.store.pair_files import FRAMES_SET
from phibench.datasets.store.pair_files import PAIRS as LINES
from phibench.render.room.light_map import LightMap, light_map_bytes
from phibench.studies import run

QUIET = Console(quiet=True)


# -- data sets and draws ---------------------------------------------------------------------------------------------


def _held(text: str, path: Path) -> object:
    """What `dataset make` and `release` look at in a folder that is there."""
    info = parse_info(text)
    folder = path.parent
    (folder / schema.RECIPE).write_text(recipe_text("bench-dev"))
    dataset_build._info_text(info, Journal(folder), folder)
    held_head(folder)
    part = PARTS[0]
    release_make._misfit(_request(folder), part, folder)
    return release_make._sample_count(part, folder)


def _request(folder: Path) -> ReleaseRequest:
    return ReleaseRequest(PARTS[:1], folder / "out", folder / "work", folder / "seed", console=QUIET)


def _recipe_of_release(path: Path) -> object:
    (path.parent / schema.INFO).write_text("{}")
    return release_make._misfit(_request(path.parent), PARTS[0], path.parent)


def _sealed_of_release(path: Path) -> object:
    """A sealed set that `release` finds where it would make one."""
    part, work = next(one for one in PARTS if one.kind == "sealed"), path.parent / "work"
    public = work / f"{part.title}-public"
    public.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, public / path.name)
    shutil.copyfile(path, path.parent / f"seal_{TEXT[:16]}.truth.json")
    request = replace(_request(path.parent), work=work)
    folder = release_make._dataset(request, part, {part.title: path.parent}, lambda *_: None)
    return release_make._sample_count(part, folder)


def _draws() -> tuple[bytes, Callable[[Path], object], Callable[[random.Random], bytes]]:
    """A file of draws, its reader, and one with faults under a hash that fits."""
    recipe = replace_samples(load_recipe("bench-dev"))
    spot = {"tries": 3, "surface": "wall", "position_world_m": [1.0, 0.0, 0.5], "normal_world": [-1.0, 0.0, 0.0]}
    spot |= {"diameter_m": 0.004, "beam_direction_world": None, "causes": ["none", "none"]}
    document = [draws_file._key(recipe, RoomFiles()), {"0": spot, "1": "there is no place"}]

    def signed(content: Any) -> bytes:
        text = compact(content)
        return hashlib.sha256(text).hexdigest().encode() + b"\n" + text

    def read(path: Path) -> object:
        return draws_file.read_draws(path.parent, recipe, RoomFiles())

    return signed(document), read, lambda rng: signed(changed(document, rng))


def replace_samples(recipe: Any) -> Any:
    return recipe.model_copy(update={"random": recipe.random.model_copy(update={"samples": 2})})


# -- frames and exports ----------------------------------------------------------------------------------------------

WANTED = {"preset": "mjpeg", "draws": 2, "exposure_s": 0.01, "region": [0, 0, 4, 4]}


def _frames(path: Path) -> object:
    (path.parent / "a.png").touch()
    return frame_files.claim(path.parent, ("paper", 2**128 + 7), WANTED)


# -- baked rooms -----------------------------------------------------------------------------------------------------


def _baked(folder: Path) -> tuple[bytes, bytes]:
    """`rooms.json` and the light map of a room without light, of texels of 2 m."""
    source, room = moving_camera._drawn_room(None, "fuzz", 0)
    dark = moving_camera.BakedRoom("room000", room, 2.0, np.zeros((0, 3), np.float32))
    zeros = np.zeros((dark.lit.texels.count, 3), np.float32)
    light = light_map_bytes(LightMap(zeros, zeros, np.zeros(len(zeros), bool)))
    info = {"name": "room000", "source": to_json(source), "digest": room.digest, "texel_m": 2.0}
    return compact({"kind": "phibench baked rooms", "version": 1, "rooms": [info]}), light


def _rooms(other: str, data: bytes, path: Path) -> object:
    (path.parent / other).write_bytes(data)
    return moving_camera.open_baked_rooms(path.parent)


# -- imported sets ---------------------------------------------------------------------------------------------------


def _imported(info: bytes, rows: bytes, picture: bytes, path: Path) -> object:
    """Open an imported set, one file of which is at the path, and read its pictures."""
    folder = path.parent
    files = {imported_set.INFO: info, imported_set.ROWS: rows, "frames/a.png": picture}
    (folder / "frames").mkdir(exist_ok=True)
    place = "frames/a.png" if path.suffix == ".png" else path.name
    files[place] = path.read_bytes()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    sums = checksums_text({name: digest(data) for name, data in files.items()})
    (folder / "SHA256SUMS").write_text(sums)
    opened = imported_set.open_imported(folder)
    pairs = imported_set.imported_pairs(opened, 6)
    return [pairs.pair(number) for number in range(len(pairs))]


def _imported_files() -> tuple[bytes, bytes]:
    row = public_rows()[0]
    info = {"format": imported_set.FORMAT, "name": "mine", "pairs": 1, "rig": row["rig"], "card": row["card"]}
    info |= {"beam": None, "assumed": False, "sensor": "as told", "phibench": None}
    files = {"down": "frames/a.png", "up": "frames/a.png"}
    line = {"number": 0, "sample_id": "a", "draw": 0, "files": files, "stroke_m": 0.5}
    return compact(info), compact({**line, "depth_m": 2.0, "depth_sigma_m": 0.01})


# -- pictures --------------------------------------------------------------------------------------------------------


def _header(path: Path) -> object:
    capture = SimpleNamespace(kind="mjpeg", dark=SimpleNamespace(files=[path]), edges=None, chessboards=None)
    for name in ("flats", "exposures", "dark_exposures"):
        setattr(capture, name, ())
    fit_sensor._take_jpeg(cast(Any, SimpleNamespace(take=lambda *_: None)), cast(Any, capture))
    return read_header(path.read_bytes(), path.name)


def _in_a_score(path: Path) -> object:
    fields = {"kind": "png", "first_px": (0, 0), "step_px": 1, "size": (64, 48)}
    given = EncodedPicture.model_validate({**fields, "base64": path.read_bytes().decode("latin-1")})
    right = EncodedPicture.model_validate({**fields, "base64": base64.b64encode(of_other_bytes()).decode()})
    if not rebuilt_score.pictures_alike(given, right):
        raise DatasetError("another picture")
    return rebuilt_score._pixels(given)


def _drawing(path: Path) -> object:
    study = {"kind": "phibench study", "version": 2, "name": "noise", "title": "t", "question": "q", "quick": True}
    study |= {"settings": {"a": 1}, "findings": [], "notes": ["n"], "shown": {"a": [["b"]]}, "provenance": {}}
    study |= {"files": {}, "drawings": [{"name": path.stem, "kind": path.suffix[1:], "alt": "a drawing"}]}
    (path.parent / run.DOCUMENT).write_bytes(compact(study))
    return run.section(path.parent)


def of_other_bytes() -> bytes:
    """The picture of `png`, as another coder would write it."""
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(buffer, "PNG", compress_level=0)
    return buffer.getvalue()


def _frames_set(name: str, path: Path) -> object:
    """A frames set whose file of this name was damaged, with hashes that fit; its lines are read."""
    data = path.read_bytes()
    folder = path.parent / "frames-set"
    folder.mkdir(exist_ok=True)
    info = json.loads((SHIPPED / FRAMES_SET).read_text()) | {"pairs": 1, "samples": 1}
    files = {FRAMES_SET: compact(info), LINES: _one_line(), name: data}
    for file, content in files.items():
        (folder / file).write_bytes(content)
    hashes = {file: hashlib.sha256(content).hexdigest() for file, content in files.items()}
    (folder / schema.CHECKSUMS).write_text(checksums_text(hashes))
    opened = FramesSet(folder)
    return [opened.truth(number) for number in range(len(opened))], opened.document()


def _one_line() -> bytes:
    first = (SHIPPED / LINES).read_bytes().splitlines(keepends=True)[0]
    return compact(json.loads(first) | {"number": 0}) + b"\n"


def _dense_set(name: str, path: Path) -> object:
    """A dense set whose file of this name was damaged, with hashes that fit; its planes are missing."""
    folder = path.parent / "dense-set"
    folder.mkdir(exist_ok=True)
    files = {DENSE_SET: _DENSE_INFO, LINES: _dense_line(), name: path.read_bytes()}
    for file, content in files.items():
        (folder / file).write_bytes(content)
    hashes = {file: hashlib.sha256(content).hexdigest() for file, content in files.items()}
    (folder / schema.CHECKSUMS).write_text(checksums_text(hashes))
    opened = DenseSet(folder)
    return len(opened), opened.document()


_DENSE_INFO = compact({"format": "phibench dense set 1", "task_version": 1, "pairs": 1, "source": {"name": "a"}})


def _dense_line() -> bytes:
    first = json.loads(_one_line())
    truth = {name: first["truth"][name] for name in ("sample_id", "draw", "preset", "stroke_m", "true_rig")}
    truth |= {"room": "lab", "object_names": ["floor"], "planes": "truth/0.exr"}
    return compact(first | {"truth": truth}) + b"\n"


_ANSWER = f"{ANSWERS}/000000.exr"
DENSE_ANSWERS = (DENSE_SEAL, DENSE_TRUTH, "dense-submission.json", "dense-answer.exr")
"""Files of a sealed dense set, its truth and a submission: one pair that was answered."""


def _listed(folder: Path, files: dict[str, bytes]) -> str:
    """Write files of a folder and their list; its hash."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    text = checksums_text({name: digest(content) for name, content in files.items()})
    (folder / schema.CHECKSUMS).write_text(text)
    return digest(text.encode())


def _dense_answers(replaced: str, path: Path) -> object:
    """A submission opened, one file of it, of the sealed set or its truth damaged, with hashes that fit."""
    folder, own = path.parent / "dense-answers", path.read_bytes()
    line = _dense_line()
    public_line = compact({key: value for key, value in json.loads(line).items() if key != "truth"}) + b"\n"
    sums = _listed(folder / "set", {DENSE_SET: _DENSE_INFO, LINES: line})
    truth = own if replaced == DENSE_TRUTH else compact({"salt": TEXT, "sums_sha256": sums})
    (folder / "set" / DENSE_TRUTH).write_bytes(truth)
    seal = DenseSeal(
        task_version=1, pairs=1, public_sha256=public_sha256({LINES: digest(public_line)}), truth_sha256=digest(truth)
    )
    told = own if replaced == DENSE_SEAL else compact(seal.model_dump(mode="json"))
    _listed(folder / "public", {LINES: public_line, DENSE_SEAL: told})
    pairs = SealedDensePairs(folder / "public")
    pairs.check()
    true = dense_submission._true_set(folder / "set" / DENSE_TRUTH, pairs)
    submitted = own if replaced == "dense-submission.json" else _dense_answer_lines(pairs.seal.id)
    answer = own if replaced == "dense-answer.exr" else _dense_answer(path.parent / "whole.exr")
    _listed(folder / "sent", {dense_submission.SUBMISSION: submitted, _ANSWER: answer})
    document = dense_submission._read_submission(folder / "sent")
    check_complete(document, pairs.seal, "it")
    listed = read_checksums(folder / "sent")
    return len(true), dense_submission._answer(folder / "sent", document.answers[0], listed, (2, 3))


def _dense_answer_lines(seal: str) -> bytes:
    line = {"number": 0, "file": _ANSWER, "seconds": 1.0, "failure": "", "message": ""}
    submission = DenseSubmission(
        seal=seal, task_version=1, method=MethodCard.of("mine"), provenance={}, answers=(DenseAnswerLine(**line),)
    )
    return compact(submission.model_dump(mode="json"))


def _dense_answer(path: Path) -> bytes:
    return write_exr(path, {"depth_m": np.ones((2, 3))}, {}).read_bytes()


def _dense_answer_kinds(folder: Path) -> list[Kind]:
    line = _dense_line()
    public_line = compact({key: value for key, value in json.loads(line).items() if key != "truth"}) + b"\n"
    sums = checksums_text({DENSE_SET: digest(_DENSE_INFO), LINES: digest(line)})
    truth = compact({"salt": TEXT, "sums_sha256": digest(sums.encode())})
    content = public_sha256({LINES: digest(public_line)})
    seal = DenseSeal(task_version=1, pairs=1, public_sha256=content, truth_sha256=digest(truth))
    data = {
        DENSE_SEAL: compact(seal.model_dump(mode="json")),
        DENSE_TRUTH: truth,
        "dense-submission.json": _dense_answer_lines(seal.id),
        "dense-answer.exr": _dense_answer(folder / "dense-answer.exr"),
    }
    signs = {name: compact if name.endswith("json") else None for name in data}
    return [Kind(name, data[name], partial(_dense_answers, name), signs[name]) for name in DENSE_ANSWERS]


def folder_kinds(folder: Path, dataset: Path) -> dict[str, Kind]:
    """Targets by the name of their file."""
    opened = open_finished(dataset)
    info_text = (dataset / schema.INFO).read_text()
    exported = ExportRequest("frames", FrameOptions("srgb8"), 1)
    export_make._claim(folder, opened, exported)
    rooms, light = _baked(folder)
    info, rows = _imported_files()
    of_frames = compact(json.loads((SHIPPED / FRAMES_SET).read_text()) | {"pairs": 1})
    draws, read_draws, forged = _draws()
    manifest = {"parts": {"a": {"sums_sha256": TEXT}, "b": {"sums_sha256": TEXT}}}
    score = cast(ScoreDocument, SimpleNamespace(pair_set={"dataset_sha256": TEXT}))
    held = {"dataset": "paper", "dataset_seed": 2**128 + 7, **WANTED}
    every = [
        Kind(schema.INFO, info_text.encode(), partial(_held, info_text), compact),
        Kind(schema.RECIPE, recipe_text("bench-dev").encode(), _recipe_of_release),
        Kind("seal.json", compact({"id": TEXT[:16], "pairs": 2}), _sealed_of_release, compact),
        Kind(schema.DRAWS, draws, read_draws, forge=forged),
        Kind(
            export_make.INFO,
            (folder / export_make.INFO).read_bytes(),
            lambda path: export_make._claim(path.parent, opened, exported),
            compact,
        ),
        Kind(frame_files.REQUEST, compact(held), _frames, compact),
        Kind(moving_camera.INFO, rooms, partial(_rooms, "room000.npz", light), compact),
        Kind("room000.npz", light, partial(_rooms, moving_camera.INFO, rooms)),
        Kind(
            FRAMES_SET,
            of_frames,
            partial(_frames_set, FRAMES_SET),
            compact,
        ),
        Kind("lines-of-frames.jsonl", _one_line(), partial(_frames_set, LINES), compact),
        Kind(DENSE_SET, _DENSE_INFO, partial(_dense_set, DENSE_SET), compact),
        Kind("lines-of-dense.jsonl", _dense_line(), partial(_dense_set, LINES), compact),
        *_dense_answer_kinds(folder),
        Kind(imported_set.INFO, info, partial(_imported, info, rows, png()), compact),
        Kind(imported_set.ROWS, rows, partial(_imported, info, rows, png()), compact),
        Kind("imported.png", png(), partial(_imported, info, rows, png())),
        Kind("header.jpg", jpeg(), _header),
        Kind("encoded.txt", base64.b64encode(png()), _in_a_score),
        Kind("drawing.svg", b'<svg xmlns="http://www.w3.org/2000/svg"/>', _drawing),
        Kind(
            "manifest-of-a-release.json",
            compact(manifest),
            lambda path: list(score_check._of_release(score, path)),
            compact,
        ),
    ]
    return {kind.name: kind for kind in every}


ALWAYS_READ = (schema.DRAWS, "drawing.svg")
"""Of any content there is an answer: damaged draws are drawn anew, a drawing is shown as a picture."""
