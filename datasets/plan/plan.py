"""Plan of a data set: poses, spots and pairs of a recipe or of one of its shards. Nothing is rendered or written.

Shard i of n is a contiguous run of samples, by position in the recipe: machines need not agree on anything. Neighbours
share views. A view that two shards need is rendered by both, to the same bytes. A shard is a data set of its own,
complete and readable.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.plan.draws import KeptSamples, draw_rigs, draw_rooms, rebuilt_samples, room_files
from phibench.datasets.plan.sampling import RandomSample, draw_samples, have_own_rigs
from phibench.datasets.recipe.recipe_scene import build_misalignment, build_rig, build_spot, true_stroke_m
from phibench.datasets.recipe.tables import DrawnRigsTable, RandomTable, Recipe
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.datasets.rooms.room_sources import ONLY_ROOM, RoomSource, room_of
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import seed_32
from phibench.scenes.rig import POSITIONS, Rig, Stroke, View
from phibench.scenes.room import Room
from phibench.scenes.validation import printable_line

RECIPE_RIG = "rig"
"""Id of the rig of `[rig]`. A drawn one is called after the first sample that has it, such as ``r000042``, and one that
only an estimator is given ``n000042``."""
TRUE_RIG = "true"
"""Id of the rig of `[rig]` with `[misalignment]`, for experiments."""


@dataclass(frozen=True)
class PosePlan:
    """One mirror pose: everything a view needs besides rig and room.

    Attributes
    ----------
    pose_id : str
        ``h`` and the carriage offset in metres, such as ``h0.425``; down is ``h0.000``. For any rig but that of
        `[rig]`, its id and a hyphen come first: ``r000042-h0.425``. Before them stands a room that is one of many.
    offset_m : float
        Carriage offset along the stroke axis.
    seed : int
        32-bit seed of the ambient layer, from the named stream (data set, seed, pose, "ambient").
    rig, room : str
        Ids of rig and room.
    """

    pose_id: str
    offset_m: float
    seed: int
    rig: str = RECIPE_RIG
    room: str = ONLY_ROOM


@dataclass(frozen=True)
class PairPlan:
    """Pair of images (down, up): one spot seen from both stroke positions.

    Attributes
    ----------
    target : str
        Name of the target, or of what a ray met.
    stroke_m, nominal_stroke_m : float
        The true stroke, and the one that an estimator is given.
    spot : str
        Key of the spot in `Plan.spots`.
    rig, nominal_rig : str
        Id of the true rig, and of the one that an estimator is given.
    room : str
        Id of the room.
    drawn : tuple of (parameter, value)
        What was drawn; empty for an experiment without drawn rigs.
    tries : int
        Number of the first draw that was possible; 0 where nothing is drawn.
    """

    sample_id: str
    experiment: str
    target: str
    stroke_m: float
    nominal_stroke_m: float
    spot: str
    rig: str = RECIPE_RIG
    nominal_rig: str = RECIPE_RIG
    drawn: tuple[tuple[str, float | str], ...] = ()
    tries: int = 0
    room: str = ONLY_ROOM

    def offset_m(self, position: str) -> float:
        """Carriage offset at a stroke position, "down" or "up", of the true stroke."""
        return Stroke(self.stroke_m).offset_m(position)

    def pose_id(self, position: str) -> str:
        """Id of the pose at a stroke position."""
        return pose_of(self.rig, self.offset_m(position), self.room)


@dataclass(frozen=True)
class Plan:
    """Rigs, rooms, spots, poses and pairs of a recipe.

    Attributes
    ----------
    rig : Rig
        That of `[rig]`: light maps take their origin of coordinates from it. A sample's own is in `rigs`.
    rigs : dict
        True and nominal rigs of the samples, by id.
    rooms : dict
        Sources of the samples' rooms, by id.
    spots : dict
        Laser spots of the samples, by `PairPlan.spot`: an experiment's by target, a drawn one by sample.
    poses : tuple of PosePlan
        In the order of their offsets, of drawn ones in the order of the samples; pairs of one rig share them.
    pairs : tuple of PairPlan
        In the order of the recipe.
    shard : str or None
        "i/n" where this is a part of the recipe (`shard_plan`).
    files : RoomFiles
        Of all rooms of the recipe, with the SHA-256 that they must have.
    refused : dict
        Samples that are not among `pairs`, because they cannot be drawn: the reason by id.
    left_out : dict
        Samples that are not among `pairs`, because a data set is finished without them: the cause by id (`without`).
    seen : dict
        Causes of both views, down and up, by id of those drawn samples that were traced; it is no part of the plan.
    """

    recipe: Recipe
    rig: Rig
    rigs: dict[str, Rig]
    rooms: dict[str, RoomSource]
    spots: dict[str, LaserSpot]
    poses: tuple[PosePlan, ...]
    pairs: tuple[PairPlan, ...]
    shard: str | None = None
    files: RoomFiles = RoomFiles()
    refused: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    seen: dict[str, tuple[str, str]] = field(default_factory=dict, compare=False)

    @property
    def sample_ids(self) -> list[str]:
        """Ids of all samples, of those too that cannot be drawn, in the order of the recipe."""
        names = [pair.sample_id for pair in self.pairs]
        return sorted([*names, *self.refused]) if self.refused else names  # drawn samples: their numbers give the order

    def without(self, causes: Mapping[str, str]) -> Plan:
        """Plan without some samples, and without the rigs, rooms, spots and poses that they alone have.

        Parameters
        ----------
        causes : cause by id of a sample; ids of no sample are ignored
        """
        if not causes:
            return self
        shorter = _of_pairs(self, tuple(pair for pair in self.pairs if pair.sample_id not in causes))
        return replace(
            shorter,
            refused={name: reason for name, reason in self.refused.items() if name not in causes},
            left_out=self.left_out | {name: causes[name] for name in self.sample_ids if name in causes},
        )

    def room(self, name: str) -> Room:
        """Room of an id, built from the files in their folder."""
        return room_of(self.rooms[name], self.files.folder)

    def view(self, pair: PairPlan, position: str) -> View:
        """View of a pair at a stroke position."""
        return self.rigs[pair.rig].at(pair.offset_m(position))


def make_plan(
    recipe: Recipe, files: RoomFiles | None = None, shard: str | None = None, kept: KeptSamples | None = None
) -> Plan:
    """Plan of a recipe or of a shard of it; `files` are those of its rooms, where it has panoramas or meshes.

    Samples of `[random]` that are `kept` are not drawn; the plan is the same.

    A shard of `[random]` whose samples have rigs of their own draws no sample and builds no room of another shard.

    Raises
    ------
    DatasetError
        If that is no shard, or has no sample.
    RecipeError
        If two strokes differ by less than a nanometre, so that their poses would share a name, or if all of the first
        samples of `[random]` stay impossible, or if a room cannot be built.
    """
    rig = build_rig(recipe.rig)
    try:
        files = room_files(recipe, files or RoomFiles())
        rooms = draw_rooms(recipe, files)
    except RoomError as error:
        raise RecipeError(f"rooms: {error}") from error
    if recipe.random is not None:
        own = _own_numbers(recipe, recipe.random, shard)
        plan = replace(_random_plan(recipe, recipe.random, rig, rooms, files, own, kept or {}), files=files)
        return shard_plan(plan, shard) if shard is None or own is None else replace(plan, shard=_written(shard))
    return shard_plan(_whole_plan(recipe, rig, rooms), shard)


def _own_numbers(recipe: Recipe, table: RandomTable, shard: str | None) -> range | None:
    """Numbers of a shard's samples; None where all samples have to be drawn."""
    return None if shard is None or not have_own_rigs(recipe, table) else _part_of(shard, table.samples)


