"""Settings of the study `isotropy`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from phibench.estimator.studies.study import Settings


def _tuples(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


Height = Annotated[float, Field(ge=0.0, le=3.0)]
Depth = Annotated[float, Field(gt=0.2, le=50.0)]


class IsotropySettings(Settings):
    """Numbers of the study."""

    preset: Literal["bayer-raw"] = Field(description="sensor whose frames are drawn")
    draws: int = Field(ge=5, le=100000, description="frame pairs per spot and baseline")
    false_alarm: float = Field(gt=0.0, lt=0.5, description="probability of a false 'not isotropic'")
    bound_azimuths: int = Field(ge=4, le=720, description="of the bound's curve")
    grid_azimuths: int = Field(ge=4, le=720, description="of the bound averaged over the pixel grid")
    occlusion_heights_m: Annotated[tuple[Height, ...], BeforeValidator(_tuples)] = Field(min_length=1)
    occlusion_azimuths: int = Field(ge=36, le=100000)
    line_azimuths: int = Field(ge=2, le=360, description="epipolar lines, evenly around")
    line_depths_m: Annotated[tuple[Depth, ...], BeforeValidator(_tuples)] = Field(min_length=3)
    panorama_width_px: int = Field(ge=360, le=16384)
    edges: Annotated[tuple[str, ...], BeforeValidator(_tuples)] = Field(description="shapes with upright edges")
    confidence: float = Field(gt=0.5, lt=1.0)
    resamples: int = Field(ge=100, le=100000, description="of the bootstrap")
