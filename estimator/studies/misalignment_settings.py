"""Settings of the study `misalignment`."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from phibench.estimator.studies.misaligned import Places
from phibench.estimator.studies.misalignment_tolerance import Search
from phibench.estimator.studies.simulated_calibration import Bench
from phibench.estimator.studies.study import Settings
from phibench.scenes.frames import Array


def _tuples(value: object) -> object:
    return tuple(_tuples(part) for part in value) if isinstance(value, list) else value


Distance = Annotated[float, Field(gt=0.1, le=20.0)]
Positive = Annotated[float, Field(gt=0.0, le=1.0)]
Distances = Annotated[tuple[Distance, ...], BeforeValidator(_tuples), Field(min_length=1, max_length=20)]
Spot = tuple[Distance, Annotated[float, Field(ge=-360.0, le=360.0)]]


class SearchSettings(BaseModel):
    """Values of a parameter that are tried, in units of the study's magnitude."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    start: float = Field(gt=0.0, le=1.0)
    largest: float = Field(ge=1.0, le=1e5)
    factor: float = Field(gt=1.01, le=10.0)


class MisalignmentSettings(Settings):
    """Numbers of the study."""

    depths_m: Distances = Field(description="D of the spots from the nominal stroke axis")
    strokes_m: Distances = Field(description="strokes; calibration, rendering and interactions take the first")
    height_m: float = Field(ge=0.0, le=3.0, description="of the spots above the floor")
    azimuths: int = Field(ge=4, le=360, multiple_of=4, description="evenly spaced, from world x")
    cost: float = Field(gt=0.0, lt=1.0, description="relative change of D that a tolerance allows")
    search: SearchSettings
    search_calibrated: SearchSettings
    rendered_every: int = Field(ge=1, description="every n-th azimuth is rendered, from the second one on")
    agreement: float = Field(gt=0.0, lt=1.0, description="allowed difference of rendered and predicted change of D")
    calibration_spots: Annotated[tuple[Spot, ...], BeforeValidator(_tuples)] = Field(min_length=1)
    calibration_pixel_sigma_px: Positive
    calibration_distance_sigma_m: Positive
    calibration_outline_sigma_m: Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_tuples)]
    noise_draws: int = Field(ge=2, le=10000, description="calibrations of the aligned rig from noisy measurements")
    sobol_log2: int = Field(ge=3, le=16, description="base sample of the Sobol indices: 2 to this power")
    resamples: int = Field(ge=20, le=100000, description="of the bootstrap")

    @property
    def azimuths_rad(self) -> Array:
        """All azimuths."""
        return np.asarray(np.arange(self.azimuths) * (2.0 * math.pi / self.azimuths), float)

    def places(self, stroke_m: float, azimuths_rad: Array | None = None) -> Places:
        """Spots at a stroke, at all azimuths or at others."""
        azimuths = self.azimuths_rad if azimuths_rad is None else azimuths_rad
        return Places(np.array(self.depths_m), azimuths, self.height_m, stroke_m)

    @property
    def bench(self) -> Bench:
        """How a rig is calibrated."""
        spots = [
            (D * math.cos(math.radians(a)), D * math.sin(math.radians(a)), self.height_m)
            for D, a in self.calibration_spots
        ]
        return Bench(
            np.array(spots),
            self.calibration_pixel_sigma_px,
            self.calibration_distance_sigma_m,
            self.calibration_outline_sigma_m,
        )

    def tolerance_search(self, calibrated: bool = False) -> Search:
        """How a tolerance is looked for."""
        how = self.search_calibrated if calibrated else self.search
        return Search(self.cost, how.start, how.largest, how.factor)
