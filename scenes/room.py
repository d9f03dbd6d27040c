"""A room: everything that can be hit by light except the mirror."""

from __future__ import annotations

from dataclasses import dataclass, replace

from phibench.scenes.checks import SceneError
from phibench.scenes.rig import View
from phibench.scenes.robot import chassis, escalade360
from phibench.scenes.solids import Cuboid, Rectangle, Shape

MIRROR_NAME = "mirror"


@dataclass(frozen=True)
class Room:
    """Surfaces, lamps and furniture, in the world frame, and whether the robot stands in it.

    Parameters
    ----------
    name : str
    surfaces : rectangles; those that emit are the lamps
    furniture : cuboids
    robot : bool
        Robot, mast and camera housing are part of the scene.
    """

    name: str
    surfaces: tuple[Rectangle, ...]
    furniture: tuple[Cuboid, ...] = ()
    robot: bool = True

    def __post_init__(self) -> None:
        shapes: tuple[Shape, ...] = (*self.surfaces, *self.furniture)
        names = [shape.name for shape in shapes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SceneError(f"Room '{self.name}': two shapes are called {twice[0]}; names must differ")

    @property
    def lit(self) -> bool:
        """Whether any lamp is on."""
        return any(surface.emits for surface in self.surfaces)

    def shapes(self, view: View) -> tuple[Shape, ...]:
        """All shapes for one view; the index of a shape in this tuple is its object id, the same at every offset."""
        return (*self.surfaces, *self.furniture, *(escalade360(view) if self.robot else ()))

    def object_names(self, view: View) -> tuple[str, ...]:
        """Names of the shapes in the order of their object ids."""
        return tuple(shape.name for shape in self.shapes(view))

    def dark(self) -> Room:
        """Return the same room with every lamp switched off."""
        off = tuple(replace(surface, radiance_w_m2_sr=(0.0, 0.0, 0.0)) for surface in self.surfaces)
        return replace(self, name="dark", surfaces=off)

    def solid_around(self, point_world_m: tuple[float, ...]) -> str | None:
        """Name of the solid (furniture, robot) that a world point lies inside, or None."""
        solids = (*self.furniture, *(chassis() if self.robot else ()))
        return next((solid.name for solid in solids if solid.contains(point_world_m)), None)
