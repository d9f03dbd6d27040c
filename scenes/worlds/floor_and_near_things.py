"""Objects on the floor (rugs, buckets, cones, cables), and what stands or hangs near the robot (arms, side tables)."""

from __future__ import annotations

import math

import numpy as np

from phibench.scenes.worlds import furniture, graphics, standing_objects
from phibench.scenes.worlds.assembly import Assembly, Piece
from phibench.scenes.worlds.materials import PAINTS, MaterialSet, Rng, one_of
from phibench.scenes.worlds.tabletop import thing

_FRONT = (0.0, -1.0, 0.0)
_FRAMES = ("light_wood", "dark_wood", "red_wood", "white_lacquer", "dark_plastic", "steel")


# On the floor.


def rug(rng: Rng, materials: MaterialSet) -> Assembly:
    """Rug, 8 mm thick."""
    made = Assembly()
    half = (float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.3, 0.6)))
    made.box(
        "rug",
        (-half[0], half[0]),
        (-half[1], half[1]),
        (0.0, 0.008),
        one_of(rng, materials, ("carpet", "plaid", "plain_carpet"), 2),
    )
    return made


def ball(rng: Rng, materials: MaterialSet) -> Assembly:
    """Ball as rings of a prism each."""
    made, radius = Assembly(), float(rng.uniform(0.08, 0.16))
    surface = one_of(rng, materials, (*PAINTS, "leather", "white_plastic"))
    for k in range(5):
        low, high = (-1.0 + 0.4 * k) * radius, (-0.6 + 0.4 * k) * radius  # five rings of a fifth of the diameter
        wide = math.sqrt(radius**2 - (0.5 * (low + high)) ** 2)  # of the ball at the ring's middle
        made.post(f"ring_{k + 1}", 0.0, 0.0, (radius + low, radius + high), wide, surface, 12)
    return made


def bucket(rng: Rng, materials: MaterialSet) -> Assembly:
    """Bucket or paper basket with something in it."""
    made = Assembly()
    radius, high = float(rng.uniform(0.1, 0.18)), float(rng.uniform(0.2, 0.4))
    made.post(
        "bucket", 0.0, 0.0, (0.0, high), radius, one_of(rng, materials, (*PAINTS, "galvanised", "dark_plastic")), 16
    )
    made.post(
        "contents",
        0.0,
        0.0,
        (high, high + 0.02),
        0.85 * radius,
        one_of(rng, materials, ("paper", "soil", "rubber")),
        10,
    )
    return made


def cone(rng: Rng, materials: MaterialSet) -> Assembly:
    """Traffic cone: rings that get smaller, and a foot."""
    made = Assembly()
    made.box("foot", (-0.14, 0.14), (-0.14, 0.14), (0.0, 0.03), materials.surface("rubber"))
    for k in range(4):
        surface = materials.surface("white_plastic" if k == 2 else "paint_orange")
        made.post(f"ring_{k + 1}", 0.0, 0.0, (0.03 + 0.11 * k, 0.14 + 0.11 * k), 0.11 - 0.025 * k, surface, 12)
    return made


def shoes(rng: Rng, materials: MaterialSet) -> Assembly:
    """Pair of shoes."""
    made, surface = Assembly(), one_of(rng, materials, ("leather", "cloth_blue", "cloth_red", "dark_plastic"), 2)
    for k, sign in enumerate((-1.0, 1.0)):
        turn = float(rng.uniform(-0.4, 0.4))
        made.box(f"sole_{k + 1}", (sign * 0.1 - 0.045, sign * 0.1 + 0.045), (-0.14, 0.14), (0.0, 0.05), surface, turn)
        made.box(f"heel_{k + 1}", (sign * 0.1 - 0.04, sign * 0.1 + 0.04), (0.0, 0.1), (0.05, 0.11), surface, turn)
    return made


def sheets(rng: Rng, materials: MaterialSet) -> Assembly:
    """Sheets of paper that dropped."""
    made = Assembly()
    for k in range(int(rng.integers(1, 4))):
        surface = materials.print(graphics.notice(rng, (36, 26)), (0.21, 0.297))
        turn = float(rng.uniform(-3.0, 3.0))
        x, y = float(rng.uniform(-0.15, 0.15)), float(rng.uniform(-0.15, 0.15))
        made.box(
            f"sheet_{k + 1}",
            (x - 0.105, x + 0.105),
            (y - 0.148, y + 0.148),
            (0.004 * k, 0.004 * k + 0.003),
            surface,
            turn,
        )
    return made


