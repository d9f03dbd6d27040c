"""Light maps on disk, under the hash of everything that enters: room, settings, code, renderer.

An entry is the SHA-256 of its payload followed by the payload; one that does not match is baked again. Nothing is ever
changed in place: temporary name, fsync, rename.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from phibench.render.bake import BakeSettings, LightMap, bake, fixed_shapes
from phibench.render.cache import cache_root
from phibench.scenes.rig import View
from phibench.scenes.room import Room

_DAY_S = 86400.0
_DIGEST = 64  # hexadecimal characters
_CODE = ("bake.py", "surfaces.py", "patches.py", "quasi.py", "translate.py")
ARRAYS = ("irradiance_w_m2", "sigma_w_m2", "covered")


def light_map(view: View, room: Room, settings: BakeSettings, folder: Path | None = None) -> LightMap:
    """Light map of a room, from the cache or baked now and put there.

    Parameters
    ----------
    view : View
        Any view of the rig; only the origin of coordinates is taken from it.
    folder : Path, or None for the user's cache
    """
    path = (folder or cache_root() / "lightmaps") / f"{key(view, room, settings)}.lightmap"
    cached = _read(path)
    if cached is None:
        cached = bake(view, room, settings)
        with contextlib.suppress(OSError):  # a cache that cannot be written costs time, not the light map
            _write(path, cached)
    return cached


def key(view: View, room: Room, settings: BakeSettings) -> str:
    """SHA-256 of all that a light map depends on."""
    parts = [repr(fixed_shapes(room)), repr(tuple(view.sphere_centre_m)), repr(settings)]
    parts += [f"{name} {version(name)}" for name in ("mitsuba", "drjit", "numpy", "scipy")]
    parts += [hashlib.sha256(Path(__file__).with_name(name).read_bytes()).hexdigest() for name in _CODE]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def encoded(light: LightMap) -> bytes:
    """Bytes of an `.npz` file."""
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(light, name) for name in ARRAYS})
    return buffer.getvalue()


def decoded(data: bytes) -> LightMap:
    """Light map of the bytes of an `.npz` file."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return LightMap(*(arrays[name] for name in ARRAYS))


def _read(path: Path) -> LightMap | None:
    """The entry, or None if there is none or its bytes are not those that were written."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    payload = content[_DIGEST:]
    if hashlib.sha256(payload).hexdigest().encode() != content[:_DIGEST]:
        return None
    return decoded(payload)


def _sweep(folder: Path) -> None:
    """Remove what killed processes left a day ago or earlier."""
    for left in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _DAY_S:
                left.unlink()


def _write(path: Path, light: LightMap) -> None:
    payload = encoded(light)
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(payload).hexdigest().encode() + payload)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
