"""The part of a recipe that is not rendered: how frames of a benchmark are taken, and lights that mislead."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from phibench.datasets.distribution import Distribution, DistributionTable, Targets
from phibench.datasets.recipe_table import Table

Preset = Literal["mono-raw", "bayer-raw", "srgb8", "mjpeg"]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
LEVELS = ("laser_level", "lamp_level")
SENSOR_KEYS = ("jpeg_quality", "sharpen_amount", "analogue_gain", "read_noise_e", "prnu")
"""Keys of `[frames]` that are numbers of the sensor's preset."""

_ONE = DistributionTable(choice=(1.0,))
_HALF = DistributionTable(log_uniform=(0.05, 0.5))


class FramesTable(Table):
    """`[frames]`: how frames are taken; every number is drawn per sample and is the same in all presets."""

    presets: Annotated[tuple[Preset, ...], Field(strict=False, min_length=1)] = Field(
        default=("bayer-raw",), description="sensor presets; every sample is taken in each"
    )
    draws: int = Field(default=1, ge=1, le=10_000, description="draws of the noise, per sample and preset")
    exposure_s: Distribution | Literal["auto"] | None = Field(
        default=None, description="exposure time; 'auto' is the camera's for the down image, kept for the others"
    )
    laser_level: Distribution = Field(default=_ONE, description="factor of the laser's light")
    lamp_level: Distribution = Field(default=_ONE, description="factor of the room's light")
    jpeg_quality: Distribution | None = Field(default=None, description="libjpeg's quality; whole numbers")
    sharpen_amount: Distribution | None = Field(default=None, description="gain of the unsharp mask")
    analogue_gain: Distribution | None = Field(default=None, description="gain before the converter")
    read_noise_e: Distribution | None = Field(default=None, description="read noise, rms electrons per pixel")
    prnu: Distribution | None = Field(default=None, description="relative spread of the pixels' responsivity")
    laser_off: bool = Field(default=True, description="whether frames with the laser off are given too")
    hint: Probability = Field(default=0.0, description="probability that a pair comes with boxes that hold its spots")
    hint_box_px: int = Field(default=64, ge=16, le=8192, description="side of such a box")
    camera: Literal["per_sample", "one"] = Field(
        default="per_sample", description="whether each sample has a camera, hence a fixed pattern, of its own"
    )


class DistractorTable(Table):
    """`[[distractors]]`: another light; on a board, where a ray ends, or free in the room."""

    kind: Literal["spot", "glow", "led"] = Field(
        description="'spot' a reflection of the laser, 'glow' the laser itself, 'led' a lamp that stays on"
    )
    probability: Probability = Field(default=1.0, description="part of the samples that have it")
    flux_ratio: Distribution = Field(
        default=_HALF, description="its electrons relative to the spot's, in the image where that is more"
    )
    diameter_m: Distribution = Field(default=DistributionTable(choice=(0.005,)), description="diameter of the disc")
    target: Targets = Field(default=None, description="boards; all but the sample's own where no place is given")
    azimuth_deg: Distribution | None = Field(
        default=None, description="of a horizontal ray from the world's z axis, from x towards y; instead of a board"
    )
    height_m: Distribution | None = Field(default=None, description="of the ray above the floor; with azimuth_deg")
    distance_m: Distribution | None = Field(
        default=None, description="along the ray to a disc that hangs free; where the ray ends if not given"
    )

    @property
    def follows_laser(self) -> bool:
        """Whether it goes out with the laser."""
        return self.kind != "led"
