"""Verification of a data set: file hashes, truth computed again, layers.

`verify` checks all hashes and the manifest (`manifest_check`), and compares spots, certificates, noise budgets, layers
and light maps with what the parameters give.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from phibench.datasets.build.bake_task import read_light_map
from phibench.datasets.build.dataset_build import sample_task_name
from phibench.datasets.build.journal import Journal
from phibench.datasets.build.sample_task import noise_row, spot_noise
from phibench.datasets.build.spot_task import SpotAnswer, answer_spot
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.manifest_check import plan_faults
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import (
    damaged_files,
    differing_files,
    held_room_files,
    misplaced_files,
    read_checksums,
    stray_files,
)
from phibench.datasets.store.json_forms import same_number
from phibench.datasets.store.layers import SPOT_STACKS, read_ambient_pair, read_exr, read_spot, read_truth
from phibench.datasets.store.metadata import differences, parse_info
from phibench.datasets.store.schema import LightRow, PoseInfo, SpotRow
from phibench.datasets.store.sensitivity_file import sensitivity_fault
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.spot_layer import spot_light
from phibench.render.optics.truth import mirror_angles
from phibench.render.room.light_map import texel_count
from phibench.render.room.noise_budget import BUDGETS
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import Room

_FLOAT32 = 1e-6  # float32 rounds by 6e-8; other machines' libm adds a little
_ANGLE_RAD = 1e-9  # closed form against ray tracer: 1.3e-7 px of the default rig
_ANSWERS = 64  # of 0.1 MB each
_PARTS = 64  # of a data set, for several workers: opening it takes a second
_EDGE_PIXELS = 8  # pixels whose ray grazes an edge may see another object on another machine


@dataclass(frozen=True)
class Report:
    """Outcome of a verification.

    Attributes
    ----------
    faults : tuple of str
        One sentence each; none means that everything is in order.
    files, samples : int
        How many were looked at.
    notes : tuple of str
        One sentence each on what is odd and no fault, such as a file that is not part of the data set.
    """

    faults: tuple[str, ...]
    files: int
    samples: int
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True if there is no fault."""
        return not self.faults


def verify(folder: str | Path, truth_layers: bool = True, console: Console | None = None, workers: int = 1) -> Report:
    """Check a data set.

    Parameters
    ----------
    folder : path
    truth_layers : bool
        Also compute the truth of every pixel again (about a second per view).
    console : Console, optional
        Where progress goes; by default the standard error.
    workers : int
        Rooms that are looked at at a time, each in a process of its own; 1 is this process.

    Raises
    ------
    DatasetError
        If the folder is not a data set at all.
    """
    folder, console = Path(folder), console or progress_console()
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}")
    if not any((folder / name).is_file() for name in _SIGNS):
        raise DatasetError(f"{folder} is not a data set: it has no {schema.INFO}")
    faults, files, notes = file_faults(folder)
    if not (folder / schema.CHECKSUMS).is_file() and (missing := _missing_samples(folder)):
        others = (fault for fault in faults if not any(name in fault for name in _LAST))
        return Report(_once([missing, *others]), files, 0, notes)
    if not (folder / schema.INFO).is_file():
        lost = f"{schema.INFO} is missing; `phibench dataset repair` writes it anew"
        return Report(_once([lost, *faults]), files, 0, notes)
    try:
        dataset = open_dataset(folder)
    except DatasetError as error:
        return Report(_once([*faults, str(error)]), files, 0, notes)
    # files that are reported already are not opened below: one fault, one sentence
    bad = {fault.split(" is ", 1)[0] for fault in faults}
    faults += plan_faults(dataset)
    if not bad & {schema.MANIFEST, schema.TABLE}:
        faults += differences(folder, dataset.rows)
    faults += _content_faults(dataset, bad, truth_layers, console, workers)
    return Report(_once(faults), files, len(dataset), notes)


def _missing_samples(folder: Path) -> str:
    """One sentence on the samples that an unfinished data set lacks; empty if it lacks none, or nobody can tell."""
    journal = Journal(folder)
    try:
        if journal.head is None:
            return ""
        info = parse_info(journal.head.info)
        plan = make_plan(parse_recipe(journal.head.recipe), held_room_files(folder), info.shard).without(info.causes)
    except ValueError:  # damaged, or of another version
        return ""
    names = [pair.sample_id for pair in plan.pairs if sample_task_name(pair) not in journal.entries]
    if not (names := [*names, *plan.refused]):
        return ""
    what = " is" if len(names) == 1 else f" and {len(names) - 1} more are"
    text = f"{folder} was not finished: {names[0]}{what} missing of {len(plan.pairs) + len(plan.refused)} samples"
    return f"{text}; run `phibench dataset make` again"


