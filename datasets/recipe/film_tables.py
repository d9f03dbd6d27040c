"""Tables of `[film]` in a recipe: frame times, carriage, encoder, laser code, vibration, other lights, robot drive."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from phibench.datasets.recipe.distributions import Name, Table

Share = Annotated[float, Field(ge=-1.0, le=1.0)]
Pause = Annotated[float, Field(ge=0.0, le=3600.0)]
Place = Annotated[float, Field(ge=-100.0, le=100.0)]
Gain = Annotated[float, Field(ge=0.0, le=10.0)]
Colour = Annotated[tuple[Gain, ...], Field(strict=False, min_length=3, max_length=3)]
Code = Annotated[str, Field(pattern="^[01]+$", max_length=4096)]
WaypointRow = Annotated[tuple[Place, ...], Field(strict=False, min_length=3, max_length=3)]

TARGET = "target"
"""Name of the spot that a pair is about."""


class VibrationTable(Table):
    """`[[film.vibration]]`: a band of vibration of the rig."""

    axis: Literal["stroke", "x", "y"] = Field(default="stroke", description="along the stroke axis or a world axis")
    low_hz: float = Field(gt=0.0, le=1e4, description="lower end of the band")
    high_hz: float = Field(gt=0.0, le=1e4, description="upper end; the lower one for a sine wave")
    rms_m: float = Field(ge=0.0, le=0.1, description="root mean square of the displacement")

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.high_hz < self.low_hz:
            raise ValueError(f"high_hz = {self.high_hz:g} is below low_hz = {self.low_hz:g}; exchange them")
        return self


class FilmLightTable(Table):
    """`[[film.lights]]`: another light of a film: a lamp, a reflection, another laser or target."""

    name: Name = Field(description="name of the light")
    azimuth_deg: float = Field(ge=-360.0, le=360.0, description="of a ray from the world's z axis, from x towards y")
    height_m: float = Field(ge=0.0, le=100.0, description="height at which the ray starts")
    elevation_deg: float = Field(default=0.0, ge=-85.0, le=85.0, description="of the ray above the horizon")
    distance_m: float | None = Field(
        default=None, gt=0.0, le=100.0, description="along the ray to a disc that hangs free; where the ray ends if not"
    )
    power_ratio: float = Field(default=1.0, gt=0.0, le=1e4, description="its power over the laser's")
    diameter_m: float | None = Field(default=None, gt=0.0, le=1.0, description="of the disc; by [laser] if not given")
    colour: Colour | None = Field(
        default=None, description="electrons behind R, G, B over the laser's behind red; the laser's own if not given"
    )
    code: Code = Field(default="1", description="bits of its blink code")
    bit_s: float = Field(default=1 / 30, ge=1e-4, le=3600.0, description="time of a bit")
    code_start_s: float = Field(default=0.0, ge=-3600.0, le=3600.0, description="time at which a code begins")
    path: Annotated[tuple[WaypointRow, ...], Field(strict=False, max_length=1000)] = Field(
        default=(), description="waypoints [time_s, across_m, up_m], as those of [film]"
    )
    follows_laser: bool = Field(default=False, description="a reflection: it has the laser's code")
    is_target: bool = Field(default=False, description="it is looked for as well, by its code")


class DriveTable(Table):
    """`[[film.drive]]`: a leg of the robot's drive, or a turn of its flippers."""

    start_s: float | None = Field(
        default=None,
        ge=0.0,
        le=3600.0,
        description="start; where not given, when the leg before has ended, and the first when the carriage rests",
    )
    length_m: float = Field(default=0.0, ge=-20.0, le=20.0, description="length of the arc of the base; ahead counts")
    turn_deg: float = Field(default=0.0, ge=-720.0, le=720.0, description="turn over the arc; to the left counts")
    flipper_deg: float | None = Field(
        default=None, ge=-180.0, le=180.0, description="angle of the flippers at the end; such a leg does not drive"
    )
    speed_m_per_s: float = Field(default=0.2, gt=0.0, le=10.0, description="largest speed of the faster track")
    acceleration_m_per_s2: float = Field(default=0.5, gt=0.0, le=100.0, description="largest acceleration of it")


