"""Tables of a recipe on the mirror: its shape, its measured reflectance, and what carries it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from phibench.datasets.recipe.distributions import Table
from phibench.scenes.holder import LARGEST_INDEX, OF_TUBES
from phibench.scenes.validation import SceneError, nearest

Tilt = Annotated[float, Field(ge=-0.5, le=0.5)]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
GlassIndex = Annotated[float, Field(ge=1.0, le=LARGEST_INDEX)]
HolderM = Annotated[float, Field(ge=1e-4, le=1.0)]


class OfHolder(Table):
    """Table with keys of a holder."""

    later = OF_TUBES


class HolderTable(OfHolder):
    """`[rig.holder]`: what carries the mirror."""

    kind: Literal["none", "rods", "post", "tube"] = Field(
        default="none", description="three rods around the mirror, a post from above, or a glass tube"
    )
    radius_m: HolderM | None = Field(default=None, description="of each rod; of post, arm and column; R/15")
    circle_m: HolderM | None = Field(
        default=None, description="from the axis to rods or column, 1.25 R + radius_m; to a tube, 1.25 R"
    )
    plate_m: HolderM | None = Field(default=None, description="radius of the plates; 2 radius_m beyond rods or tube")
    rise_m: HolderM | None = Field(
        default=None, description="sphere centre or vertex to the upper plate or arm's top; 1.5 R, or rim + 0.5 R"
    )
    azimuth_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = Field(
        default=30.0, description="of the first rod, or the column, from the camera's x axis"
    )
    wall_m: HolderM | None = Field(default=None, description="thickness of the tube's wall; 0.003 whatever R")
    glass_index: GlassIndex | None = Field(
        default=None, description="refractive index of the tube; 1.473 whatever R, borosilicate glass 3.3"
    )


VERTEX_RADIUS_M = 0.060  # as the sphere's radius
HALF_ANGLE_DEG = 45.0
OF_SHAPES = ("vertex_radius_m", "conic", "half_angle_deg", "even_terms")
"""Keys of `[rig.mirror]` that belong to some shapes alone."""


@dataclass(frozen=True)
class MirrorShape:
    """Shape of `[rig.mirror]`, a profile of revolution.

    Parameters
    ----------
    keys : tuple of str
        Keys that it takes beside the rim.
    conic : float or None
        k where none is given; None for a cone, which has a half angle.
    low, high : float
        Open range of k.
    lens_in_focus : bool
        Without a vertex radius the lens is in its outer focus.

    Raises
    ------
    SceneError
        If a key is none, or the numbers are no conic; the sentence holds the whole line.
    """

    keys: tuple[str, ...]
    conic: float | None = None
    low: float = -math.inf
    high: float = math.inf
    lens_in_focus: bool = False

    def __post_init__(self) -> None:
        if fault := self._fault():
            raise SceneError(f"{self} is no shape of [rig.mirror]: {fault}")

    def _fault(self) -> str:
        """Reason why there is no such shape; empty if there is one."""
        if not isinstance(self.keys, tuple) or not self.keys:
            return 'keys must be a tuple with at least one name, such as ("conic",)'
        if unknown := [key for key in self.keys if key not in OF_SHAPES]:
            return f"there is no key '{unknown[0]}'; {nearest(str(unknown[0]), OF_SHAPES)}"
        if self.conic is None:
            free = math.isinf(self.low) and math.isinf(self.high) and not self.lens_in_focus
            return "" if self.keys == ("half_angle_deg",) and free else "without conic it is a cone; give its conic"
        if "half_angle_deg" in self.keys:
            return "half_angle_deg is a cone's; remove it from the keys"
        if not self.low < self.conic < self.high:
            return f"conic = {self.conic:g} must be {self.side or 'finite'}"
        if self.lens_in_focus and self.high > -1.0:
            return f"lens_in_focus is for conics below -1; high = {self.high:g} must be -1 or less"
        return ""

    @property
    def side(self) -> str:
        """Range of k in words; empty where every k will do."""
        ends = (("above", self.low), ("below", self.high))
        return " and ".join(f"{word} {end:g}" for word, end in ends if math.isfinite(end))


SHAPES = {
    "ellipsoid": MirrorShape(("vertex_radius_m", "conic"), -0.5, low=-1.0),
    "paraboloid": MirrorShape(("vertex_radius_m",), -1.0),
    "hyperboloid": MirrorShape(("vertex_radius_m", "conic"), -1.5625, high=-1.0, lens_in_focus=True),
    "cone": MirrorShape(("half_angle_deg",)),
    "polynomial": MirrorShape(("vertex_radius_m", "conic", "even_terms"), -1.0),
}
"""Shapes by name; another conic is another line here."""
if TYPE_CHECKING:
    ShapeName = str
else:
    ShapeName = Literal[tuple(SHAPES)]


class MirrorTable(Table):
    """`[rig.mirror]`: a mirror of revolution instead of the sphere."""

    later = ("tilt_x_rad", "tilt_y_rad")

    shape: ShapeName = Field(description="surface at z_c_m; a sphere needs no table")
    rim_radius_m: float = Field(default=0.060, gt=0.0, le=1.0, description="radius of the rim, where the mirror ends")
    vertex_radius_m: float | None = Field(
        default=None, gt=0.0, le=1.0, description="R, radius of curvature at the vertex; convex"
    )
    conic: float | None = Field(default=None, ge=-100.0, le=100.0, description="k, conic constant")
    half_angle_deg: float | None = Field(default=None, ge=3.0, le=87.0, description="of a cone: from axis to surface")
    even_terms: tuple[float, ...] | None = Field(
        default=None, max_length=8, strict=False, description="a_2, a_3, ... of r^4, r^6, ... in m^-3, m^-5, ..."
    )
    tilt_x_rad: Tilt = Field(default=0.0, description="mirror turned about world x through its vertex")
    tilt_y_rad: Tilt = Field(default=0.0, description="mirror turned about world y through its vertex")


DRAWN_OF_MIRROR = tuple(key for key in MirrorTable.model_fields if key != "even_terms")
"""Keys of `[rig.mirror]` that may be drawn: the shape and all single numbers."""


class ReflectionTable(Table):
    """`[rig.reflectance]`: measured reflectance of the mirror instead of its metal's."""

    wavelength_nm: tuple[float, ...] = Field(
        strict=False, min_length=1, max_length=200, description="rising; a single one stands for all"
    )
    value: tuple[Unit, ...] = Field(
        strict=False, min_length=1, max_length=20000, description="one for each wavelength and angle, row after row"
    )
    angle_deg: tuple[Annotated[float, Field(ge=0.0, le=90.0)], ...] = Field(
        default=(), strict=False, max_length=100, description="angles of incidence, rising; a single one stands for all"
    )
