"""The plan of a data set: which poses, spots and pairs a recipe means. Pure, nothing is rendered or written."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from phibench.datasets.errors import RecipeError
from phibench.datasets.recipe import Recipe
from phibench.datasets.recipe_scene import build_rig, build_room, build_spot
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, Stroke, View
from phibench.scenes.room import Room
from phibench.scenes.streams import seed_32


@dataclass(frozen=True)
class PosePlan:
    """One mirror pose: everything a view needs besides rig and room.

    Attributes
    ----------
    pose_id : str
        ``h`` and the carriage offset in metres, such as ``h0.425``; down is ``h0.000``.
    offset_m : float
        Carriage offset along the stroke axis.
    seed : int
        32-bit seed of the ambient layer, from the named stream (data set, seed, pose, "ambient").
    """

    pose_id: str
    offset_m: float
    seed: int


@dataclass(frozen=True)
class PairPlan:
    """One stroke pair: a target seen from down and from up."""

    sample_id: str
    experiment: str
    target: str
    stroke_m: float

    def pose_id(self, position: str) -> str:
        """Id of the pose at a stroke position, "down" or "up"."""
        return pose_name(Stroke(self.stroke_m).offset_m(position))


@dataclass(frozen=True)
class Plan:
    """What a recipe means.

    Attributes
    ----------
    spots : dict
        Laser spot of every target that an experiment uses, by target name.
    poses : tuple of PosePlan
        In the order of their offsets; shared by all pairs.
    pairs : tuple of PairPlan
        In the order of the recipe.
    shard : str or None
        "i/n" where this is a part of the recipe (`shard.py`).
    """

    recipe: Recipe
    rig: Rig
    room: Room
    spots: dict[str, LaserSpot]
    poses: tuple[PosePlan, ...]
    pairs: tuple[PairPlan, ...]
    shard: str | None = None

    def view(self, pair: PairPlan, position: str) -> View:
        """View of a pair at a stroke position."""
        return self.rig.at(Stroke(pair.stroke_m).offset_m(position))


def make_plan(recipe: Recipe) -> Plan:
    """Plan of a recipe.

    Raises
    ------
    RecipeError
        If two strokes differ by less than a nanometre, so that their poses would share a name.
    """
    pairs = tuple(
        PairPlan(_sample_name(experiment.name, target, stroke_m), experiment.name, target, float(stroke_m))
        for experiment in recipe.experiments
        for target in experiment.targets
        for stroke_m in experiment.strokes_m
    )
    used = {pair.target for pair in pairs}
    spots = {table.name: build_spot(recipe.laser, table) for table in recipe.targets if table.name in used}
    return Plan(recipe, build_rig(recipe.rig), _room(recipe), spots, _poses(recipe, pairs), pairs)


def pose_name(offset_m: float) -> str:
    """Name of a pose: the offset in metres, to the nanometre, at least three decimals."""
    whole, decimals = f"{offset_m:.9f}".split(".")
    return f"h{whole}.{decimals.rstrip('0').ljust(3, '0')}"


def _sample_name(experiment: str, target: str, stroke_m: float) -> str:
    """Neither names nor numbers contain a hyphen, so that no two samples share a name."""
    return f"{experiment}-{target}-{pose_name(stroke_m)}"


def _room(recipe: Recipe) -> Room:
    return build_room(recipe.room, recipe.targets)


def _poses(recipe: Recipe, pairs: tuple[PairPlan, ...]) -> tuple[PosePlan, ...]:
    offsets = sorted({Stroke(pair.stroke_m).offset_m(position) for pair in pairs for position in POSITIONS})
    names = [pose_name(offset_m) for offset_m in offsets]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise RecipeError(f"experiments: two strokes near {twice[0][1:]} m differ by less than 1 nm; make them equal")
    dataset = recipe.dataset
    return tuple(
        PosePlan(name, offset_m, seed_32(dataset.name, dataset.seed, name, "ambient"))
        for name, offset_m in zip(names, offsets, strict=True)
    )