class FilmTable(Table):
    """`[film]`: every pair of the recipe as a film of its stroke."""

    rate_hz: float = Field(default=30.0, gt=0.0, le=1000.0, description="frames per second")
    frames: int | None = Field(
        default=None, ge=1, le=100_000, description="how many; as many as the motion takes where not given"
    )
    exposure_s: float = Field(default=1 / 60, gt=0.0, le=1.0, description="exposure of each row")
    readout_s: float = Field(default=0.030, ge=0.0, le=1.0, description="rolling shutter, first row to last; 0 is none")
    view: Literal["windows", "full"] = Field(
        default="windows", description="the room around the spot alone, or the whole image"
    )
    window_px: int = Field(default=48, ge=16, le=512, description="side of the square around the spot")
    stops: Annotated[tuple[Share, ...], Field(strict=False, min_length=1, max_length=100)] = Field(
        default=(0.0, 1.0), description="where the carriage stops, in parts of the pair's stroke"
    )
    pauses_s: Annotated[tuple[Pause, ...], Field(strict=False, min_length=1, max_length=100)] = Field(
        default=(0.5, 0.5), description="rest at each stop"
    )
    speed_m_per_s: float = Field(default=0.25, gt=0.0, le=10.0, description="largest speed of the carriage")
    acceleration_m_per_s2: float = Field(default=1.0, gt=0.0, le=100.0, description="largest acceleration")
    encoder_rms_m: float = Field(default=2e-4, ge=0.0, le=0.1, description="noise of a reading of the offset")
    encoder_step_m: float = Field(default=0.0, ge=0.0, le=0.1, description="resolution of a reading; 0 is none")
    code: Code = Field(default="1", description="bits of the laser's blink code, which repeats; '1' is always on")
    bit_s: float = Field(default=1 / 30, ge=1e-4, le=3600.0, description="time of a bit")
    code_start_s: float = Field(
        default=0.0, ge=-3600.0, le=3600.0, description="time at which a code begins; frames are centred at n / rate_hz"
    )
    path: Annotated[tuple[WaypointRow, ...], Field(strict=False, max_length=1000)] = Field(
        default=(), description="waypoints [time_s, across_m, up_m] of the spot on its board; it rests where not given"
    )
    vibration: Annotated[tuple[VibrationTable, ...], Field(strict=False, max_length=20)] = Field(
        default=(), description="bands of vibration"
    )
    lights: Annotated[tuple[FilmLightTable, ...], Field(strict=False, max_length=50)] = Field(
        default=(), description="other lights"
    )
    drive: Annotated[tuple[DriveTable, ...], Field(strict=False, max_length=100)] = Field(
        default=(), description="legs of the robot's drive; it stands where not given"
    )

    @model_validator(mode="after")
    def _together(self) -> Self:
        """Check what no single key shows."""
        if len(self.pauses_s) != len(self.stops):
            raise ValueError(f"{len(self.pauses_s)} pauses_s for {len(self.stops)} stops; give one pause for each stop")
        longest = 1.0 / self.rate_hz * (1.0 + 1e-9)  # 1 / 30 as it is typed
        for name in ("exposure_s", "readout_s"):
            if getattr(self, name) > longest:
                raise ValueError(
                    f"{name} = {getattr(self, name):g} is longer than a frame at rate_hz = {self.rate_hz:g}; "
                    f"give at most {longest:.4g}"
                )
        blinking: list[tuple[str, FilmTable | FilmLightTable]] = [("the laser", self)]
        blinking += [(f"light '{light.name}'", light) for light in self.lights]
        for what, one in blinking:
            if "1" not in one.code:
                raise ValueError(f"code = '{one.code}' never lights {what}; give a 1")
            times = [row[0] for row in one.path]
            if sorted(set(times)) != times:
                raise ValueError(f"times {times} of path must rise")
        names = [light.name for light in self.lights]
        if len({*names, TARGET}) <= len(names):
            raise ValueError(f"names {names} of lights must differ from each other and from '{TARGET}'")
        return self
