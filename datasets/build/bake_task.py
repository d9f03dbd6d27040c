"""Task that bakes a room's light map, the map's reader, and the user's cache of maps: entries, limit, clearing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from phibench.datasets.build.tasks import TaskResult
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.parallel import return_memory
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.files import write_bytes, write_text
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.provenance import code_behind
from phibench.datasets.store.schema import RoomInfo
from phibench.datasets.store.temporary_folders import remove_leftovers
from phibench.render.room.light_map import (
    ARRAYS,
    BakeSettings,
    LightMap,
    bake,
    fixed_shapes,
    light_map_bytes,
    texel_count,
)
from phibench.render.setup.llvm_library import LlvmError, cache_root
from phibench.render.setup.variant import renders_with
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Rectangle, Shape

# Cache of light maps: rooms that were baked once, in the user's cache folder, for all data sets.
#
# An entry is named after the hash of its recipe: all that enters, which is room, settings, code, packages, the variant
# of Mitsuba and the version of LLVM. It holds
# the recipe in full, the arrays, and the SHA-256 of both. It is taken if hash and recipe are right, and if the arrays
# have the shapes of the room and values that its lamps can give. Else the room is baked again.
#
# The cache has a limit; entries that were not used for longest go first. Who writes or removes holds a lock.


LIMIT_MB = 1000.0
"""Limit of a cache that was given none; a room of the default settings has 2 MB."""
_FORM = b"phibench light map 3"
_SUFFIX = ".lightmap"
_LOCK, _LIMIT = ".lock", "limit.txt"
_PATIENCE_S = 10.0  # for another process that writes: a map is written in less
_ENTRY_MB = 1000  # as much as the cache holds by default
# a quadrature point on a lamp may stand nearer to a texel than to the next point, and then counts for too much
_GLARE = 1e3


def light_map_cache() -> Path:
    """Folder of the user's light maps."""
    return cache_root() / "lightmaps"


def light_map(view: View, room: Room, settings: BakeSettings, folder: Path | None = None) -> LightMap:
    """Light map of a room, from the cache or baked now and put there.

    Parameters
    ----------
    view : View
        Any view of the rig; the origin of coordinates is taken from it, and where the robot stands.
    folder : Path, or None for the user's cache
    """
    recipe = _recipe(view, room, settings)
    path = _path(recipe, folder)
    cached = _read(path, recipe)
    if cached is not None and is_sound(cached, room, settings):
        with contextlib.suppress(OSError):  # a cache of somebody else's may be read all the same
            os.utime(path)
        return cached
    baked = bake(view, room, settings)
    with contextlib.suppress(OSError, Timeout):  # a cache that cannot be written costs time, not the light map
        _write(path, recipe, baked)
    return baked


def is_cached(view: View, room: Room, settings: BakeSettings, folder: Path | None = None) -> bool:
    """Tell whether the cache holds the light map, so that `light_map` takes no time."""
    try:
        return _path(_recipe(view, room, settings), folder).is_file()
    except (PackageNotFoundError, LlvmError):  # without Mitsuba nothing has been baked
        return False


def is_sound(light: LightMap, room: Room, settings: BakeSettings) -> bool:
    """Tell whether a light map has the texels of a room, and irradiances that its lamps can give."""
    texels = texel_count(room, settings.texel_m)
    shapes = [array.shape for array in (light.irradiance_w_m2, light.sigma_w_m2, light.covered)]
    types = [array.dtype for array in (light.irradiance_w_m2, light.sigma_w_m2, light.covered)]
    if shapes != [(texels, 3), (texels, 3), (texels,)] or types != [np.float32, np.float32, np.bool_]:
        return False  # of another version, or damaged in spite of its hash
    sun = 0.0 if room.sun is None else max(room.sun.irradiance_w_m2)
    # no hemisphere gives more than pi times the radiance, and no bounce more than the light before it
    most = math.pi * max((_radiance(shape) for shape in fixed_shapes(room)), default=0.0) + sun
    largest = _GLARE * most * (settings.bounces + 2)
    values = np.stack([light.irradiance_w_m2, light.sigma_w_m2])
    return bool(np.all(np.isfinite(values)) and np.all(values >= 0.0) and np.all(values <= largest))


def _radiance(shape: Shape) -> float:
    """Largest radiance that a shape sends out by itself, W/(m^2 sr)."""
    texture = shape.texture
    own = texture.values[..., :3].max() if isinstance(texture, Bitmap) and texture.is_radiance else 0.0
    return float(max(own, *shape.radiance_w_m2_sr) if isinstance(shape, Rectangle) else own)


def _recipe(view: View, room: Room, settings: BakeSettings) -> bytes:
    """All that a light map depends on, as one line of JSON."""
    document = {
        "room": repr((fixed_shapes(room, view.robot), room.sun)),
        "origin_m": repr(tuple(view.sphere_centre_m)),
        "settings": repr(settings),
        "packages": {name: version(name) for name in ("mitsuba", "drjit", "numpy", "scipy")},
        "code": code_behind(LightMap.__module__),
        # sums in another order, by another compiler, differ in their last bits
        "renderer": renders_with(),
    }
    return json.dumps(document, sort_keys=True).encode()


def _path(recipe: bytes, folder: Path | None) -> Path:
    return (folder or light_map_cache()) / f"{hashlib.sha256(recipe).hexdigest()}{_SUFFIX}"


