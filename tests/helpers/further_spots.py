"""Further spots in the rooms of a data set: its views are used again, and only the spots are computed.

Not a test file.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from phibench.datasets.build.spot_task import make_spot
from phibench.datasets.common.errors import RefusedSampleError
from phibench.datasets.plan.plan import PairPlan
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.recipe.distributions import quantile
from phibench.datasets.recipe.spot_placement import by_ray, causes_or_fault
from phibench.datasets.rooms.room_sources import SOURCES, RoomSource
from phibench.datasets.store.json_forms import from_json
from phibench.datasets.store.schema import ManifestRow
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig


def with_further_spots(dataset: Dataset, folder: Path, count: int, seed: int) -> Dataset:
    """Data set of `count` other spots for every sample, all visible in both images; their layers lie in `folder`."""
    folder.mkdir(parents=True)
    (folder / "views").symlink_to(dataset.folder.resolve() / "views")
    (folder / "spots").mkdir()
    if (dataset.folder / "rooms").is_dir():
        (folder / "rooms").symlink_to(dataset.folder.resolve() / "rooms")
    rows = [row for k, sample in enumerate(dataset) for row in _rows(sample, folder, count, k, seed)]
    return replace(dataset, folder=folder, rows=tuple(rows))


def _source(sample: Sample) -> RoomSource:
    document = sample.dataset.rooms.info(sample.row.room).source
    kind: type[RoomSource] = SOURCES[str(document["kind"])]
    return from_json(kind, document)


def _rows(sample: Sample, folder: Path, count: int, number: int, seed: int) -> list[ManifestRow]:
    row, room, source = (
        sample.row,
        sample.room,
        _source(sample),
    )
    recipe = sample.dataset.recipe
    assert recipe.random is not None
    table, rng, rows = recipe.random.spot, generator("further spots", seed, row.sample_id), list[ManifestRow]()
    while len(rows) < count:
        u = rng.random((3, 1))
        keys = (table.azimuth_deg, table.height_m, table.elevation_deg)
        [placed] = by_ray(recipe.laser, room, *(quantile(t, x) for t, x in zip(keys, u, strict=True) if t is not None))
        rig: Rig = sample.rig
        if isinstance(placed, str) or isinstance(causes_or_fault(False, rig, row.stroke_m, placed[1], room), str):
            continue
        name = f"random-{1000 * (number + 1) + len(rows):06d}"
        strokes_m = row.stroke_m, row.nominal_stroke_m
        pair = PairPlan(name, "random", placed[0], *strokes_m, name, row.rig, row.nominal_rig, tries=1, room=row.room)
        try:
            made = make_spot(folder, sample.dataset.info.name, rig, source, placed[1], pair)
        except RefusedSampleError:
            continue
        rows.append(ManifestRow.model_validate(made.result))
    return rows
