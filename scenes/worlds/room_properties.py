"""Properties of a generated room: every number that a recipe may draw, with its range, meaning and default.

`RoomProperties` holds one value for each entry of `PROPERTIES`. A room follows from its properties and the names of a
random stream. Whatever no property states (which chair, which poster, where) comes from the stream.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from phibench.scenes.random_streams import Name, generator
from phibench.scenes.validation import SceneError, nearest, within

USES = ("office", "home", "workshop", "laboratory", "store")
LAMP_KINDS = ("panels", "tubes", "pendants", "uplights", "mixed")

Value = float | str
Spec = Mapping[str, tuple[Value, ...]]


@dataclass(frozen=True)
class Property:
    """One property of a room.

    Attributes
    ----------
    name : str
        As in a recipe; ends in the unit.
    low, high : float
        Allowed range; both 0 for names.
    default : mapping
        Distribution, worded as in a recipe: ``{"uniform": (low, high)}``, ``"log_uniform"`` or ``"choice"``.
    whole : bool
        Whole numbers only.
    choices : tuple of str
        Allowed names; empty for a number.
    """

    name: str
    low: float
    high: float
    meaning: str
    default: Spec
    whole: bool = False
    choices: tuple[str, ...] = ()

    def checked(self, value: Value) -> Value:
        """Return the value as a float, an int or a name.

        Raises
        ------
        SceneError
            If it is none of the choices, out of range or not whole where it must be.
        """
        if self.choices:
            if value not in self.choices:
                raise SceneError(f"RoomProperties.{self.name} = {value!r}: {nearest(str(value), self.choices)}")
            return value
        if isinstance(value, str | bool):
            raise SceneError(
                f"RoomProperties.{self.name} = {value!r}: give a number from {self.low:g} to {self.high:g}"
            )
        within("RoomProperties", self.name, value, self.low, self.high)
        if self.whole and value != round(value):
            raise SceneError(
                f"RoomProperties.{self.name} = {value}: give a whole number, {self.low:g} to {self.high:g}"
            )
        return round(value) if self.whole else float(value)

    def drawn(self, rng: np.random.Generator) -> Value:
        """One value of the default distribution."""
        ((kind, values),) = self.default.items()
        if kind == "choice":
            return values[int(rng.integers(len(values)))]
        low, high = (float(value) for value in values)
        if kind == "log_uniform":
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return float(rng.uniform(low, high))


_ENTRY = "property"  # one key: pydantic reads those that it knows, such as `default`


def _number(low: float, high: float, meaning: str, **default: tuple[float, ...]) -> Any:
    return field(metadata={_ENTRY: {"low": low, "high": high, "meaning": meaning, "default": default}})


def _count(low: int, high: int, meaning: str, *choice: int) -> Any:
    entry = {"low": low, "high": high, "meaning": meaning, "default": {"choice": choice}, "whole": True}
    return field(metadata={_ENTRY: entry})


def _name(choices: tuple[str, ...], meaning: str) -> Any:
    entry = {"low": 0.0, "high": 0.0, "meaning": meaning, "default": {"choice": choices}, "choices": choices}
    return field(metadata={_ENTRY: entry})


@dataclass(frozen=True)
class RoomProperties:
    """Description of a generated room; `PROPERTIES` has range, meaning and default distribution of each field.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """

    use: str = _name(USES, "what the room serves: selects furniture, floors and walls")
    length_m: float = _number(4.0, 16.0, "inner length of the room, metres", uniform=(4.0, 16.0))
    width_m: float = _number(3.0, 12.0, "inner width of the room, metres", uniform=(3.0, 12.0))
    height_m: float = _number(2.3, 4.5, "height of the ceiling, metres", uniform=(2.3, 4.5))
    l_shape: int = _count(0, 1, "1: a corner is cut out of the floor plan", 0, 0, 1)
    cut_part: float = _number(0.15, 0.5, "part of length and width that an L shape lacks", uniform=(0.2, 0.45))
    robot_x: float = _number(0.0, 1.0, "the robot's place along the length, 0 to 1", uniform=(0.0, 1.0))
    robot_y: float = _number(0.0, 1.0, "the robot's place along the width, 0 to 1", uniform=(0.0, 1.0))
    heading_deg: float = _number(
        -180.0, 180.0, "the robot's heading against the length, degrees", uniform=(-180.0, 180.0)
    )
    wall_albedo: float = _number(0.1, 0.9, "mean albedo of the walls, green band", uniform=(0.15, 0.85))
    ceiling_albedo: float = _number(0.2, 0.9, "mean albedo of the ceiling, green band", uniform=(0.55, 0.88))
    floor_albedo: float = _number(0.04, 0.7, "mean albedo of the floor, green band", uniform=(0.1, 0.45))
    saturation: float = _number(0.0, 1.0, "strength of the walls' colours; 0 is grey", uniform=(0.1, 0.9))
    pattern_contrast: float = _number(0.0, 1.5, "factor on the contrast of every texture", uniform=(0.6, 1.3))
    gloss: float = _number(0.0, 1.0, "probability that what can have a glossy coat has it", uniform=(0.2, 0.9))
    furniture_per_m2: float = _number(0.0, 1.0, "pieces of furniture per square metre", uniform=(0.05, 0.8))
    clutter: float = _number(0.0, 1.0, "how full tables and shelves are", uniform=(0.0, 1.0))
    near_objects: int = _count(0, 6, "things 0.25 to 1 m from the stroke axis", 0, 1, 2, 3, 4, 5)
    floor_objects: int = _count(0, 16, "small things on the floor", 0, 2, 4, 6, 8, 12)
    wall_objects_per_m: float = _number(0.0, 1.0, "posters, boards, ducts per metre of wall", uniform=(0.0, 0.9))
    figures: int = _count(0, 4, "people-sized figures", 0, 0, 1, 1, 2, 3)
    doors: int = _count(0, 3, "doors", 1, 1, 2)
    door_angle_deg: float = _number(0.0, 95.0, "opening angle of the first door, degrees", uniform=(0.0, 95.0))
    windows: int = _count(0, 3, "windows", 0, 1, 1, 2, 3)
    sky_cd_m2: float = _number(10.0, 10000.0, "luminance of the sky, cd/m^2", log_uniform=(200.0, 6000.0))
    sky_temperature_k: float = _number(
        4500.0, 20000.0, "colour temperature of the sky, kelvin", log_uniform=(5500.0, 15000.0)
    )
    sun: int = _count(0, 1, "1: the sun shines in, if there is a window", 0, 1)
    sun_lx: float = _number(
        100.0, 100000.0, "illuminance of a surface that faces the sun, lux", log_uniform=(1500.0, 30000.0)
    )
    sun_elevation_deg: float = _number(5.0, 70.0, "height of the sun, degrees", uniform=(12.0, 55.0))
    sun_azimuth_deg: float = _number(
        -75.0, 75.0, "the sun's azimuth from the first window's normal, degrees", uniform=(-60.0, 60.0)
    )
    lamp_kind: str = _name(LAMP_KINDS, "kind of the room's lamps")
    lamps: int = _count(1, 8, "most lamps on the ceiling", 2, 3, 4, 6, 8)
    colour_temperature_k: float = _number(
        2000.0, 8000.0, "colour temperature of the lamps, kelvin", log_uniform=(2500.0, 6700.0)
    )
    illuminance_lx: float = _number(
        10.0, 3000.0, "luminous flux of the lamps per area of the floor, lux", log_uniform=(60.0, 900.0)
    )
    desk_lamps: int = _count(0, 2, "desk lamps that are on", 0, 0, 1, 2)
    indicator_lamps: int = _count(0, 2, "small red lamps on the walls", 0, 1, 2)
    screens: int = _count(0, 6, "screens that are on; the others are dark and glossy", 0, 1, 2, 4)
    screen_cd_m2: float = _number(5.0, 600.0, "luminance of a screen's white, cd/m^2", log_uniform=(40.0, 300.0))

    def __post_init__(self) -> None:
        for name, entry in PROPERTIES.items():
            object.__setattr__(self, name, entry.checked(getattr(self, name)))


PROPERTIES = {entry.name: Property(entry.name, **entry.metadata[_ENTRY]) for entry in fields(RoomProperties)}
"""All properties by name, in order."""


def drawn_properties(*stream: Name, **fixed: Value) -> RoomProperties:
    """Properties from the default distributions, one random stream for each; those in `fixed` are as given.

    Raises
    ------
    SceneError
        If `fixed` names no property, or a value is out of range.
    """
    for name in fixed:
        if name not in PROPERTIES:
            raise SceneError(f"RoomProperties has no '{name}'; {nearest(name, PROPERTIES)}")
    values: dict[str, Any] = {
        name: fixed[name] if name in fixed else entry.drawn(generator(*stream, "property", name))
        for name, entry in PROPERTIES.items()
    }
    return RoomProperties(**values)
