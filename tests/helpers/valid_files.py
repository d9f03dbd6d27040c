"""Valid files of every kind that phibench reads, made in a moment and without rendering, and faults to put into them.

Not a test file. The files are small: a camera of 64 x 48 pixels, two pairs, four records.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
import random
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from helpers.bench_cases import cases, outcomes, truth_itself
from helpers.colour_profiles import edited_profile
from PIL import Image

from phibench.benchmark.isolation.method_references import Reference
from phibench.benchmark.pair_sets.frames_set import read_truth_file, truth_text
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score import score_outcomes
from phibench.benchmark.scores.score_document import MethodCard
from phibench.benchmark.scores.score_files import read_records, read_score, write_score
from phibench.benchmark.sealed.sealed_set import (
    FORMAT,
    PAIRS,
    SEAL,
    public_sha256,
    seal_id,
)
from phibench.benchmark.sealed.submission import SealedPairs, outcomes_of, read_submission, submission
from phibench.calibration.captures.picture_files import read_linear, read_picture
from phibench.calibration.rig.bundle import Bundle
from phibench.calibration.rig.calibration_file import read_calibration, write_calibration
from phibench.datasets.build import bake_task
from phibench.datasets.build.bake_task import read_light_map
from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_files import read_index
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.panorama_files import read_panorama
from phibench.datasets.store import schema, sensitivity_file
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.layers import read_layer, write_exr
from phibench.datasets.store.sensitivity_file import read_sensitivities
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.render.room.light_map import LightMap, light_map_bytes
from phibench.scenes.rig import Rig
from phibench.studies.framework import read_settings
from phibench.studies.run import find_study, read_study

ROOT = Path(__file__).resolve().parents[2]
TEXT = "0123456789abcdef" * 4  # a digest


def compact(document: Any) -> bytes:
    return json.dumps(document).encode()


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def png(width: int = 64, height: int = 48) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((height, width, 3), np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def panorama() -> bytes:
    """Photograph of 2 : 1 with a colour profile and what XMP says of its sphere."""
    buffer, stated = io.BytesIO(), b"<GPano:PosePitchDegrees>0.5</GPano:PosePitchDegrees>"
    Image.new("RGB", (64, 32), (90, 60, 30)).save(buffer, "JPEG", icc_profile=edited_profile(gamma=1.8), xmp=stated)
    return buffer.getvalue()


# -- a sealed set --------------------------------------------------------------------------------------------------


def public_rows() -> list[dict[str, Any]]:
    rig = Rig()
    rig = replace(rig, camera=replace(rig.camera, width_px=64, height_px=48, cx_px=31.5, cy_px=23.5))
    row = {"stroke_m": 0.5, "rig": to_json(rig), "card": to_json(sensor_card("srgb8")), "beam": None}
    row |= {"box_down": {"u0_px": 1, "v0_px": 2, "width_px": 8, "height_px": 8}, "box_up": None}
    return [{"number": k, "files": {p: f"frames/{k:06d}-{p}.png" for p in ("down", "up")}, **row} for k in range(2)]


def write_sealed(folder: Path, rows: list[Any] | None = None, picture: bytes | None = None, **seal: Any) -> Path:
    """Sealed set whose hashes fit, whatever its rows and pictures are."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    lines = public_rows() if rows is None else rows
    files = {PAIRS: b"".join(compact(row) + b"\n" for row in lines)}
    files |= {f"frames/{k:06d}-{p}.png": picture or png() for k in range(2) for p in ("down", "up")}
    content = public_sha256({name: digest(data) for name, data in files.items()})
    document = {"format": FORMAT, "id": seal_id(content, TEXT), "task_version": 3, "pairs": 2}
    document |= {"public_sha256": content, "truth_sha256": TEXT, "phibench": None, **seal}
    files[SEAL] = compact(document)
    files["SHA256SUMS"] = checksums_text({name: digest(data) for name, data in files.items()}).encode()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def read_sealed(folder: Path) -> None:
    pairs = SealedPairs(folder)
    pairs.check()
    for number in range(len(pairs)):
        pairs.pair(number)