def _whole_plan(recipe: Recipe, rig: Rig, rooms: dict[str, RoomSource]) -> Plan:
    """Plan of a recipe with `[[experiments]]`."""
    room = rooms[ONLY_ROOM]
    if recipe.rigs is not None:
        return _rigs_plan(recipe, recipe.rigs, rig, room)
    misalignment = build_misalignment(recipe.misalignment)
    true_rig = rig.perturbed(misalignment)
    # a misalignment of zeros makes no second rig, and with it no second set of views to render
    true_id = RECIPE_RIG if true_rig == rig else TRUE_RIG
    pairs = _experiment_pairs(recipe, misalignment, true_id)
    return _experiment_plan(recipe, {RECIPE_RIG: rig, true_id: true_rig}, room, pairs)


def _rigs_plan(recipe: Recipe, table: DrawnRigsTable, rig: Rig, room: RoomSource) -> Plan:
    """Every experiment with every drawn rig; samples are called after both."""
    drawn = draw_rigs(recipe, table, rig, room_of(room))
    pairs = tuple(
        replace(pair, sample_id=f"{pair.sample_id}-{drawn_rig.rig_id}", drawn=drawn_rig.drawn, tries=drawn_rig.tries)
        for drawn_rig in drawn
        for pair in _experiment_pairs(recipe, drawn_rig.misalignment, drawn_rig.rig_id)
    )
    return _experiment_plan(
        recipe, {RECIPE_RIG: rig} | {drawn_rig.rig_id: drawn_rig.rig for drawn_rig in drawn}, room, pairs
    )


