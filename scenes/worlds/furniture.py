"""Furniture that stands on the floor: seats, tables, shelves, cabinets, machines.

`AGAINST_WALLS` and `FREE` say which pieces suit which use of a room.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from phibench.scenes.frames import rotation_xyz
from phibench.scenes.worlds import graphics
from phibench.scenes.worlds.assembly import Assembly, Piece
from phibench.scenes.worlds.materials import CASES, CLOTHS, PAINTS, WOODS, MaterialSet, Rng, one_of
from phibench.scenes.worlds.standing_objects import barrel, boxes, column, partition, plant, tripod, trolley
from phibench.scenes.worlds.tabletop import book_row, carton, desk_lamp, monitor, scatter, thing

# Seats.


def chair(rng: Rng, materials: MaterialSet) -> Assembly:
    """Chair with four legs, a seat and a back."""
    made = Assembly()
    frame = one_of(rng, materials, ("steel", "dark_plastic", *WOODS), upright=True)
    seat = one_of(rng, materials, (*WOODS, *CLOTHS, "dark_plastic", "paint_red", "paint_blue"))
    half, high = float(rng.uniform(0.19, 0.23)), float(rng.uniform(0.42, 0.46))  # of the seat, as chairs are sold
    leg = 0.032
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        x, y = sx * (half - 0.02), sy * (half - 0.02)
        top = high if sy < 0 else float(high + 0.42)
        offset = 0.0 if sy < 0 else 0.02 + 0.5 * leg  # the back legs stand behind the seat and carry the back
        made.box(
            f"leg_{k + 1}", (x - leg / 2, x + leg / 2), (y + offset - leg / 2, y + offset + leg / 2), (0.0, top), frame
        )
    made.box("seat", (-half, half), (-half, half - 0.001), (high, high + 0.045), seat)
    low = high + float(rng.uniform(0.12, 0.25))
    # between the legs, 2 mm behind the seat
    made.box("back", (-half + 0.041, half - 0.041), (half + 0.002, half + 0.025), (low, high + 0.42), seat)
    return made


def office_chair(rng: Rng, materials: MaterialSet) -> Assembly:
    """Chair on a column with five feet."""
    made, dark = Assembly(), materials.surface("dark_plastic")
    cloth = one_of(rng, materials, (*CLOTHS, "leather"), 2)
    for k in range(5):
        turn = 2.0 * np.pi * k / 5.0
        made.rod(
            f"foot_{k + 1}",
            (0.04 * np.cos(turn), 0.04 * np.sin(turn), 0.09),
            (0.29 * np.cos(turn), 0.29 * np.sin(turn), 0.05),
            0.02,
            dark,
            5,
        )
    made.post("column", 0.0, 0.0, (0.06, 0.44), 0.03, dark)
    made.box("seat", (-0.24, 0.24), (-0.24, 0.22), (0.44, 0.52), cloth)
    made.box("stem", (-0.03, 0.03), (0.23, 0.25), (0.46, 0.75), dark)
    made.tilted("back", (0.0, 0.30, 0.80), (0.44, 0.05, 0.5), cloth, rotation_xyz(x_rad=-0.12))  # 7 degrees back
    if rng.random() < 0.5:
        for k, sign in enumerate((-1.0, 1.0)):
            made.box(f"arm_{k + 1}", (sign * 0.28 - 0.025, sign * 0.28 + 0.025), (-0.15, 0.15), (0.65, 0.69), dark)
            made.box(f"rest_{k + 1}", (sign * 0.28 - 0.015, sign * 0.28 + 0.015), (-0.02, 0.02), (0.48, 0.65), dark)
    return made


def stool(rng: Rng, materials: MaterialSet) -> Assembly:
    """Round stool."""
    made, frame = Assembly(), one_of(rng, materials, ("steel", *WOODS), upright=True)
    high = float(rng.uniform(0.42, 0.75))  # from a chair's seat to a bar's
    for k in range(3):
        c, s = np.cos(2.1 * k), np.sin(2.1 * k)  # 120 degrees
        made.rod(f"leg_{k + 1}", (0.18 * c, 0.18 * s, 0.004), (0.1 * c, 0.1 * s, high - 0.004), 0.015, frame, 6)
    made.post("seat", 0.0, 0.0, (high, high + 0.04), 0.17, one_of(rng, materials, (*WOODS, *CLOTHS)), 16)
    return made


def sofa(rng: Rng, materials: MaterialSet) -> Assembly:
    """Sofa or armchair with cushions."""
    made, cloth = Assembly(), one_of(rng, materials, (*CLOTHS, "leather"), 3)
    seats = int(rng.integers(1, 4))  # an armchair to a sofa of three
    half = 0.33 * seats
    made.box("base", (-half, half), (-0.38, 0.28), (0.06, 0.26), cloth)
    made.box("back", (-half, half), (0.28, 0.45), (0.06, 0.82), cloth)
    for k, sign in enumerate((-1.0, 1.0)):
        low, high = sorted((sign * half, sign * (half + 0.18)))
        made.box(f"side_{k + 1}", (low, high), (-0.4, 0.45), (0.0, 0.6), cloth)
    for k in range(seats):
        x = -half + 0.66 * k
        made.box(f"cushion_{k + 1}", (x + 0.005, x + 0.655), (-0.4, 0.27), (0.26, 0.44), cloth)
        if rng.random() < 0.6:
            surface = one_of(rng, materials, CLOTHS, 3)
            made.tilted(f"pillow_{k + 1}", (x + 0.33, 0.12, 0.66), (0.42, 0.12, 0.4), surface, rotation_xyz(x_rad=-0.3))
    return made


# Tables.


def _top(rng: Rng, materials: MaterialSet, made: Assembly, width: float, depth: float, high: float) -> None:
    surface = one_of(rng, materials, (*WOODS, "white_lacquer", "grey_lacquer"))
    legs = one_of(rng, materials, ("steel", "dark_plastic", *WOODS), upright=True)
    thick = float(rng.uniform(0.022, 0.045))  # of boards
    made.box("top", (-width / 2, width / 2), (-depth / 2, depth / 2), (high - thick, high), surface)
    if rng.random() < 0.3:
        for k, sign in enumerate((-1.0, 1.0)):
            x = sign * (width / 2 - 0.05)
            made.box(
                f"side_{k + 1}",
                (x - 0.015, x + 0.015),
                (-depth / 2 + 0.02, depth / 2 - 0.02),
                (0.0, high - thick),
                legs,
            )
        return
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        x, y = sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06)
        made.box(f"leg_{k + 1}", (x - 0.025, x + 0.025), (y - 0.025, y + 0.025), (0.0, high - thick), legs)


def desk(rng: Rng, materials: MaterialSet) -> Assembly:
    """Desk with a monitor, keyboard, lamp, drawers, things and a chair in front."""
    made = Assembly()
    # offices' sizes
    width, depth, high = float(rng.uniform(1.2, 1.8)), float(rng.uniform(0.65, 0.8)), float(rng.uniform(0.71, 0.76))
    _top(rng, materials, made, width, depth, high)
    back = depth / 2
    for k in range(int(rng.integers(1, 3)) if width > 1.5 else 1):
        made.add(monitor(rng, materials), -0.2 + 0.72 * k, back - 0.15, high, 0.0, f"monitor_{k + 1}")
    # dark keys
    keys = materials.print(graphics.buttons(rng, (10, 30), graphics.ink_colours(rng, 3) * 0.3), (0.44, 0.14))
    made.box("keyboard", (-0.45, -0.01), (-0.2, -0.06), (high, high + 0.02), keys)
    clutter = materials.properties.clutter
    if rng.random() < 0.3 + 0.5 * clutter:
        scatter(
            rng, made, materials, (0.02, width / 2 - 0.02), (-back + 0.02, -back + 0.25), high, int(3 * clutter + 1)
        )
    if width > 1.45 and rng.random() < 0.6:
        made.add(desk_lamp(rng, materials), -width / 2 + 0.1, back - 0.12, high, -0.5 * np.pi, "lamp")
    if rng.random() < 0.6:
        case = one_of(rng, materials, CASES)
        for k in range(3):
            made.box(
                f"drawer_{k + 1}",
                (width / 2 - 0.5, width / 2 - 0.1),
                (-back + 0.06, back - 0.1),
                (0.03 + 0.19 * k, 0.2 + 0.19 * k),
                case,
            )
    seat = office_chair if rng.random() < 0.6 else chair
    made.add(
        seat(rng, materials),
        float(rng.uniform(-0.3, 0.0)),
        -back - 0.36,
        0.0,
        np.pi + float(rng.uniform(-0.5, 0.5)),
        "chair",
    )
    return made


def dining_table(rng: Rng, materials: MaterialSet) -> Assembly:
    """Table with chairs around and things on it."""
    clutter = materials.properties.clutter
    made = Assembly()
    # four to ten people
    width, depth, high = float(rng.uniform(1.1, 2.2)), float(rng.uniform(0.75, 1.0)), float(rng.uniform(0.71, 0.77))
    _top(rng, materials, made, width, depth, high)
    scatter(rng, made, materials, (-width / 2 + 0.05, width / 2 - 0.05), (-0.2, 0.2), high, int(5 * clutter))
    seat = chair if rng.random() < 0.7 else office_chair
    for k in range(int(width / 0.6)):  # a place is 60 cm wide
        for side, sign in enumerate((-1.0, 1.0)):
            if rng.random() < 0.65:
                x = -width / 2 + (k + 0.5) * width / int(width / 0.6)
                turn = (np.pi if sign < 0 else 0.0) + float(rng.uniform(-0.15, 0.15))
                made.add(seat(rng, materials), x, sign * (depth / 2 + 0.36), 0.0, turn, f"chair_{2 * k + side + 1}")
    return made


def round_table(rng: Rng, materials: MaterialSet) -> Assembly:
    """Round table on a column, with stools."""
    made = Assembly()
    radius, high = float(rng.uniform(0.3, 0.55)), float(rng.uniform(0.5, 1.05))  # from a side table to a standing one
    made.post("foot", 0.0, 0.0, (0.0, 0.03), 0.6 * radius, materials.surface("cast_iron"), 16)
    made.post("column", 0.0, 0.0, (0.03, high - 0.03), 0.04, materials.surface("steel"))
    made.post("top", 0.0, 0.0, (high - 0.03, high), radius, one_of(rng, materials, (*WOODS, "white_lacquer")), 24)
    made.add(thing(rng, materials, 0.25, 0.3), 0.0, 0.0, high, 0.0, "thing")
    for k in range(int(rng.integers(0, 4))):
        turn = 2.1 * k + float(rng.uniform(0.0, 0.6))
        made.add(
            stool(rng, materials),
            (radius + 0.25) * np.cos(turn),
            (radius + 0.25) * np.sin(turn),
            0.0,
            turn,
            f"stool_{k + 1}",
        )
    return made


def workbench(rng: Rng, materials: MaterialSet) -> Assembly:
    """Heavy bench with a board below, a pegboard with tools behind, and things."""
    clutter = materials.properties.clutter
    made = Assembly()
    width, wood = float(rng.uniform(1.2, 2.2)), one_of(rng, materials, ("plywood", "light_wood"))
    steel = one_of(rng, materials, ("steel", "paint_blue", "paint_green", "grey_lacquer"))
    made.box("top", (-width / 2, width / 2), (-0.35, 0.35), (0.82, 0.88), wood)
    made.box("shelf", (-width / 2 + 0.08, width / 2 - 0.08), (-0.28, 0.3), (0.25, 0.28), wood)
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        x, y = sx * (width / 2 - 0.04), sy * 0.3
        made.box(f"leg_{k + 1}", (x - 0.035, x + 0.035), (y - 0.035, y + 0.035), (0.0, 0.82), steel)
    scatter(rng, made, materials, (-width / 2 + 0.05, width / 2 - 0.05), (-0.3, 0.25), 0.88, int(7 * clutter))
    scatter(rng, made, materials, (-width / 2 + 0.15, width / 2 - 0.15), (-0.2, 0.2), 0.28, int(5 * clutter), "below")
    made.box("pegboard", (-width / 2, width / 2), (0.36, 0.375), (0.95, 1.75), materials.surface("pegboard"))
    for k in range(int(2 + 8 * clutter)):
        x, z = float(rng.uniform(-width / 2 + 0.1, width / 2 - 0.1)), float(rng.uniform(1.25, 1.6))
        surface = one_of(rng, materials, (*PAINTS, "steel", "dark_plastic", "light_wood"))
        made.box(
            f"tool_{k + 1}",
            (x, x + float(rng.uniform(0.02, 0.06))),
            (0.32 - 0.002 * k, 0.355 - 0.002 * k),  # tools may cross: each hangs 2 mm before the last one
            (z - float(rng.uniform(0.1, 0.28)), z),
            surface,
        )
    return made


# Cases.


def bookshelf(rng: Rng, materials: MaterialSet) -> Assembly:
    """Open shelf with a back, filled with books and things."""
    made, case = Assembly(), one_of(rng, materials, (*CASES, "plywood"))
    # shelves for folders and books
    width, depth, high = float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.26, 0.4)), float(rng.uniform(1.1, 2.05))
    board, half, back = 0.022, width / 2, depth / 2
    made.box("side_1", (-half, -half + board), (-back, back), (0.0, high), case)
    made.box("side_2", (half - board, half), (-back, back), (0.0, high), case)
    made.box("back", (-half + board, half - board), (back - 0.01, back), (0.0, high - board), case)
    rows = int(high / 0.36)  # a folder is 32 cm high
    pitch = (high - 0.06) / rows
    for k in range(rows + 1):
        low = min(0.04 + k * pitch, high - board)
        made.box(f"board_{k + 1}", (-half + board, half - board), (-back, back - 0.01), (low, low + board), case)
        if k == rows:
            break
        inside = (-half + board + 0.01, half - board - 0.01)
        if rng.random() < 0.25 + 0.6 * materials.properties.clutter:
            clear = pitch - board - 0.02
            if rng.random() < 0.65:
                made.add(
                    book_row(rng, materials, inside[1] - inside[0], 0.7 * depth, clear),
                    0.0,
                    0.0,
                    low + board,
                    0.0,
                    f"row_{k + 1}",
                )
            else:
                for j in range(int(width / 0.28)):
                    place = inside[0] + (j + 0.5) * (inside[1] - inside[0]) / int(width / 0.28)
                    made.add(thing(rng, materials, 0.22, clear), place, 0.0, low + board, 0.0, f"row_{k + 1}_{j + 1}")
    return made


def rack(rng: Rng, materials: MaterialSet) -> Assembly:
    """Industrial rack: posts, boards, and boxes with labels."""
    made, steel = Assembly(), one_of(rng, materials, ("steel", "galvanised", "paint_blue", "paint_orange"))
    # industrial racks
    width, depth, high = float(rng.uniform(1.0, 2.2)), float(rng.uniform(0.4, 0.6)), float(rng.uniform(1.6, 2.1))
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        x, y = sx * (width / 2 - 0.02), sy * (depth / 2 - 0.02)
        made.box(f"post_{k + 1}", (x - 0.02, x + 0.02), (y - 0.02, y + 0.02), (0.0, high), steel)
    levels = int(rng.integers(3, 5))
    board = one_of(rng, materials, ("plywood", "galvanised"))
    for k in range(levels):
        low = 0.1 + k * (high - 0.2) / levels
        made.box(
            f"board_{k + 1}",
            (-width / 2 + 0.042, width / 2 - 0.042),
            (-depth / 2 + 0.01, depth / 2 - 0.01),
            (low, low + 0.03),
            board,
        )
        x = -width / 2 + 0.06
        while x < width / 2 - 0.3:
            wide = float(rng.uniform(0.18, 0.5))
            if x + wide < width / 2 - 0.05 and rng.random() < 0.3 + 0.6 * materials.properties.clutter:
                tall = float(rng.uniform(0.15, max((high - 0.2) / levels - 0.08, 0.2)))
                surface = carton(rng, materials, (wide, tall))
                made.box(
                    f"crate_{k + 1}_{int(100 * x) + 200}",
                    (x, x + wide),
                    (-depth / 2 + 0.03, depth / 2 - 0.06),
                    (low + 0.03, low + 0.03 + tall),
                    surface,
                )
            x += wide + float(rng.uniform(0.01, 0.1))
    return made


def cabinet(rng: Rng, materials: MaterialSet) -> Assembly:
    """Closed case with doors, handles and things on top."""
    made, case = Assembly(), one_of(rng, materials, CASES, 2, upright=True)
    width, depth = float(rng.uniform(0.6, 1.8)), float(rng.uniform(0.4, 0.62))
    high = float(rng.choice([0.75, 0.9, 1.2, 1.8, 2.0]))  # steps in which cabinets are sold
    sides = (-width / 2 + 0.02, width / 2 - 0.02)
    made.box("plinth", sides, (-depth / 2 + 0.05, depth / 2), (0.0, 0.07), materials.surface("dark_plastic"))
    made.box("case", (-width / 2, width / 2), (-depth / 2 + 0.02, depth / 2), (0.07, high), case)
    doors = max(int(width / 0.5), 1)  # a door of a cabinet is half a metre wide
    front = one_of(rng, materials, CASES, 2, upright=True)
    for k in range(doors):
        x = -width / 2 + k * width / doors
        made.box(
            f"door_{k + 1}",
            (x + 0.004, x + width / doors - 0.004),
            (-depth / 2, -depth / 2 + 0.02),
            (0.09, high - 0.01),
            front,
        )
        handle = x + (0.05 if k % 2 else width / doors - 0.07)  # doors open in pairs, to the left and to the right
        made.box(
            f"handle_{k + 1}",
            (handle, handle + 0.02),
            (-depth / 2 - 0.03, -depth / 2),
            (0.5 * high, 0.5 * high + 0.16),
            materials.surface("steel"),
        )
    if high < 1.5:
        scatter(
            rng,
            made,
            materials,
            sides,
            (-depth / 2 + 0.05, depth / 2 - 0.02),
            high,
            int(6 * materials.properties.clutter),
        )
    return made


def machine(rng: Rng, materials: MaterialSet) -> Assembly:
    """Cabinet-sized device with a control panel, vents and a screen."""
    made, case = (
        Assembly(),
        one_of(rng, materials, ("grey_lacquer", "white_lacquer", "paint_blue", "paint_green", "dark_plastic")),
    )
    width, depth, high = float(rng.uniform(0.55, 1.2)), float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.9, 1.9))
    made.box("case", (-width / 2, width / 2), (-depth / 2, depth / 2), (0.05, high), case)
    made.box(
        "plinth",
        (-width / 2 + 0.04, width / 2 - 0.04),
        (-depth / 2 + 0.04, depth / 2 - 0.04),
        (0.0, 0.05),
        materials.surface("rubber"),
    )
    normal = (0.0, -1.0, 0.0)
    size = (0.8 * width, 0.35 * high)
    front = graphics.buttons(rng, (32, 40), graphics.muted(graphics.ink_colours(rng, 3), 0.25))
    # 2 mm before the case
    made.panel("controls", (0.0, -depth / 2 - 0.002, 0.72 * high), normal, size, materials.print(front, size))
    if rng.random() < 0.5:
        made.panel(
            "screen",
            (0.0, -depth / 2 - 0.005, 0.8 * high),
            normal,
            (0.3, 0.18),
            materials.surface("dark_glass"),
            "screen",
        )
    for k in range(4):
        z = 0.15 + 0.06 * k
        made.box(
            f"vent_{k + 1}",
            (-0.35 * width, 0.35 * width),
            (-depth / 2 - 0.012, -depth / 2),
            (z, z + 0.025),
            materials.surface("dark_plastic"),
        )
    made.rod(
        "pipe",
        (0.2 * width, 0.2 * depth, high + 0.001),
        (0.2 * width, 0.2 * depth, high + 0.2),
        0.04,
        materials.surface("galvanised"),
        10,
    )
    return made


# What suits which use.


AGAINST_WALLS: Mapping[str, Mapping[str, Piece]] = MappingProxyType(
    {
        "office": {"desk": desk, "bookshelf": bookshelf, "cabinet": cabinet, "copier": machine},
        "home": {"bookshelf": bookshelf, "cabinet": cabinet, "sofa": sofa, "desk": desk},
        "workshop": {"workbench": workbench, "rack": rack, "cabinet": cabinet, "machine": machine},
        "laboratory": {"workbench": workbench, "desk": desk, "machine": machine, "cabinet": cabinet, "rack": rack},
        "store": {"rack": rack, "shelf": bookshelf, "machine": machine, "crates": boxes},
    }
)
FREE: Mapping[str, Mapping[str, Piece]] = MappingProxyType(
    {
        "office": {
            "table": dining_table,
            "office_chair": office_chair,
            "plant": plant,
            "partition": partition,
            "bin": barrel,
        },
        "home": {"table": dining_table, "round_table": round_table, "armchair": sofa, "plant": plant, "chair": chair},
        "workshop": {
            "crates": boxes,
            "barrel": barrel,
            "trolley": trolley,
            "stool": stool,
            "column": column,
            "machine": machine,
        },
        "laboratory": {
            "trolley": trolley,
            "stool": stool,
            "tripod": tripod,
            "round_table": round_table,
            "machine": machine,
        },
        "store": {"crates": boxes, "rack": rack, "barrel": barrel, "column": column, "trolley": trolley},
    }
)