def cable(rng: Rng, materials: MaterialSet) -> Assembly:
    """Cable in a few straight pieces."""
    made, colour = Assembly(), one_of(rng, materials, ("dark_plastic", "paint_orange", "white_plastic"))
    place, turn = np.array([-0.4, 0.0, 0.008]), float(rng.uniform(-0.6, 0.6))
    for k in range(5):
        turn += float(rng.uniform(-0.7, 0.7))  # a cable does not bend sharply
        after = place + float(rng.uniform(0.1, 0.3)) * np.array([math.cos(turn), math.sin(turn), 0.0])
        made.rod(f"piece_{k + 1}", tuple(place), tuple(after), 0.007, colour, 5)
        place = after
    return made


def small_thing(rng: Rng, materials: MaterialSet) -> Assembly:
    """One of the things that also stand on tables."""
    return thing(rng, materials, 0.35, 0.4)


FLOOR_THINGS: tuple[Piece, ...] = (
    rug,
    ball,
    bucket,
    cone,
    shoes,
    sheets,
    cable,
    small_thing,
    small_thing,
    standing_objects.boxes,
)


# Near the robot.


def hanging_cable(rng: Rng, materials: MaterialSet) -> Assembly:
    """Cable that hangs from the ceiling, with a plug or a hook."""
    made, top = Assembly(), materials.properties.height_m - 0.004  # no face shares the ceiling's plane
    low = float(rng.uniform(0.5, 1.3))  # beside the mirror's way, up to its top
    colour = one_of(rng, materials, ("dark_plastic", "paint_orange", "paint_yellow", "steel"))
    made.post("cable", 0.0, 0.0, (low, top), float(rng.uniform(0.008, 0.02)), colour, 8)
    made.post("plug", 0.0, 0.0, (low - 0.1, low), 0.035, one_of(rng, materials, (*PAINTS, "dark_plastic")), 10)
    return made


def arm(rng: Rng, materials: MaterialSet) -> Assembly:
    """Post with an arm that reaches towards +y, and something at its end."""
    made, frame = Assembly(), one_of(rng, materials, ("steel", "dark_plastic", *PAINTS))
    # towards the stroke axis, up to the free cylinder
    high, reach = float(rng.uniform(0.5, 1.5)), float(rng.uniform(0.25, 0.5))
    made.post("foot", 0.0, 0.0, (0.0, 0.03), 0.14, frame, 14)
    made.post("post", 0.0, 0.0, (0.03, high), 0.018, frame)
    made.rod("arm", (0.0, 0.02, high - 0.04), (0.0, reach, high - 0.02), 0.014, frame)
    made.box(
        "end", (-0.05, 0.05), (reach + 0.002, reach + 0.06), (high - 0.1, high + 0.05), one_of(rng, materials, PAINTS)
    )
    return made


def side_table(rng: Rng, materials: MaterialSet) -> Assembly:
    """Table whose top reaches towards +y over a foot that stands back."""
    made, wood = Assembly(), one_of(rng, materials, ("light_wood", "dark_wood", "white_lacquer", "plywood"))
    high, half = float(rng.uniform(0.5, 0.75)), float(rng.uniform(0.2, 0.35))
    made.box("top", (-half, half), (-0.2, 0.3), (high - 0.03, high), wood)
    made.box("post", (-0.03, 0.03), (-0.18, -0.12), (0.03, high - 0.03), materials.surface("steel"))
    made.box("foot", (-half, half), (-0.2, -0.1), (0.0, 0.03), materials.surface("steel"))
    made.add(thing(rng, materials, 0.25, 0.35), 0.0, 0.0, high, 0.0, "thing")
    return made


NEAR_THINGS: tuple[Piece, ...] = (
    *(hanging_cable, hanging_cable, arm, arm, side_table, side_table),
    *(furniture.stool, standing_objects.boxes, standing_objects.tripod, standing_objects.plant),
    *(furniture.chair, bucket, cone),
)