def _experiment_pairs(recipe: Recipe, misalignment: Misalignment, rig_id: str) -> tuple[PairPlan, ...]:
    return tuple(
        PairPlan(
            _sample_name(experiment.name, target, stroke_m),
            experiment.name,
            target,
            true_stroke_m(misalignment, float(stroke_m)),
            float(stroke_m),
            target,
            rig_id,
        )
        for experiment in recipe.experiments
        for target in experiment.targets
        for stroke_m in experiment.strokes_m
    )


def _experiment_plan(recipe: Recipe, rigs: dict[str, Rig], room: RoomSource, pairs: tuple[PairPlan, ...]) -> Plan:
    """Poses in the order of the rigs, then of their offsets."""
    used = {pair.target for pair in pairs}
    spots = {table.name: build_spot(recipe.laser, table) for table in recipe.targets if table.name in used}
    order = {rig: number for number, rig in enumerate(rigs)}
    places = sorted(set(_places(pairs)), key=lambda place: (order[place[0]], place[1]))
    return Plan(recipe, rigs[RECIPE_RIG], rigs, {ONLY_ROOM: room}, spots, _poses(recipe, places), pairs)


def pose_name(offset_m: float) -> str:
    """Name of an offset in metres, to the nanometre, at least three decimals."""
    whole, decimals = f"{offset_m:.9f}".split(".")
    return f"h{whole}.{decimals.rstrip('0').ljust(3, '0')}"


def pose_of(rig: str, offset_m: float, room: str = ONLY_ROOM) -> str:
    """Id of the pose of a rig at an offset in a room."""
    parts = [*([] if room == ONLY_ROOM else [room]), *([] if rig == RECIPE_RIG else [rig]), pose_name(offset_m)]
    return "-".join(parts)


def _random_plan(
    recipe: Recipe,
    table: RandomTable,
    rig: Rig,
    rooms: dict[str, RoomSource],
    files: RoomFiles,
    wanted: range | None,
    kept: KeptSamples,
) -> Plan:
    """Equal rigs share an id, and so their views; the first sample that has one names it, so that more change none."""
    held: dict[int, RandomSample | str] = {number: one for number, one in kept.items() if isinstance(one, str)}
    if kept:
        held |= rebuilt_samples(recipe, table, list(rooms), kept, range(table.samples) if wanted is None else wanted)
    samples, refused = draw_samples(recipe, table, rooms, files.folder, wanted, held)
    ids = {rig: RECIPE_RIG}
    for sample in samples:
        ids.setdefault(sample.rig, f"r{sample.number:06d}")
        ids.setdefault(sample.nominal_rig, f"n{sample.number:06d}")
    pairs = tuple(_random_pair(sample, ids[sample.rig], ids[sample.nominal_rig]) for sample in samples)
    used = {name for pair in pairs for name in (pair.rig, pair.nominal_rig)}
    rigs = {name: one for one, name in ids.items() if name in used}
    spots = {pair.spot: sample.spot for pair, sample in zip(pairs, samples, strict=True)}
    seen = {pair.room for pair in pairs}
    used_rooms = {name: source for name, source in rooms.items() if name in seen}
    poses = _poses(recipe, dict.fromkeys(_places(pairs)))
    reasons = {_random_name(number): reason for number, reason in refused.items()}
    traced = {_random_name(one.number): (one.causes[0], one.causes[1]) for one in samples if one.causes}
    return Plan(recipe, rig, rigs, used_rooms, spots, poses, pairs, refused=reasons, seen=traced)


