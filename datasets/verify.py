"""Is a data set what it says it is: every file opened, every truth computed again from the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from phibench.datasets import layout
from phibench.datasets.bake_task import read_light_map
from phibench.datasets.errors import DatasetError
from phibench.datasets.exr import read_exr
from phibench.datasets.layers import SPOT_STACKS, read_ambient, read_ambient_variance, read_spot, read_truth
from phibench.datasets.manifest import differences, same_number
from phibench.datasets.progress import Steps
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.datasets.sample_task import noise_row, spot_noise
from phibench.datasets.schema import PoseInfo, SpotRow
from phibench.datasets.sensitivity_file import sensitivity_fault
from phibench.datasets.spot_task import SpotAnswer, answer_spot
from phibench.datasets.sums import damaged, read_sums, strays
from phibench.datasets.verify_plan import plan_faults
from phibench.render.bake import fixed_shapes
from phibench.render.patches import cut, texel_count
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import Room

_FLOAT32 = 1e-6  # float32 rounds by 6e-8; other machines' libm adds a little
_ANSWERS = 64  # of 0.1 MB each
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
        """Whether there is no fault."""
        return not self.faults


def verify(folder: str | Path, truth_layers: bool = True, console: Console | None = None) -> Report:
    """Check a data set.

    Parameters
    ----------
    folder : path
    truth_layers : bool
        Also compute the truth of every pixel again (about a second per view).
    console : Console, optional
        Where progress goes; by default the standard error.

    Raises
    ------
    DatasetError
        If the folder is not a data set at all.
    """
    folder, console = Path(folder), console or Console(stderr=True)
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}")
    if not (folder / layout.INFO).is_file():
        raise DatasetError(f"{folder} is not a data set: it has no {layout.INFO}")
    try:
        faults, files = damaged(folder), len(read_sums(folder))
        notes = tuple(f"{name} is not part of the data set" for name in strays(folder))
    except DatasetError as error:
        faults, files, notes = [str(error)], 0, ()
    try:
        dataset = open_dataset(folder)
    except DatasetError as error:
        return Report((*faults, str(error)), files, 0, notes)
    bad = {fault.split(" is ", 1)[0] for fault in faults}
    faults += [*plan_faults(dataset), *differences(folder, dataset.rows)]
    faults += filter(None, [sensitivity_fault(folder)])
    faults += _content_faults(dataset, bad, truth_layers, console)
    return Report(tuple(dict.fromkeys(faults)), files, len(dataset), notes)


def _content_faults(dataset: Dataset, bad: set[str], truth_layers: bool, console: Console) -> list[str]:
    """Faults of spots and views; files in `bad` are reported already and not opened."""
    faults: list[str] = []
    answer = lru_cache(_ANSWERS)(answer_spot)  # neighbours share spots and poses
    with Steps(console, "verify", len(dataset) + len(dataset.info.poses)) as steps:
        for sample in dataset:
            for position in POSITIONS:
                faults += _guarded(_spot_faults(sample, position, answer, bad))
            steps.advance()
        if dataset.room.lit and layout.LIGHT_MAP not in bad:
            faults += _guarded(_light_map_faults(dataset))
        for pose in dataset.info.poses:
            faults += _guarded(_view_faults(dataset, pose, bad, truth_layers))
            steps.advance()
    return faults


def _spot_faults(
    sample: Sample, position: str, solve: Callable[[View, LaserSpot, Room], SpotAnswer], bad: set[str]
) -> Iterator[str]:
    row, name = sample.truth_row(position), f"{sample.row.sample_id} {position}"
    answer = solve(sample.view(position), sample.laser_spot, sample.dataset.room)
    for field, expected in _expected(answer):
        if not _same(getattr(row, field), expected):
            yield f"{name}: {field} is {getattr(row, field)}, the parameters give {expected}"
    if answer.certificate is not None and not answer.certificate.passed:
        yield f"{name}: the certificate does not pass when it is computed again"
    if row.spot_file is not None and row.spot_file not in bad:
        yield from _guarded(_spot_layer_faults(sample, position, row, answer))
        if row.view_ambient_file not in bad:
            yield from _guarded(_noise_faults(sample, position, row, answer))


def _expected(answer: SpotAnswer) -> list[tuple[str, Any]]:
    extra = {"coma_shift_px": answer.coma_shift_px, "electrons_per_s": tuple(answer.layer.total_electrons_per_s)}
    return list({**asdict(answer.truth), **extra}.items())


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
    if budget is not None and not budget.kept:
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
    planes = read_ambient(dataset.folder / pose.files["ambient"])
    if planes.shape[1:] != shape:
        yield f"{pose.files['ambient']} has {planes.shape[1:]} pixels instead of {shape}"
    if not np.all(np.isfinite(planes) & (planes >= 0.0)):
        yield f"{pose.files['ambient']} has negative or non-finite electrons"
    variance = read_ambient_variance(dataset.folder / pose.files["ambient"])
    if not np.all(np.isfinite(variance) & (variance >= 0.0)):
        yield f"{pose.files['ambient']} has negative or non-finite variances"


def _light_map_faults(dataset: Dataset) -> Iterator[str]:
    light = read_light_map(dataset.folder)
    texels = texel_count(cut(fixed_shapes(dataset.room), dataset.recipe.ambient.texel_m))
    shapes = {"irradiance_w_m2": (texels, 3), "sigma_w_m2": (texels, 3), "covered": (texels,)}
    for name, shape in shapes.items():
        array = getattr(light, name)
        if array.shape != shape:
            yield f"{layout.LIGHT_MAP}: {name} has the shape {array.shape} instead of {shape}"
        if not np.all(np.isfinite(array) & (array >= 0)):
            yield f"{layout.LIGHT_MAP}: {name} has negative or non-finite values"


def _truth_faults(dataset: Dataset, pose: PoseInfo, shape: tuple[int, int]) -> Iterator[str]:
    from phibench.render.truth import truth_layer

    stored, view = read_truth(dataset.folder / pose.files["truth"]), dataset.rigs[pose.rig].at(pose.offset_m)
    expected = truth_layer(view, dataset.room.shapes(view))
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