_LAST = (schema.INFO, schema.RECIPE, schema.CHECKSUMS)
"""Files that are written when all samples are done."""
_SIGNS = (schema.INFO, schema.JOURNAL, schema.CHECKSUMS, schema.MANIFEST)  # any of them tells a data set


def _once(faults: Iterable[str]) -> tuple[str, ...]:
    """Each fault once; of several sentences on one file being missing or unreadable, the first."""
    told: dict[str, str] = {}
    for fault in faults:
        name, verb, rest = fault.partition(" is ")
        told.setdefault(name + verb if rest.startswith(("missing", "not readable")) else fault, fault)
    return tuple(told.values())


# Files: their kind, and the hashes of SHA256SUMS and journal.


def file_faults(folder: Path) -> tuple[list[str], int, tuple[str, ...]]:
    """Faults of the files as such, their number, and notes on what is odd.

    Every bit of every file counts, but of the diaries and pictures that `schema.NOT_DATA` names: `run.json`,
    `log.jsonl`, `contact_sheet.png`. Without SHA256SUMS the journal's hashes stand in.
    """
    faults, journal = misplaced_files(folder), Journal(folder)
    held = {name: digest for entry in journal.entries.values() for name, digest in entry.files.items()}
    if journal.head is not None:
        texts = {schema.INFO: journal.head.info, schema.RECIPE: journal.head.recipe}
        held |= {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    try:
        faults += damaged_files(folder)
        listed = read_checksums(folder)
    except DatasetError as error:
        faults += [str(error), *differing_files(folder, held), *_journal_faults(folder, journal)]
        return faults + list(filter(None, [sensitivity_fault(folder)])), len(held), ()
    # what has been signed anew after a change is told by the journal
    faults += [
        f"{name} is damaged: its SHA-256 is not that of {schema.JOURNAL}"
        for name in held
        if held[name] != listed.get(name, held[name])
    ]
    faults += _journal_faults(folder, journal)
    if journal.entries:
        unknown = (name for name in listed if schema.is_task_file(name) and name not in held)
        faults += [f"{schema.JOURNAL} is damaged: it has no entry for {name}" for name in unknown]
    faults += filter(None, [sensitivity_fault(folder)])
    return faults, len(listed), tuple(f"{name} is not part of the data set" for name in stray_files(folder))


def _journal_faults(folder: Path, journal: Journal) -> Iterator[str]:
    again = "`phibench dataset repair` writes it anew"
    if not (folder / schema.JOURNAL).exists():
        yield f"{schema.JOURNAL} is missing; {again}"
    elif journal.damaged:
        yield f"{schema.JOURNAL} is damaged: line {journal.damaged[0]} does not have its CRC-32; {again}"
    elif journal.head is None:
        yield f"{schema.JOURNAL} is damaged: its first line is missing; {again}"


# Contents of spots and views.


def _content_faults(dataset: Dataset, bad: set[str], truth_layers: bool, console: Console, workers: int) -> list[str]:
    """Faults of spots and views; files in `bad` are reported already and not opened."""
    rooms = sorted({*dataset.rooms, *(row.room for row in dataset.rows), *(pose.room for pose in dataset.info.poses)})
    steps_of = Counter([*(row.room for row in dataset.rows), *(pose.room for pose in dataset.info.poses)])
    with Steps(console, "verify", steps_of.total()) as steps:
        if workers == 1 or len(rooms) < 2:
            return list(_faults_in_rooms(dataset, rooms, bad, truth_layers, steps.advance))
        bounds = np.linspace(0, len(rooms), min(_PARTS, len(rooms)) + 1).astype(int).tolist()
        parts = [(str(dataset.folder), rooms[a:b], bad, truth_layers) for a, b in pairwise(bounds)]
        found = list[str]()
        for part, faults in zip(parts, parallel_map(_part_faults, parts, workers), strict=True):
            found += faults
            for _ in range(sum(steps_of[room] for room in part[1])):
                steps.advance()
        return found


def _part_faults(part: tuple[str, list[str], set[str], bool]) -> list[str]:
    """Faults in some rooms of a folder, in a process of their own."""
    folder, rooms, bad, truth_layers = part
    return list(_faults_in_rooms(open_dataset(folder), rooms, bad, truth_layers, lambda: None))


def _faults_in_rooms(
    dataset: Dataset, rooms: Sequence[str], bad: set[str], truth_layers: bool, advance: Callable[[], None]
) -> Iterator[str]:
    """Faults of what stands in some rooms, one room after the other: it takes longer to build than to look at."""
    answer = lru_cache(_ANSWERS)(answer_spot)  # neighbours share spots and poses
    samples, poses = defaultdict[str, list[Sample]](list), defaultdict[str, list[PoseInfo]](list)
    for sample in dataset:
        samples[sample.row.room].append(sample)
    for pose in dataset.info.poses:
        poses[pose.room].append(pose)
    for room in rooms:
        for sample in samples[room]:
            for position in POSITIONS:
                yield from _guarded(_spot_faults(sample, position, answer, bad))
            yield from _depth_faults(sample)
            advance()
        if room in dataset.rooms and dataset.rooms.infos[room].lit and schema.light_map_file(room) not in bad:
            yield from _guarded(_light_map_faults(dataset, room))
        for pose in poses[room]:
            yield from _guarded(_view_faults(dataset, pose, bad, truth_layers))
            advance()


def _spot_faults(
    sample: Sample, position: str, solve: Callable[[View, LaserSpot, Room], SpotAnswer], bad: set[str]
) -> Iterator[str]:
    row, name = sample.truth_row(position), f"{sample.row.sample_id} {position}"
    answer = solve(sample.view(position), sample.laser_spot, sample.room)
    for field, expected in _expected(answer):
        if not _same(getattr(row, field), expected):
            yield f"{name}: {field} is {getattr(row, field)}, the parameters give {expected}"
    if row.light is not None:
        yield from _light_faults(sample, position, row.light, answer)
    if answer.certificate is not None and not answer.certificate.passed:
        yield f"{name}: the certificate does not pass when it is computed again"
    if row.spot_file is not None and row.spot_file not in bad:
        yield from _guarded(_spot_layer_faults(sample, position, row, answer))
        if row.view_ambient_file not in bad:
            yield from _guarded(_noise_faults(sample, position, row, answer))


def _depth_faults(sample: Sample) -> Iterator[str]:
    """D of the light is that of its places, by Pythagoras."""
    row = sample.row
    places = [image.light.place_world_m for image in (row.down, row.up) if image.visible and image.light is not None]
    if not places:
        return
    x, y, _ = (math.fsum(values) / len(places) for values in zip(*places, strict=True))
    centre = sample.rig.at(0.0).sphere_centre_m
    expected = math.hypot(x - centre[0], y - centre[1])
    if not same_number(row.light_depth_m, expected, 1e-9, 1e-9):  # rounding of sums in another order
        yield f"{row.sample_id}: light_depth_m is {row.light_depth_m}, the places give {expected}"


def _expected(answer: SpotAnswer) -> list[tuple[str, Any]]:
    extra = {"coma_shift_px": answer.coma_shift_px, "electrons_per_s": tuple(answer.layer.total_electrons_per_s)}
    return list({**asdict(answer.truth), **extra}.items())


def _light_faults(sample: Sample, position: str, light: LightRow, answer: SpotAnswer) -> Iterator[str]:
    """The light's place by the certificate's rays from the film, its angles by the closed form's reflection point.

    The closed form is asked for a point on the ray that leaves the mirror where the light's centre is seen.
    """
    name, view = f"{sample.row.sample_id} {position}", sample.view(position)
    expected = spot_light(view, answer.layer)
    if expected is None or not all(_same(getattr(light, field), value) for field, value in vars(expected).items()):
        yield f"{name}: light is {light}, the parameters give {expected}"
        return
    if answer.certificate is None:
        return
    ray = trace_pixels(view, np.array([[light.u_px, light.v_px]]))
    point = ray.points_m[0] + answer.truth.path_spot_mirror_m * ray.directions[0]
    bare = replace(sample.rig, holder=None).at(view.offset_m)  # the ray as it leaves the mirror, before any glass
    back = mirror_points(bare, point[None], view.camera_centre_m[None])
    leaving = point - back.points_m
    angles = mirror_angles(back.normals, leaving / np.linalg.norm(leaving))
    for field, value in vars(angles).items():
        if not abs(value[0] - getattr(light, field)) <= _ANGLE_RAD:
            yield f"{name}: light.{field} is {getattr(light, field)}, the closed form gives {value[0]}"


def _same(a: Any, b: Any) -> bool:
    """Equality to rounding; sums over quadrature nodes (coma, electrons) round more than closed forms."""
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same_number(x, float(y), 1e-9, 1e-9) for x, y in zip(a, b, strict=True))
    return same_number(a, b) if isinstance(a, float) else bool(a == b)