def _random_name(number: int) -> str:
    return f"random-{number:06d}"


def _random_pair(sample: RandomSample, rig: str, nominal_rig: str) -> PairPlan:
    name, strokes_m = _random_name(sample.number), (sample.stroke_m, sample.nominal_stroke_m)
    numbers = (name, "random", sample.surface, *strokes_m, name, rig, nominal_rig)
    return PairPlan(*numbers, drawn=sample.drawn, tries=sample.tries, room=sample.room)


def _sample_name(experiment: str, target: str, stroke_m: float) -> str:
    """Neither names nor numbers contain a hyphen, so that no two samples share a name."""
    return f"{experiment}-{target}-{pose_name(stroke_m)}"


_Place = tuple[str, float, str]


def _places(pairs: Sequence[PairPlan]) -> list[_Place]:
    """Rig, offset and room of every view of every pair."""
    return [(pair.rig, pair.offset_m(position), pair.room) for pair in pairs for position in POSITIONS]


def _poses(recipe: Recipe, places: Iterable[_Place]) -> tuple[PosePlan, ...]:
    # names have nine decimals: offsets that agree to the nanometre would write the same files
    poses = [(pose_of(*place), *place) for place in places]
    if twice := [name for name, count in Counter(pose[0] for pose in poses).items() if count > 1]:
        raise RecipeError(f"experiments: two strokes near {twice[0][1:]} m differ by less than 1 nm; make them equal")
    dataset = recipe.dataset
    return tuple(
        PosePlan(name, offset_m, seed_32(dataset.name, dataset.seed, name, "ambient"), rig, room)
        for name, rig, offset_m, room in poses
    )


def shard_plan(plan: Plan, shard: str | None) -> Plan:
    """Plan of one shard, "i/n" with i from 1 to n; None is the whole.

    Raises
    ------
    DatasetError
        If that is no shard, or has no sample.
    """
    if shard is None:
        return plan
    # shards in a row, without a gap; their sizes differ by one sample at most
    names = plan.sample_ids
    part = _part_of(shard, len(names))
    owned = set(names[part.start : part.stop])
    return replace(
        _of_pairs(plan, tuple(pair for pair in plan.pairs if pair.sample_id in owned)),
        shard=_written(shard),
        refused={name: reason for name, reason in plan.refused.items() if name in owned},
    )


def _of_pairs(plan: Plan, pairs: tuple[PairPlan, ...]) -> Plan:
    """Plan of some of the pairs, with what they need alone."""
    poses, spots = {pair.pose_id(p) for pair in pairs for p in POSITIONS}, {pair.spot for pair in pairs}
    rigs = {name for pair in pairs for name in (pair.rig, pair.nominal_rig)}
    return replace(
        plan,
        rigs={name: rig for name, rig in plan.rigs.items() if name in rigs},
        rooms={name: room for name, room in plan.rooms.items() if name in {pair.room for pair in pairs}},
        spots={name: spot for name, spot in plan.spots.items() if name in spots},
        poses=tuple(pose for pose in plan.poses if pose.pose_id in poses),
        pairs=pairs,
    )


def _written(shard: str) -> str:
    return "{}/{}".format(*parse_shard(shard))


def _part_of(shard: str, count: int) -> range:
    """Places of a shard's samples among so many."""
    i, n = parse_shard(shard)
    first, end = (k * count // n for k in (i - 1, i))
    if first == end:
        raise DatasetError(f"shard {shard} is empty: there are {count} samples; use at most as many shards")
    return range(first, end)


def parse_shard(shard: str) -> tuple[int, int]:
    """Return i and n of "i/n"."""
    i, slash, n = shard.partition("/")
    short = len(shard) <= 13 and i.isascii() and n.isascii()  # int("9" * 5000) raises an error of its own
    if not (slash and short and i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise DatasetError(
            f"shard '{printable_line(shard, 40)}': must be i/n with i from 1 to n, n of at most 6 digits, such as 1/4"
        )
    return int(i), int(n)
