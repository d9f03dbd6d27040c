"""Camera and spherical mirror as options of a command (`SphereOptions`); importing them starts nothing slow."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from phibench.datasets.common.errors import DatasetError


@dataclass(frozen=True)
class SphereOptions:
    """Camera and mirror, a sphere, as options of the command; None where an option is not given.

    Parameters
    ----------
    radius_mm
        Radius of the mirror, a sphere; 60 by default.
    distance_mm
        Of the mirror's centre from the lens, roughly. For a frame of 1280 x 720 it is 260 by default; otherwise the
        outline tells it.
    focal_px
        Focal length, pixels. For a whole frame of the C310, 1280 x 720, it is 1430 by default.
    cx_px
        Principal point, column, pixels. Left out only for a whole frame of the C310; otherwise it goes with --focal-px.
    cy_px
        Principal point, row, pixels. Left out only for a whole frame of the C310; otherwise it goes with --focal-px.
    focus_mm
        Distance of the plane of focus; by default on the virtual image, half a radius before the mirror's centre.
    """

    radius_mm: float | None = None
    distance_mm: float | None = None
    focal_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    focus_mm: float | None = None

    def given(self) -> dict[str, float]:
        """Values of the options that are given."""
        values = ((f"--{field.name.replace('_', '-')}", getattr(self, field.name)) for field in fields(self))
        return {option: value for option, value in values if value is not None}

    def require_sound(self) -> None:
        """Raise `DatasetError` for a radius or a focal length that none has."""
        for option in ("--radius-mm", "--focal-px"):
            value = self.given().get(option, 1.0)
            if not 0.0 < value < math.inf:
                raise DatasetError(f"{option} {value:g}: must be above 0")