def _spot_layer_faults(sample: Sample, position: str, row: SpotRow, answer: SpotAnswer) -> Iterator[str]:
    path = sample.dataset.folder / str(row.spot_file)
    header = read_exr(path).header
    if (header.get("sample_id"), header.get("position")) != (sample.row.sample_id, position):
        yield f"{row.spot_file} belongs to {header.get('sample_id')} {header.get('position')}"
        return
    window, layer = read_spot(path), answer.layer
    if (window.u0_px, window.v0_px) != (layer.u0_px, layer.v0_px):
        yield f"{row.spot_file}: its window starts at another pixel than the parameters give"
        return
    for name in SPOT_STACKS:
        stored, expected = getattr(window, name), getattr(layer, name)
        scale = np.abs(expected).max()
        if stored.shape != expected.shape or np.abs(stored - expected).max() > _FLOAT32 * scale:
            yield f"{row.spot_file}: {name} is not what the parameters give"


def _noise_faults(sample: Sample, position: str, row: SpotRow, answer: SpotAnswer) -> Iterator[str]:
    """The noise budget is that of the stored layers, and it is kept."""
    layers = sample.spot(position), sample.ambient(position), sample.ambient_variance(position)
    budget = spot_noise(sample.view(position), answer.truth, *layers)
    expected = None if budget is None else noise_row(budget)
    name = f"{sample.row.sample_id} {position}"
    if expected is None or row.noise is None:
        if expected is not row.noise:
            yield f"{name}: noise is {row.noise}, the layers give {expected}"
        return
    for (field, stored), (_, computed) in zip(row.noise, expected, strict=True):
        if not same_number(stored, computed, _FLOAT32, 0.0):
            yield f"{name}: noise.{field} is {stored}, the layers give {computed}"
    if budget is not None and not budget.kept(BUDGETS[sample.dataset.recipe.ambient.quality]):
        yield f"{name}: the rendering noise is above its budget"


