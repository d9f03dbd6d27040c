"""What is wrong with `[frames]` and `[[distractors]]` although every key has a legal value."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from phibench.datasets.recipe import RoomTable
from phibench.datasets.recipe_frames import LEVELS, SENSOR_KEYS
from phibench.datasets.recipe_random_checks import choice_faults, number_faults, off_wall, sound_distribution
from phibench.render.model_faults import Fault
from phibench.render.sensor import SensorError, sensor
from phibench.scenes.catalog import BOARD_SIZE_M

Raw = dict[str, Any]
_RAY = ("azimuth_deg", "height_m", "distance_m")


def frames_faults(raw: Raw) -> Iterator[Fault]:
    """Faults of `[frames]`: every number that may be drawn must be one that the sensor takes."""
    table = raw.get("frames")
    if not isinstance(table, dict):
        return
    for key in (*SENSOR_KEYS, "exposure_s"):
        if key in table and not (key == "exposure_s" and isinstance(table[key], str)):
            yield from number_faults(f"frames.{key}", table[key], partial(_sensor_range, key))
    for key in LEVELS:
        if key in table:
            yield from number_faults(f"frames.{key}", table[key], _from_to(0.0, 1e6))
    yield from _whole_qualities(table.get("jpeg_quality"))
    listed = table.get("presets")
    presets = listed if isinstance(listed, list) else []
    for i, preset in enumerate(presets):
        if preset in presets[:i]:
            yield Fault(f"frames.presets[{i}]", f"{preset!r} is listed twice; remove one")


def distractor_faults(raw: Raw, room: RoomTable | None, names: Sequence[str]) -> Iterator[Fault]:
    """Faults of `[[distractors]]`; `names` are those of the boards."""
    tables = raw.get("distractors")
    for i, table in enumerate(tables if isinstance(tables, list) else ()):
        if isinstance(table, dict):
            yield from _one_distractor(f"distractors[{i}]", table, room, names)


def _one_distractor(path: str, table: Raw, room: RoomTable | None, names: Sequence[str]) -> Iterator[Fault]:
    limits = {"flux_ratio": (1e-6, 0.5), "diameter_m": (1e-6, min(BOARD_SIZE_M) / 2.0), "distance_m": (0.1, 100.0)}
    for key, (low, high) in limits.items():
        if key in table:
            yield from number_faults(f"{path}.{key}", table[key], _from_to(low, high))
    for key in ("azimuth_deg", "height_m"):
        if key in table:
            yield from number_faults(f"{path}.{key}", table[key], None)
    yield from choice_faults(f"{path}.target", table.get("target"), names)
    given = [key for key in _RAY if key in table]
    if given and "target" in table:
        text = f"given together with {', '.join(given)} (a ray); give one or the other"
        yield Fault(f"{path}.target", text)
    if given and (missing := [key for key in _RAY[:2] if key not in table]):
        yield Fault(f"{path}.{missing[0]}", f"missing; {given[0]} needs it, azimuth_deg and height_m make the ray")
    if table.get("kind") == "glow" and "distance_m" not in table:
        yield Fault(f"{path}.distance_m", "missing; a glow hangs free in the room, at distance_m along its ray")
    if room is not None:
        yield from off_wall(f"{path}.height_m", table.get("height_m"), room)


def _whole_qualities(given: object) -> Iterator[Fault]:
    table = sound_distribution(given)
    if given is None or table is None:
        return
    if table.choice is None or any(value != int(value) for value in table.choice):
        text = "must be a whole number or a choice of whole numbers, such as { choice = [60, 75, 90] }"
        yield Fault("frames.jpeg_quality", text)


def _sensor_range(key: str, value: float) -> str | None:
    """What the sensor allows, in words, if it does not take the value."""
    try:
        sensor("mjpeg", **{key: round(value) if key == "jpeg_quality" else value})
    except SensorError as error:
        return f"what the sensor takes ({error})"
    return None


def _from_to(low: float, high: float) -> Callable[[float], str | None]:
    return lambda value: None if low <= value <= high else f"{low:g} to {high:g}"