def _read(path: Path, recipe: bytes) -> LightMap | None:
    """The entry, or None if there is none, or one that was not written for this recipe."""
    try:
        file = InputFile(path, "clear the cache", limit_bytes=_ENTRY_MB << 20)
        content = file.read()
        form, digest, body = content.split(b"\n", 2)
        held, payload = body.split(b"\n", 1)
        if (form, held) != (_FORM, recipe) or hashlib.sha256(body).hexdigest().encode() != digest:
            return None  # of another room with the same short name, or damaged
        return LightMap(**file.arrays(ARRAYS, payload))
    except ValueError:  # no entry, or a damaged one
        return None


def _write(path: Path, recipe: bytes, light: LightMap) -> None:
    body = recipe + b"\n" + light_map_bytes(light)
    with _held(path.parent):
        write_bytes(path, b"\n".join([_FORM, hashlib.sha256(body).hexdigest().encode(), body]))
        _shrink(path.parent)


# Size of the cache.


@dataclass(frozen=True)
class CacheEntry:
    """One light map of the cache; `used_s` is the time of its last use, seconds since 1970."""

    path: Path
    size_bytes: int
    used_s: float


def cache_entries(folder: Path | None = None) -> list[CacheEntry]:
    """Light maps of the cache, those last used first."""
    entries = []
    for path in (folder or light_map_cache()).glob(f"*{_SUFFIX}"):
        with contextlib.suppress(OSError):  # gone meanwhile
            status = path.stat()
            entries.append(CacheEntry(path, status.st_size, status.st_mtime))
    return sorted(entries, key=lambda entry: (-entry.used_s, entry.path.name))


def cache_limit_mb(folder: Path | None = None) -> float:
    """Limit of the cache, 1e6 bytes."""
    with contextlib.suppress(OSError, ValueError):  # no file, or a damaged one: the default holds
        text = InputFile((folder or light_map_cache()) / _LIMIT, "set it anew", limit_bytes=100).text()
        if math.isfinite(limit := float(text)) and limit >= 0.0:
            return limit
    return LIMIT_MB


def limit_cache(limit_mb: float, folder: Path | None = None) -> int:
    """Set the limit, 1e6 bytes, for this and all later runs; return how many entries had to go.

    Raises
    ------
    DatasetError
        If that is no limit, or the cache cannot be written.
    """
    if not (math.isfinite(limit_mb) and limit_mb >= 0.0):
        raise DatasetError(f"limit of the cache = {limit_mb} MB: must be 0 or more")
    with _for_user(folder or light_map_cache()) as where:
        write_text(where / _LIMIT, f"{limit_mb!r}\n")
        return _shrink(where)


def clear_cache(folder: Path | None = None) -> int:
    """Remove all entries; return how many.

    Raises
    ------
    DatasetError
        If the cache cannot be written.
    """
    where = folder or light_map_cache()
    if not where.is_dir():
        return 0
    with _for_user(where):
        return _remove(cache_entries(where))


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the cache; then nobody else writes, and what is half-written was left by the dead."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / _LOCK, timeout=_PATIENCE_S):
        remove_leftovers(folder)
        for left in folder.glob(".*.tmp"):  # of versions before 0.3
            left.unlink(missing_ok=True)
        yield


@contextlib.contextmanager
def _for_user(folder: Path) -> Iterator[Path]:
    """Hold the cache; errors are sentences."""
    try:
        with _held(folder):
            yield folder
    except Timeout:
        raise DatasetError(f"another process holds the cache {folder}; try again when it has ended") from None
    except OSError as error:
        text = f"the cache {folder} cannot be written: {error.strerror or error}"
        raise DatasetError(f"{text}; set PHIBENCH_CACHE to a folder of yours") from error


def _shrink(folder: Path) -> int:
    """Remove the entries beyond the limit, those that were not used for longest first; return how many."""
    left, beyond = cache_limit_mb(folder) * 1e6, list[CacheEntry]()
    for entry in cache_entries(folder):
        left -= entry.size_bytes
        if left < 0.0:
            beyond.append(entry)
    return _remove(beyond)


def _remove(entries: list[CacheEntry]) -> int:
    for entry in entries:
        entry.path.unlink(missing_ok=True)
    return len(entries)


def bake_settings(ambient: AmbientTable) -> BakeSettings:
    """Settings of the light map in a recipe."""
    return BakeSettings(**{name: getattr(ambient, name) for name in BakeSettings.__dataclass_fields__})


def bake_room(out: Path, rig: Rig, room_id: str, source: RoomSource, ambient: AmbientTable) -> TaskResult:
    """Task: write a room's light map below `out`, if it has any light; the result is its `RoomInfo`."""
    room, view, file = room_of(source, out / schema.ROOM_FILES), rig.at(0.0), schema.light_map_file(room_id)
    info = RoomInfo(
        room=room_id, source=to_json(source), digest=room.digest, lit=room.lit, object_names=room.object_names(view)
    )
    if not room.lit:
        (out / file).unlink(missing_ok=True)
        return TaskResult((), info.model_dump(mode="json"))
    return_memory()  # a bake's arrays do not fit into what views have left, and would come on top of it
    write_bytes(out / file, light_map_bytes(light_map(view, room, bake_settings(ambient))))
    return_memory()
    return TaskResult((file,), info.model_dump(mode="json"))


def read_light_map(out: Path, room_id: str) -> LightMap:
    """Light map of a room of a data set.

    Raises
    ------
    DatasetError
        If the file is missing or not a light map.
    """
    return LightMap(**InputFile(out / schema.light_map_file(room_id), "run `phibench dataset repair`").arrays(ARRAYS))