def _view_faults(dataset: Dataset, pose: PoseInfo, bad: set[str], truth_layers: bool) -> Iterator[str]:
    camera = dataset.rigs[pose.rig].camera
    shape = (camera.height_px, camera.width_px)
    for kind in ("ambient", "truth"):
        if pose.files[kind] not in bad:
            yield from _guarded(_header_faults(dataset, pose, kind))
    if pose.files["ambient"] not in bad:
        yield from _guarded(_ambient_faults(dataset, pose, shape))
    if truth_layers and pose.files["truth"] not in bad:
        yield from _guarded(_truth_faults(dataset, pose, shape))


def _header_faults(dataset: Dataset, pose: PoseInfo, kind: str) -> Iterator[str]:
    header = read_exr(dataset.folder / pose.files[kind]).header
    if (header.get("kind"), header.get("pose")) != (kind, pose.pose):
        yield f"{pose.files[kind]} is the {header.get('kind')} layer of {header.get('pose')}"


def _ambient_faults(dataset: Dataset, pose: PoseInfo, shape: tuple[int, int]) -> Iterator[str]:
    planes, variance = read_ambient_pair(dataset.folder / pose.files["ambient"])
    if planes.shape[1:] != shape:
        yield f"{pose.files['ambient']} has {planes.shape[1:]} pixels instead of {shape}"
    if not np.all(np.isfinite(planes) & (planes >= 0.0)):
        yield f"{pose.files['ambient']} has negative or non-finite electrons"
    if not np.all(np.isfinite(variance) & (variance >= 0.0)):
        yield f"{pose.files['ambient']} has negative or non-finite variances"


def _light_map_faults(dataset: Dataset, room_id: str) -> Iterator[str]:
    light, file = read_light_map(dataset.folder, room_id), schema.light_map_file(room_id)
    texels = len(light.covered)  # before version 6 texels were cut in another way
    if dataset.info.schema_version >= 6:
        texels = texel_count(dataset.rooms[room_id], dataset.recipe.ambient.texel_m)
    shapes = {"irradiance_w_m2": (texels, 3), "sigma_w_m2": (texels, 3), "covered": (texels,)}
    for name, shape in shapes.items():
        array = getattr(light, name)
        if array.shape != shape:
            yield f"{file}: {name} has the shape {array.shape} instead of {shape}"
        if not np.all(np.isfinite(array) & (array >= 0)):
            yield f"{file}: {name} has negative or non-finite values"


def _truth_faults(dataset: Dataset, pose: PoseInfo, shape: tuple[int, int]) -> Iterator[str]:
    from phibench.render.optics.room_tracer import room_geometry
    from phibench.render.optics.truth import truth_layer

    view = dataset.rigs[pose.rig].at(pose.offset_m)
    stored = read_truth(dataset.folder / pose.files["truth"], view)
    expected = truth_layer(view, room_geometry(dataset.rooms[pose.room], view))
    for name, plane in stored.items():
        if plane.shape != shape:
            yield f"{pose.files['truth']} has {plane.shape} pixels instead of {shape}"
            return
        same = np.isclose(plane, expected[name], rtol=_FLOAT32, atol=_FLOAT32, equal_nan=True)
        if (wrong := int(np.count_nonzero(~same))) > _EDGE_PIXELS:
            yield f"{pose.files['truth']}: {name} is not what the parameters give at {wrong} pixels"


def _guarded(faults: Iterator[str]) -> Iterator[str]:
    """Turn a file that cannot be read into a fault."""
    try:
        yield from faults
    except DatasetError as error:
        yield str(error)
