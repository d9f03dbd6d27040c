"""Objects that stand free on the floor: people-sized figures, plants, boxes, columns, partitions, trolleys, tripods."""

from __future__ import annotations

import numpy as np

from phibench.scenes.worlds import graphics
from phibench.scenes.worlds.assembly import Assembly
from phibench.scenes.worlds.materials import CLOTHS, PAINTS, THINGS, MaterialSet, Rng, one_of
from phibench.scenes.worlds.tabletop import carton, scatter


def figure(rng: Rng, materials: MaterialSet) -> Assembly:
    """People-sized figure: legs, trunk, arms, head and hair."""
    made = Assembly()
    tall = float(rng.uniform(1.5, 1.92))  # nine adults of ten
    trousers = one_of(rng, materials, ("cloth_grey", "cloth_grey", "cloth_blue"), 4)
    shirt = one_of(rng, materials, (*CLOTHS, "paper"), 4)
    skin, step = materials.surface("skin", int(rng.integers(3))), float(rng.uniform(0.0, 0.12))
    hip, neck = 0.5 * tall, 0.84 * tall  # parts of the height, as in drawings of people
    for k, sign in enumerate((-1.0, 1.0)):
        made.rod(f"leg_{k + 1}", (sign * 0.1, sign * step, 0.07), (sign * 0.085, 0.0, hip - 0.001), 0.075, trousers, 9)
        made.box(
            f"shoe_{k + 1}",
            (sign * 0.1 - 0.05, sign * 0.1 + 0.05),
            (sign * step - 0.18, sign * step + 0.08),
            (0.0, 0.065),
            materials.surface("leather"),
        )
        swing, out = float(rng.uniform(-0.35, 0.25)), sign * float(rng.uniform(0.26, 0.34))
        elbow = (out, swing * 0.4, 0.66 * tall)
        made.rod(f"upper_arm_{k + 1}", (sign * 0.235, 0.0, neck - 0.05), elbow, 0.048, shirt, 8)
        made.rod(
            f"lower_arm_{k + 1}", (elbow[0], elbow[1], elbow[2] - 0.01), (out, swing - 0.1, 0.52 * tall), 0.036, skin, 8
        )
    made.box("hips", (-0.17, 0.17), (-0.11, 0.11), (hip, hip + 0.14), trousers)
    made.box("trunk", (-0.18, 0.18), (-0.12, 0.11), (hip + 0.14, neck - 0.12), shirt)
    made.box("shoulders", (-0.22, 0.22), (-0.1, 0.1), (neck - 0.12, neck), shirt)
    made.post("neck", 0.0, 0.0, (neck, neck + 0.05), 0.055, skin, 8)
    made.post("face", 0.0, -0.01, (neck + 0.05, tall - 0.07), 0.085, skin, 12)
    made.post("hair", 0.0, 0.005, (tall - 0.07, tall), 0.095, materials.surface("hair", int(rng.integers(3))), 12)
    return made


def plant(rng: Rng, materials: MaterialSet) -> Assembly:
    """Pot with a stem and leaves as two-sided blades."""
    made = Assembly()
    # from a pot on the floor to a small tree
    high, reach = float(rng.uniform(0.7, 1.9)), float(rng.uniform(0.25, 0.45))
    pot = float(rng.uniform(0.13, 0.22))
    made.post(
        "pot", 0.0, 0.0, (0.0, 0.28), pot, one_of(rng, materials, ("terracotta", "white_plastic", "dark_plastic")), 14
    )
    made.post("soil", 0.0, 0.0, (0.28, 0.29), 0.9 * pot, materials.surface("soil"), 10)
    made.post("stem", 0.0, 0.0, (0.29, 0.75 * high), 0.018, materials.surface("dark_wood"), 6)
    count = int(rng.integers(14, 26))
    turn, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.35 * high, 0.8 * high, count)
    away = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    side = np.stack([-np.sin(turn), np.cos(turn), np.zeros(count)], axis=1) * rng.uniform(0.03, 0.09, count)[:, None]
    length = rng.uniform(0.5, 1.0, count)[:, None] * reach
    root = 0.02 * away + np.array([0.0, 0.0, 1.0]) * z[:, None]
    rise, drop = (
        np.array([0.0, 0.0, 1.0]) * rng.uniform(0.0, 0.25, (count, 1)),
        np.array([0.0, 0.0, -1.0]) * rng.uniform(0.0, 0.15, (count, 1)),
    )
    middle, tip = root + 0.5 * length * away + rise, root + length * away + rise + drop
    vertices = np.stack([root, middle - side, middle + side, tip], axis=1).reshape(-1, 3)
    # root, two sides, tip: two triangles
    corners = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [1, 3, 2]])
    made.mesh("leaves", vertices, corners.reshape(-1, 3), materials.surface("leaves", int(rng.integers(3))), 0.008)
    return made