# -- the files of every kind ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes
    ----------
    data : valid bytes
    read : reads the file at a path, with what belongs to it beside it
    sign : new bytes of a changed document, so that its hash fits; None where there is no hash
    forge : a file of faults under hashes that fit, where it is no JSON document
    """

    name: str
    data: bytes
    read: Callable[[Path], object]
    sign: Callable[[Any], bytes] | None = None
    forge: Callable[[random.Random], bytes] | None = None


def signed_calibration(document: Any) -> bytes:
    if isinstance(document, dict):
        content = {key: value for key, value in document.items() if key != "sha256"}
        document = {**content, "sha256": digest(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())}
    return compact(document)


def journal_bytes(folder: Path) -> bytes:
    with Journal(folder) as journal:
        journal.begin(FolderHead("{}", "text"), [])
        journal.add(Entry("spot a", TEXT, {"spots/a-down.exr": TEXT}, {"down": None}))
    return (folder / "journal.txt").read_bytes()


@cache
def kinds(folder: Path) -> dict[str, Kind]:
    """All kinds; `folder` is empty and for the first writing."""
    rig, p = Rig(), len(PARAMETERS)
    bundle = Bundle(rig, np.zeros(p), np.eye(p) * 1e-6, 1.0, 2)
    write_calibration(folder / "calibration.json", bundle, rig, {"samples": ["a"]})
    pairs = cases(4)
    scored = score_outcomes(MethodCard.of("mine"), pairs, outcomes(pairs, truth_itself), Rules())
    score = write_score(folder / "score.json", scored.document, scored.records)
    write_exr(folder / "layer.exr", {"R": np.ones((4, 6))}, {"kind": "ambient", "pose": "h0"})
    seal = SealedPairs(write_sealed(folder / "public")).seal
    answers = submission(seal, Reference("mine", "built-in", "here"), outcomes(cases(2), truth_itself))
    truth = truth_text(list(pairs.truths), TEXT, TEXT).encode()
    study = {"kind": "phibench study", "version": 2, "name": "noise", "title": "t", "question": "q", "quick": True}
    study |= {"settings": {"a": 1}, "findings": [], "notes": ["n"], "drawings": [], "shown": {"a": [["b"]]}}
    data = {name: (folder / name).read_bytes() for name in ("calibration.json", "layer.exr", "score.json")}
    records = (folder / "score.parquet").read_bytes()
    noise = find_study("noise")
    every = [
        Kind("recipe.toml", (ROOT / "tests" / "tiny_bench.toml").read_bytes(), load_recipe),
        Kind("settings.toml", settings_bytes(), lambda path: read_settings(noise, path=path)),
        Kind("calibration.json", data["calibration.json"], read_calibration, signed_calibration),
        Kind("score.json", data["score.json"], lambda path: read_score(path).whole, compact),
        Kind("records.parquet", records, lambda path: _records(path, score)),
        Kind("layer.exr", data["layer.exr"], lambda path: read_layer(path, "ambient", ("R",), pose="h0")),
        Kind("picture.png", png(), read_picture),
        Kind("panorama.jpg", panorama(), lambda path: (read_panorama(path), read_linear(path))),
        Kind("submission.json", compact(answers.model_dump(mode="json")), _submission, compact),
        Kind("truth.json", truth, lambda path: read_truth_file(path, digest(path.read_bytes())), compact),
        Kind("study.json", compact({**study, "files": {}, "provenance": {}}), lambda path: read_study(path.parent)),
        Kind("frames.jsonl", compact(FRAME), lambda path: read_index(path.parent), compact),
        Kind(
            schema.light_map_file("room"),
            light_map_bytes(LIGHT),
            lambda path: read_light_map(path.parent, "room"),
            forge=forged_light,
        ),
        Kind(
            "entry.lightmap",
            entry_bytes(light_map_bytes(LIGHT)),
            read_entry,
            forge=lambda rng: entry_bytes(forged_light(rng)),
        ),
        Kind(schema.SENSITIVITIES, *sensitivity_kind(folder)),
        Kind("journal.txt", journal_bytes(folder), lambda path: Journal(path.parent)),
    ]
    return {kind.name: kind for kind in every}


def settings_bytes() -> bytes:
    return (ROOT / "studies" / "noise" / "settings.toml").read_bytes()


def _submission(path: Path) -> object:
    return outcomes_of(read_submission(path))


def _records(path: Path, score: Any) -> object:
    fitting = score.model_copy(update={"records": path.name, "records_sha256": digest(path.read_bytes())})
    return read_records(path.with_suffix(".json"), fitting).select("visible", "detected", "counted_px").sum()


# -- light maps and the table of sensitivities ----------------------------------------------------------------------

LIGHT = LightMap(np.ones((6, 3), np.float32), np.zeros((6, 3), np.float32), np.zeros(6, bool))
BAKED = b'{"room": "small"}'


def npz(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def npy_members() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(light_map_bytes(LIGHT))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def reshaped(data: bytes, shape: bytes) -> bytes:
    """An `.npy` file whose header tells another shape, in as many bytes."""
    return re.sub(rb"\(6,( 3)?\), \} *", lambda found: (shape + b", }").ljust(len(found[0])), data)


def forged_light(rng: random.Random) -> bytes:
    """A light map with a fault in one array, under CRCs that fit."""
    members = npy_members()
    name = rng.choice(list(members))
    if rng.random() < 0.5:
        members[name] = reshaped(
            members[name], rng.choice((b"(-6, -3)", b"(10**99, 3)", b"(999999999999, 3)", b"(((("))
        )
    else:
        members[name] = damaged(members[name], rng)
    return npz(members)


def entry_bytes(payload: bytes) -> bytes:
    """Entry of the cache of light maps, with the hash of its content."""
    body = BAKED + b"\n" + payload
    return b"\n".join([bake_task._FORM, digest(body).encode(), body])


def forged_entry(rng: random.Random) -> bytes:
    return entry_bytes(forged_light(rng))


def read_entry(path: Path) -> LightMap:
    light = bake_task._read(path, BAKED)
    if light is None:
        raise DatasetError("baked again")
    return light


def sensitivity_table() -> pl.DataFrame:
    words = {"sample_id": ["a", "b"], "estimator": ["paper"] * 2, "cause": ["none"] * 2}
    return pl.DataFrame({**words, "depth_m": [1.0, 2.0], "estimate_m": [1.0, None], "truth_m_per_cx_px": [0.1, None]})


def signed_table(data: bytes) -> bytes:
    """A table with the hash that it must hold, if it still has a place for one."""
    own = sensitivity_file._OWN.search(data)
    return data if own is None else data.replace(own[1], digest(data.replace(own[1], sensitivity_file._PLACE)).encode())


def sensitivity_kind(folder: Path) -> tuple[bytes, Callable[[Path], object], None, Callable[[random.Random], bytes]]:
    (folder / schema.CHECKSUMS).write_bytes(b"")
    written = sensitivity_file.sensitivity_bytes(sensitivity_table(), folder)

    def forge(rng: random.Random) -> bytes:
        table = sensitivity_table()
        name = rng.choice(table.columns)
        act = rng.randrange(4)
        if act == 0:
            return signed_table(damaged(written, rng))
        if act == 1:
            table = table.rename({name: rng.choice(NASTY_TEXTS).encode("utf-8", "replace").decode()})
        elif act == 2:
            table = table.drop(name)
        else:
            nasty = [value for value in NASTY if isinstance(value, float | str | None) and value != "\ud800"]
            table = table.with_columns(pl.Series(name, [rng.choice(nasty)] * 2, strict=False))
        return sensitivity_file.sensitivity_bytes(table, folder)

    return written, lambda path: read_sensitivities(path.parent), None, forge


FRAME: dict[str, Any] = {
    **{"file": "a-down.png", "sha256": TEXT, "kind": "frame", "values": "sRGB", "dataset": "a", "dataset_seed": 1},
    **{"sample_id": "a", "position": "down", "laser": "on", "draw": 0, "preset": "srgb8", "exposure_s": 0.1},
    **{"jpeg_quality": None, "laser_level": 1.0, "lamp_level": 1.0},
    **{"analogue_gain": 1.0, "u0_px": 0, "v0_px": 0, "width_px": 4, "height_px": 4, "depth_m": 1.0, "stroke_m": 0.5},
    **{"visible": True, "cause": "none", "u_px": 1.0, "v_px": None, "phi_ray_rad": 0.1, "phi_normal_rad": 0.1},
    **{"phi_incidence_rad": 0.1, "azimuth_rad": 0.1, "sensor": {"a": 1}, "request": {}, "key": TEXT},
}


# -- faults --------------------------------------------------------------------------------------------------------

NASTY_TEXTS = (
    *("", "\x1b[31m", "[/b]", "[red]", "$\\frac{1}$", "[" * 100_000, "\ud800", "../../x", "/etc/passwd", "a\nb"),
    *("nan", "-1", "9" * 5000, "\u202eabc", "a" * 5000, "%s{}", "\0"),
)
NASTY: tuple[Any, ...] = (
    *(None, True, 0, -1, 10**400, 2**63, 1e308, 1e999, -1e999, float("nan"), 1e-320, [], {}, [[]], [1, [2]]),
    *({"": 0}, [None] * 100, {"a": {"b": {}}}, *NASTY_TEXTS),
)


def nested(levels: int) -> Any:
    document: Any = 0
    for _ in range(levels):
        document = [document]
    return document


def places(document: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Every (container, key) of a document."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items if isinstance(document, dict | list) else ():
        found.append((document, key))
        if isinstance(value, dict | list):
            places(value, found)
    return found


def changed(document: Any, rng: random.Random) -> Any:
    """The document with one to three faults: a value of another kind, a key gone, renamed or new."""
    document = json.loads(json.dumps(document))
    for _ in range(rng.randint(1, 3)):
        if not (known := places(document, [])):
            return rng.choice(NASTY)
        inner, key = rng.choice(known)
        act = rng.randrange(6)
        if act == 0:
            del inner[key]
        elif act == 1 and isinstance(inner, dict):
            inner[rng.choice(NASTY_TEXTS)] = inner.pop(key)
        elif act == 2:
            inner[key] = nested(rng.choice((50, 70, 300)))
        else:
            inner[key] = copy.deepcopy(rng.choice(NASTY))  # the next fault may lie in it
    return document


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The bytes with bits turned, a piece gone, twice, in another place, or replaced by something nasty."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
        end = min(end, at + rng.choice((1, 4, 64, len(data))))
        act = rng.randrange(6)
        if act == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif act == 1:
            del data[at:end]
        elif act == 2:
            data[at:at] = data[at:end]
        elif act == 3:
            data[at:end] = rng.choice(NASTY_TEXTS).encode("utf-8", "surrogatepass")
        elif act == 4:
            data[at:end] = rng.choice((b"[", b"{", b'"', b".a", b"9", b"\xff", b"\0", b"=")) * rng.choice((1, 9, 5000))
        else:
            del data[rng.choice((0, at)) :]
    return bytes(data)


def hostile(kind: Kind, rng: random.Random) -> bytes:
    """A file of a kind with faults; of a signed one every other has a hash that fits."""
    if kind.forge is not None and rng.random() < 0.7:
        return kind.forge(rng)
    if kind.sign is not None and rng.random() < 0.7:
        return kind.sign(changed(json.loads(kind.data), rng))
    return damaged(kind.data, rng)
