"""File of drawn samples that a folder keeps, written and read; and the causes for which images do not show spots.

With it the next start need not draw and trace each anew. It holds no truth and nothing that is signed: without it, or
where it is damaged or of another recipe or code, samples are drawn anew, to the same plan. `verify`, `repair` and
`merge` do not read it.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.plan.draws import Causes, KeptSample, KeptSamples, room_files
from phibench.datasets.plan.pair_forecasts import pair_forecasts
from phibench.datasets.plan.plan import Plan
from phibench.datasets.plan.sampling import HIDDEN_TRIES
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.datasets.store import schema
from phibench.datasets.store.files import write_bytes
from phibench.datasets.store.provenance import PACKAGES, code_behind, provenance

_MODULE = "phibench.datasets.plan.plan"
_NOT_DRAWN = ("frames", "distractors", "ambient")  # tables on which no draw depends


def seen_causes(plan: Plan) -> dict[str, Causes]:
    """Causes of both views of every pair by id: those that are known, the others traced; nothing is rendered."""
    open_ = [pair for pair in plan.pairs if pair.sample_id not in plan.seen]
    traced = {
        forecast.pair.sample_id: (forecast.down.cause, forecast.up.cause) for forecast in pair_forecasts(plan, open_)
    }
    known = {**plan.seen, **traced}
    return {pair.sample_id: known[pair.sample_id] for pair in plan.pairs}


def read_draws(out: Path, recipe: Recipe, files: RoomFiles) -> KeptSamples:
    """Draws that a folder keeps of a recipe's samples; none where they are of something else, or damaged."""
    path = out / schema.DRAWS
    if recipe.random is None or not path.is_file():
        return {}  # experiments draw nothing
    try:
        data = InputFile(path, "remove it").read()
        digest, _, text = data.partition(b"\n")
        if hashlib.sha256(text).hexdigest().encode() != digest:
            return {}  # it was cut off, or changed by hand
        document = _FILE.validate_json(text, strict=True)
        if document[0] != _key(recipe, files):
            return {}
    # a file of kept draws is a saving alone: without it samples are drawn anew
    except (DatasetError, ValidationError, RoomError):
        return {}
    return {number: draw for number, draw in document[1].items() if isinstance(draw, str) or _is_draw(draw)}


def _is_draw(one: KeptSample) -> bool:
    return 1 <= one.tries <= HIDDEN_TRIES


def draws_bytes(plan: Plan, causes: dict[str, Causes]) -> bytes:
    """File of the draws of a plan; causes are those of `seen_causes`."""
    text = json.dumps([_key(plan.recipe, plan.files), dict(_outcomes(plan, causes))], allow_nan=False).encode()
    return hashlib.sha256(text).hexdigest().encode() + b"\n" + text


def write_draws(out: Path, data: bytes) -> None:
    """Write the file of a folder, unless it has these bytes."""
    path = out / schema.DRAWS
    if not (path.is_file() and path.read_bytes() == data):
        write_bytes(path, data)


def _outcomes(plan: Plan, causes: dict[str, Causes]) -> Iterator[tuple[int, Any]]:
    for pair in plan.pairs:
        spot = plan.spots[pair.spot]
        vectors = (spot.position_world_m, spot.normal_world, spot.diameter_m, spot.beam_direction_world)
        yield _number(pair.sample_id), vars(KeptSample(pair.tries, pair.target, *vectors, causes[pair.sample_id]))
    for name, reason in plan.refused.items():
        yield _number(name), reason


def _number(sample_id: str) -> int:
    return int(sample_id.rsplit("-", 1)[1])


def _key(recipe: Recipe, files: RoomFiles) -> str:
    """Hash of all that draws depend on; not of how many there are, for none depends on the others."""
    document = recipe.model_dump(mode="json", exclude={*_NOT_DRAWN})
    document["random"].pop("samples")
    versions = provenance()["packages"]
    used = [versions, PACKAGES, platform.python_version(), f"{platform.system()} {platform.machine()}"]
    inputs = [document, code_behind(_MODULE), used, dict(room_files(recipe, files).digests)]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, allow_nan=False).encode()).hexdigest()


_FILE: TypeAdapter[tuple[str, dict[int, KeptSample | str]]] = TypeAdapter(tuple[str, dict[int, KeptSample | str]])