def boxes(rng: Rng, materials: MaterialSet) -> Assembly:
    """Pile of boxes or crates."""
    made, z = Assembly(), 0.0
    half = float(rng.uniform(0.18, 0.4))
    for k in range(int(rng.integers(1, 5))):
        high = float(rng.uniform(0.15, 0.45))
        surface = carton(rng, materials, (2.0 * half, high))
        made.box(
            f"crate_{k + 1}",
            (-half, half),
            (-0.8 * half, 0.8 * half),
            (z, z + high),
            surface,
            float(rng.uniform(-0.25, 0.25)),
        )
        z, half = z + high, half * float(rng.uniform(0.7, 1.0))  # piles get narrower upwards, and stand
    return made


def barrel(rng: Rng, materials: MaterialSet) -> Assembly:
    """Barrel or tall bin with rings and a lid."""
    made, body = Assembly(), one_of(rng, materials, (*PAINTS, "steel", "grey_plastic", "cast_iron"))
    radius, high = float(rng.uniform(0.15, 0.3)), float(rng.uniform(0.4, 0.95))
    made.post("body", 0.0, 0.0, (0.0, high), radius, body, 20)
    # over the rim
    made.post("lid", 0.0, 0.0, (high, high + 0.03), radius * 1.04, materials.surface("dark_plastic"), 20)
    return made


def column(rng: Rng, materials: MaterialSet) -> Assembly:
    """Round or square column up to a little below the ceiling."""
    made, surface = Assembly(), one_of(rng, materials, ("concrete_wall", "plaster", "brick_wall", "cast_iron"))
    # no face shares the ceiling's plane
    high, half = materials.properties.height_m - 0.002, float(rng.uniform(0.1, 0.25))
    if rng.random() < 0.5:
        made.post("shaft", 0.0, 0.0, (0.0, high), half, surface, 20)
    else:
        made.box("shaft", (-half, half), (-half, half), (0.0, high), surface)
    return made


def partition(rng: Rng, materials: MaterialSet) -> Assembly:
    """Screen on feet with notices."""
    made, cloth = Assembly(), one_of(rng, materials, ("cloth_blue", "cloth_grey", "cork", "cloth_green"), 2)
    width, high = float(rng.uniform(0.9, 1.8)), float(rng.uniform(1.3, 1.9))  # of offices
    made.box("board", (-width / 2, width / 2), (-0.02, 0.02), (0.12, high), cloth)
    for k, sign in enumerate((-1.0, 1.0)):
        x = sign * (width / 2 - 0.1)
        made.box(f"foot_{k + 1}", (x - 0.03, x + 0.03), (-0.22, 0.22), (0.0, 0.03), materials.surface("steel"))
        made.box(f"post_{k + 1}", (x - 0.015, x + 0.015), (-0.015, 0.015), (0.03, 0.12), materials.surface("steel"))
    for k in range(int(rng.integers(0, 4))):
        surface = materials.print(graphics.notice(rng, (36, 26)), (0.21, 0.297))
        made.panel(
            f"notice_{k + 1}",
            (-width / 2 + 0.2 + 0.28 * k, -0.024, high - float(rng.uniform(0.25, 0.5))),
            (0.0, -1.0, 0.0),
            (0.21, 0.297),
            surface,
        )
    return made


def trolley(rng: Rng, materials: MaterialSet) -> Assembly:
    """Trolley: three trays on posts with wheels."""
    made, frame = Assembly(), one_of(rng, materials, ("steel", "paint_red", "paint_blue", "galvanised"))
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        x, y = 0.33 * sx, 0.2 * sy
        made.box(f"post_{k + 1}", (x - 0.012, x + 0.012), (y - 0.012, y + 0.012), (0.07, 0.88), frame)
        made.box(
            f"wheel_{k + 1}", (x - 0.012, x + 0.012), (y - 0.035, y + 0.035), (0.0, 0.07), materials.surface("rubber")
        )
    for k in range(3):
        z = 0.15 + 0.33 * k
        made.box(f"tray_{k + 1}", (-0.315, 0.315), (-0.18, 0.18), (z, z + 0.025), frame)
        count = int(3 * materials.properties.clutter)
        scatter(rng, made, materials, (-0.3, 0.3), (-0.17, 0.17), z + 0.025, count, f"tray_{k + 1}_thing")
    return made


def tripod(rng: Rng, materials: MaterialSet) -> Assembly:
    """Tripod with a camera-like box."""
    made, dark = Assembly(), materials.surface("dark_plastic")
    high = float(rng.uniform(0.8, 1.5))  # of the head
    for k in range(3):
        c, s = np.cos(2.1 * k), np.sin(2.1 * k)
        made.rod(f"leg_{k + 1}", (0.35 * c, 0.35 * s, 0.005), (0.03 * c, 0.03 * s, high), 0.012, dark, 6)
    made.box("head", (-0.07, 0.07), (-0.05, 0.05), (high + 0.012, high + 0.12), one_of(rng, materials, THINGS))
    return made
