"""Small things on boards and tables: books, boxes, bottles, monitors, desk lamps.

Each piece is a function of a random generator and the room's materials that returns an `Assembly`.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.worlds import graphics
from phibench.scenes.worlds.assembly import Assembly
from phibench.scenes.worlds.materials import PAINTS, THINGS, MaterialSet, Rng, Surface, one_of


def carton(rng: Rng, materials: MaterialSet, size_m: tuple[float, float]) -> Surface:
    """Surface of a box whose front has a size: its picture fills the front once."""
    rows, columns = (int(np.clip(length / 0.012, 8, 48)) for length in (size_m[1], size_m[0]))  # texels of 12 mm
    return materials.print(graphics.carton(rng, (rows, columns)), size_m)


# Small things on boards and tables.


def book_row(rng: Rng, materials: MaterialSet, width_m: float, depth_m: float, height_m: float) -> Assembly:
    """Books in a row, in groups of different heights."""
    made, x = Assembly(), -0.5 * width_m
    for k in range(3):
        width = min(float(rng.uniform(0.25, 0.7)) * width_m, 0.5 * width_m - x)
        if width < 0.06:  # less than three books
            break
        high = height_m * float(rng.uniform(0.6, 0.92))
        columns = int(np.clip(width / 0.007, 8, 96))  # texels of 7 mm across: a spine has some
        surface = materials.print(graphics.spines(rng, (24, columns)), (width, high))
        made.box(
            f"books_{k + 1}",
            (x, x + width),
            (-0.5 * depth_m, 0.5 * depth_m * rng.uniform(0.5, 1.0)),
            (0.0, high),
            surface,
        )
        x += width + (0.0 if rng.random() < 0.6 else 0.08)
    return made


def thing(rng: Rng, materials: MaterialSet, size_m: float, height_m: float) -> Assembly:
    """Something small within a square of a size: a box, a bottle, a pile of paper, a device, a plant, a bowl."""
    made, kind = Assembly(), rng.integers(6)
    high, half = height_m * float(rng.uniform(0.25, 0.9)), 0.5 * size_m * float(rng.uniform(0.5, 0.98))
    if kind == 0:
        surface = carton(rng, materials, (1.5 * half, high))
        turn = float(rng.uniform(-0.3, 0.3))
        made.box("box", (-0.75 * half, 0.75 * half), (-0.6 * half, 0.6 * half), (0.0, high), surface, turn)
    elif kind == 1:
        radius = min(half, 0.05)
        surface = one_of(rng, materials, (*PAINTS, "dark_glass", "porcelain", "white_plastic"), 2)
        made.post("body", 0.0, 0.0, (0.0, 0.7 * high), radius, surface)
        made.post("neck", 0.0, 0.0, (0.7 * high, high), 0.4 * radius, surface, 6)
    elif kind == 2:
        surface = materials.surface("paper", int(rng.integers(3)))
        made.box(
            "paper",
            (-half * 0.7, half * 0.7),
            (-half, half),
            (0.0, min(high, 0.08)),
            surface,
            float(rng.uniform(-0.2, 0.2)),
        )
    elif kind == 3:
        case = one_of(rng, materials, ("dark_plastic", "grey_plastic", "white_plastic"))
        made.box("device", (-half, half), (-0.7 * half, 0.7 * half), (0.0, high), case)
        front = graphics.buttons(rng, (16, 24), graphics.muted(graphics.ink_colours(rng, 3), 0.25))
        size = (1.8 * half, 0.8 * high)
        made.panel(
            "front", (0.0, -0.7 * half - 0.002, 0.5 * high), (0.0, -1.0, 0.0), size, materials.print(front, size)
        )
    elif kind == 4:
        made.post("pot", 0.0, 0.0, (0.0, 0.4 * high), 0.55 * half, materials.surface("terracotta"))
        made.post(
            "leaves", 0.0, 0.0, (0.4 * high, high), 0.95 * half, materials.surface("leaves", int(rng.integers(2))), 7
        )
    else:
        made.post("bowl", 0.0, 0.0, (0.0, min(high, 0.12)), half, one_of(rng, materials, THINGS, 2), 10)
    return made


def scatter(
    rng: Rng,
    made: Assembly,
    materials: MaterialSet,
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    count: int,
    name: str = "thing",
) -> None:
    """Things in cells of a board that starts at (x, y, z)."""
    cells = max(int((x[1] - x[0]) / 0.22), 1)  # one thing a cell: none stands in another
    for k in rng.permutation(cells)[: min(count, cells)]:
        pitch = (x[1] - x[0]) / cells
        size = min(pitch, y[1] - y[0]) * 0.9
        piece = thing(rng, materials, size, float(rng.uniform(0.08, 0.35)))
        made.add(
            piece,
            x[0] + (k + 0.5) * pitch,
            float(rng.uniform(y[0] + size / 2, y[1] - size / 2)),
            z,
            0.0,
            f"{name}_{k + 1}",
        )


def monitor(rng: Rng, materials: MaterialSet) -> Assembly:
    """Screen on a foot."""
    made, dark = Assembly(), materials.surface("dark_plastic")
    width = float(rng.uniform(0.42, 0.7))  # 19 to 32 inches
    high = width * 0.6  # 16:10, with its frame
    made.box("foot", (-0.12, 0.12), (-0.09, 0.09), (0.0, 0.012), dark)
    made.box("neck", (-0.025, 0.025), (0.03, 0.06), (0.012, 0.14 + 0.3 * high), dark)
    made.box("case", (-0.5 * width, 0.5 * width), (-0.02, 0.03), (0.14, 0.14 + high), dark)
    place = (0.0, -0.022, 0.14 + 0.5 * high)
    made.panel(
        "screen", place, (0.0, -1.0, 0.0), (width - 0.03, high - 0.03), materials.surface("dark_glass"), "screen"
    )
    return made


def desk_lamp(rng: Rng, materials: MaterialSet) -> Assembly:
    """Lamp with a foot, an arm and a shade; the bulb is a square under the shade."""
    made, metal = Assembly(), one_of(rng, materials, (*PAINTS, "steel", "dark_plastic"))
    high = float(rng.uniform(0.32, 0.5))
    made.post("foot", 0.0, 0.0, (0.0, 0.02), 0.08, metal, 12)
    made.rod("arm", (0.0, 0.0, 0.022), (0.068, -0.027, high - 0.002), 0.008, metal, 6)
    made.post("shade", 0.13, -0.08, (high, high + 0.09), 0.075, metal, 12)
    made.panel(
        "bulb", (0.13, -0.08, high - 0.001), (0.0, 0.0, -1.0), (0.09, 0.09), materials.surface("white_plastic"), "bulb"
    )
    return made
