"""Fixtures of a room's shell: doors, windows, what hangs on walls and below the ceiling.

Frames are those of `furniture`: a thing on a wall has its back at y = 0, the wall, and z above the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from phibench.scenes.frames import rotation_xyz
from phibench.scenes.worlds import graphics
from phibench.scenes.worlds.assembly import Assembly, Piece
from phibench.scenes.worlds.materials import PAINTS, MaterialSet, Rng, one_of
from phibench.scenes.worlds.tabletop import book_row, thing

_FRONT = (0.0, -1.0, 0.0)
_FRAMES = ("light_wood", "dark_wood", "red_wood", "white_lacquer", "dark_plastic", "steel")

# Openings.


def door(rng: Rng, materials: MaterialSet, angle_deg: float) -> Assembly:
    """Door with a frame, ajar by an angle; behind it a dim corridor, a picture 5 mm in front of the wall."""
    made = Assembly()
    width, high = float(rng.uniform(0.8, 1.0)), float(rng.uniform(1.98, 2.1))  # standard leaves
    frame = one_of(rng, materials, _FRAMES, upright=True)
    leaf = one_of(rng, materials, ("white_lacquer", "grey_lacquer", "light_wood", "dark_wood", *PAINTS), upright=True)
    if angle_deg > 3.0:  # a door that is closed hides it
        dim = materials.print(graphics.corridor(rng, (80, 36)), (width, high))
        made.panel("corridor", (0.0, -0.005, high / 2.0), _FRONT, (width, high - 0.002), dim)
    half = width / 2.0
    made.box("jamb_1", (-half - 0.07, -half), (-0.03, -0.001), (0.0, high), frame)
    made.box("jamb_2", (half, half + 0.07), (-0.03, -0.001), (0.0, high), frame)
    made.box("lintel", (-half - 0.07, half + 0.07), (-0.03, -0.001), (high, high + 0.07), frame)
    turn = math.radians(angle_deg)
    c, s = math.cos(turn), math.sin(turn)
    hinge = (-half + 0.03, -0.04)  # the leaf turns clear of the jamb

    # place on the leaf: from the hinge along it, and off its middle
    def at(along: float, off: float) -> tuple[float, float]:
        return hinge[0] + along * c - off * s, hinge[1] - along * s - off * c

    x, y = at(half - 0.035, 0.022)
    made.tilted("leaf", (x, y, high / 2.0), (width - 0.07, 0.04, high - 0.02), leaf, rotation_xyz(z_rad=-turn))
    x, y = at(width - 0.14, 0.065)
    made.tilted("handle", (x, y, 1.05), (0.12, 0.03, 0.03), materials.surface("steel"), rotation_xyz(z_rad=-turn))
    if rng.random() < 0.5:
        x, y = at(half - 0.035, 0.044)
        normal = (-s, -c, 0.0)
        sign = materials.print(graphics.notice(rng, (30, 22)), (0.3, 0.4))
        made.panel("notice", (x, y, 1.5), normal, (0.3, 0.4), sign)
    return made


def window(rng: Rng, materials: MaterialSet, width_m: float, height_m: float) -> Assembly:
    """Window: sky above (role "sky"), the view below (role "view"), bars, a sill, curtains or a blind, a radiator."""
    made, bar = Assembly(), one_of(rng, materials, ("white_lacquer", "dark_wood", "grey_lacquer", "light_wood"))
    # low enough for the mirror to see the sky
    sill, top, half = float(rng.uniform(0.55, 1.0)), min(height_m - 0.12, float(rng.uniform(2.0, 2.6))), width_m / 2.0
    horizon = float(np.clip(rng.uniform(0.9, 1.7), sill, top - 0.5))
    made.panel("sky", (0.0, -0.005, 0.5 * (horizon + top)), _FRONT, (width_m, top - horizon - 0.002), bar, "sky")
    if horizon > sill + 0.05:
        size = (width_m, horizon - sill - 0.002)
        # texels of 3 cm: what is far has no detail
        columns, rows = int(np.clip(width_m / 0.03, 16, 80)), int(np.clip(size[1] / 0.03, 8, 40))
        view = materials.print(graphics.outdoors(rng, (rows, columns)), size)
        made.panel("view", (0.0, -0.005, 0.5 * (sill + horizon)), _FRONT, size, view, "view")
    count = int(rng.integers(2, 5))
    for k in range(count + 1):
        x = -half + k * width_m / count
        made.box(f"bar_{k + 1}", (x - 0.03, x + 0.03), (-0.06, -0.008), (sill, top), bar)
    for k, z in enumerate((sill, horizon, top)):
        if k != 1 or rng.random() < 0.5:  # the horizon's beam is not in every window
            made.box(f"beam_{k + 1}", (-half - 0.03, half + 0.03), (-0.1, -0.062), (z - 0.03, z + 0.03), bar)
    made.box("sill", (-half - 0.1, half + 0.1), (-0.18, -0.001), (sill - 0.07, sill - 0.031), bar)
    kind = rng.integers(3)
    if kind == 0:
        cloth = materials.surface("curtain", int(rng.integers(2)))
        for side, sign in enumerate((-1.0, 1.0)):
            for k in range(3):
                x = sign * (half - 0.04 + 0.1 * k)
                made.box(
                    f"curtain_{3 * side + k + 1}",
                    (x - 0.045, x + 0.045),
                    (-0.16 - 0.03 * (k % 2), -0.11),
                    (0.05 + sill - 0.02, top + 0.05),
                    cloth,
                )
    elif kind == 1:
        drop = float(rng.uniform(0.05, 0.3)) * (top - sill)
        made.box(
            "blind",
            (-half, half),
            (-0.13, -0.105),
            (top - drop, top - 0.031),
            one_of(rng, materials, ("curtain", "white_lacquer")),
        )
    if sill > 0.6:  # below a lower sill no radiator stands
        white = materials.surface("white_lacquer")
        ribs = int(width_m * 0.7 / 0.09)
        for k in range(ribs):
            x = -0.35 * width_m + 0.09 * k
            made.box(f"rib_{k + 1}", (x, x + 0.075), (-0.13, -0.04), (0.12, sill - 0.12), white)
    return made


# On walls.


def _picture(
    rng: Rng,
    materials: MaterialSet,
    made: Assembly,
    draw: Callable[[Rng, tuple[int, int]], np.ndarray],
    size: tuple[float, float],
    z: float,
    y: float,
) -> None:
    rows, columns = (int(np.clip(length / 0.010, 12, 110)) for length in (size[1], size[0]))  # texels of 1 cm
    coat = 1.5 if rng.random() < 0.4 * materials.properties.gloss else 0.0
    made.panel("print", (0.0, y, z), _FRONT, size, materials.print(draw(rng, (rows, columns)), size, coat))


def poster(rng: Rng, materials: MaterialSet) -> Assembly:
    """Poster, chart or notice without a frame, 5 mm in front of the wall."""
    made = Assembly()
    width = float(rng.uniform(0.3, 1.1))  # A4 to a wall chart
    draw = (graphics.poster, graphics.poster, graphics.notice, graphics.chart, graphics.photograph)[rng.integers(5)]
    _picture(
        rng,
        materials,
        made,
        draw,
        (width, width * float(rng.uniform(0.7, 1.45))),
        float(rng.uniform(1.35, 1.75)),
        -0.005,
    )
    return made


def picture(rng: Rng, materials: MaterialSet) -> Assembly:
    """Picture in a frame."""
    made, frame = Assembly(), one_of(rng, materials, _FRAMES)
    width = float(rng.uniform(0.25, 1.2))
    high, z = width * float(rng.uniform(0.6, 1.3)), float(rng.uniform(1.4, 1.7))
    made.box(
        "frame",
        (-width / 2 - 0.03, width / 2 + 0.03),
        (-0.03, -0.003),
        (z - high / 2 - 0.03, z + high / 2 + 0.03),
        frame,
    )
    _picture(rng, materials, made, graphics.photograph, (width, high), z, -0.032)
    return made


def notice_board(rng: Rng, materials: MaterialSet) -> Assembly:
    """White board or cork board with notices."""
    made, frame = Assembly(), materials.surface("steel")
    width, high, z = float(rng.uniform(0.9, 2.0)), float(rng.uniform(0.7, 1.1)), 1.5
    white = rng.random() < 0.6
    ground = frame if white else materials.surface("cork")
    made.box(
        "board",
        (-width / 2 - 0.02, width / 2 + 0.02),
        (-0.03, -0.003),
        (z - high / 2 - 0.02, z + high / 2 + 0.02),
        ground,
    )
    if white:
        _picture(rng, materials, made, graphics.whiteboard, (width, high), z, -0.032)
        return made
    for k in range(int(rng.integers(3, 9))):
        draw = (graphics.notice, graphics.poster, graphics.chart)[rng.integers(3)]
        size = (0.21, 0.297) if rng.random() < 0.7 else (0.148, 0.21)  # A4 and A5
        surface = materials.print(draw(rng, (36, 26)), size)
        # each 2 mm before the last one: they may overlap
        x, y = float(rng.uniform(-width / 2 + 0.12, width / 2 - 0.12)), -0.033 - 0.002 * k
        made.panel(f"notice_{k + 1}", (x, y, z + float(rng.uniform(-0.3, 0.3)) * (high - 0.3)), _FRONT, size, surface)
    return made


def wall_shelf(rng: Rng, materials: MaterialSet) -> Assembly:
    """Shelf board on brackets with books and things."""
    made, wood = Assembly(), one_of(rng, materials, _FRAMES)
    width = float(rng.uniform(0.6, 1.4))
    for row in range(int(rng.integers(1, 3))):
        z = 1.25 + 0.4 * row
        made.box(f"board_{row + 1}", (-width / 2, width / 2), (-0.24, -0.003), (z, z + 0.025), wood)
        for k, sign in enumerate((-1.0, 1.0)):
            x = sign * (width / 2 - 0.1)
            made.box(
                f"bracket_{2 * row + k + 1}",
                (x - 0.012, x + 0.012),
                (-0.2, -0.003),
                (z - 0.1, z),
                materials.surface("steel"),
            )
        made.add(
            book_row(rng, materials, 0.6 * width, 0.18, 0.3), -0.18 * width, -0.12, z + 0.025, 0.0, f"row_{row + 1}"
        )
        made.add(thing(rng, materials, 0.18, 0.3), 0.32 * width, -0.12, z + 0.025, 0.0, f"thing_{row + 1}")
    return made


def device(rng: Rng, materials: MaterialSet) -> Assembly:
    """Fuse box, control panel or first-aid box with a duct up to the ceiling."""
    made = Assembly()
    case = one_of(rng, materials, ("grey_lacquer", "white_lacquer", "grey_plastic", *PAINTS))
    width, high, z = float(rng.uniform(0.15, 0.6)), float(rng.uniform(0.2, 0.8)), float(rng.uniform(1.1, 1.5))
    depth = float(rng.uniform(0.08, 0.2))
    made.box("case", (-width / 2, width / 2), (-depth, -0.003), (z, z + high), case)
    size = (0.8 * width, 0.7 * high)
    draw = (
        graphics.buttons(rng, (24, 20), graphics.muted(graphics.ink_colours(rng, 3), 0.25))
        if rng.random() < 0.7
        else graphics.hazard(rng, (24, 24))
    )
    made.panel("front", (0.0, -depth - 0.002, z + high / 2), _FRONT, size, materials.print(draw, size))
    made.box(
        "duct",
        (-0.03, 0.03),
        (-0.05, -0.003),
        (z + high, materials.properties.height_m - 0.06),
        materials.surface("grey_plastic"),
    )
    return made


def extinguisher(rng: Rng, materials: MaterialSet) -> Assembly:
    """Fire extinguisher with its sign."""
    made, z = Assembly(), 0.75  # a handle within reach, as rules ask
    made.post("bottle", 0.0, -0.1, (z, z + 0.45), 0.075, materials.surface("paint_red"), 14)
    made.post("valve", 0.0, -0.1, (z + 0.45, z + 0.55), 0.03, materials.surface("dark_plastic"), 6)
    made.panel("sign", (0.0, -0.005, z + 0.85), _FRONT, (0.2, 0.2), materials.surface("paint_red"))
    return made


def clock(rng: Rng, materials: MaterialSet) -> Assembly:
    """Round clock with two hands."""
    made, z, radius = Assembly(), float(rng.uniform(1.9, 2.1)), float(rng.uniform(0.1, 0.18))  # above heads
    made.rod("rim", (0.0, -0.003, z), (0.0, -0.04, z), radius, one_of(rng, materials, _FRAMES), 24)
    made.rod("face", (0.0, -0.041, z), (0.0, -0.044, z), 0.9 * radius, materials.surface("paper"), 24)
    for k, length in enumerate((0.5, 0.8)):
        turn = float(rng.uniform(0.0, 2.0 * np.pi))
        centre = (
            0.45 * length * radius * math.sin(turn),
            -0.047 - 0.003 * k,  # hands turn before each other
            z + 0.45 * length * radius * math.cos(turn),
        )
        made.tilted(
            f"hand_{k + 1}",
            centre,
            (0.012, 0.002, length * radius),
            materials.surface("dark_plastic"),
            rotation_xyz(y_rad=turn),
        )
    return made


def coats(rng: Rng, materials: MaterialSet) -> Assembly:
    """Row of hooks with coats."""
    made = Assembly()
    made.box("rail", (-0.5, 0.5), (-0.03, -0.003), (1.62, 1.72), one_of(rng, materials, _FRAMES))
    for k in range(4):
        x = -0.4 + 0.26 * k
        if rng.random() < 0.7:
            cloth = one_of(
                rng, materials, ("cloth_grey", "cloth_blue", "cloth_red", "cloth_green", "plaid", "leather"), 3
            )
            long = float(rng.uniform(0.6, 1.05))  # a jacket to a coat
            made.box(f"coat_{k + 1}", (x - 0.11, x + 0.11), (-0.2, -0.04), (1.6 - long, 1.6), cloth)
    return made


def pipes(rng: Rng, materials: MaterialSet) -> Assembly:
    """Upright pipes with a valve."""
    made = Assembly()
    top = materials.properties.height_m - 0.06
    for k in range(int(rng.integers(1, 4))):
        radius = float(rng.uniform(0.012, 0.055))  # of water and of drains
        surface = one_of(rng, materials, ("copper", "galvanised", "white_lacquer", "steel", *PAINTS))
        made.post(f"pipe_{k + 1}", -0.15 + 0.15 * k, -0.08, (0.0, top), radius, surface, 10)
    made.rod("valve", (-0.15, -0.15, 1.1), (-0.15, -0.2, 1.1), 0.06, materials.surface("paint_red"), 10)
    return made


def pegboard(rng: Rng, materials: MaterialSet) -> Assembly:
    """Pegboard with tools."""
    made = Assembly()
    width, low = float(rng.uniform(0.8, 1.8)), 1.0
    made.box("board", (-width / 2, width / 2), (-0.025, -0.003), (low, low + 0.9), materials.surface("pegboard"))
    for k in range(int(rng.integers(3, 11))):
        x, z = float(rng.uniform(-width / 2 + 0.06, width / 2 - 0.1)), float(rng.uniform(low + 0.35, low + 0.85))
        surface = one_of(rng, materials, (*PAINTS, "steel", "dark_plastic", "light_wood"))
        near = -0.03 - 0.003 * k  # tools may cross: each hangs before the last one
        made.box(
            f"tool_{k + 1}",
            (x, x + float(rng.uniform(0.02, 0.07))),
            (near - 0.02, near),
            (z - float(rng.uniform(0.1, 0.3)), z),
            surface,
        )
    return made


WALL_THINGS: Mapping[str, tuple[Piece, ...]] = MappingProxyType(
    {
        "office": (poster, poster, picture, notice_board, notice_board, wall_shelf, clock, coats, device),
        "home": (picture, picture, poster, wall_shelf, wall_shelf, clock, coats),
        "workshop": (pegboard, pegboard, device, extinguisher, pipes, poster, notice_board),
        "laboratory": (notice_board, poster, device, pipes, wall_shelf, extinguisher, pegboard, clock),
        "store": (poster, device, extinguisher, pipes, poster, clock),
    }
)
ONE_EACH = (extinguisher, clock)  # a second one in a room would look copied


# On ceilings.


def ceiling_run(rng: Rng, materials: MaterialSet, length_m: float) -> Assembly:
    """Pipe, duct or cable tray below the ceiling, along x, its back at y = 0."""
    made, top = Assembly(), materials.properties.height_m - 0.03
    half, kind = length_m / 2.0, rng.integers(3)
    surface = one_of(rng, materials, ("galvanised", "copper", "white_lacquer", "grey_lacquer", *PAINTS))
    if kind == 0:
        for k in range(int(rng.integers(1, 4))):
            radius = float(rng.uniform(0.015, 0.05))
            y, z = -0.1 - 0.13 * k, top - radius - 0.01
            made.rod(f"pipe_{k + 1}", (-half, y, z), (half, y, z), radius, surface, 10)
    elif kind == 1:
        radius = float(rng.uniform(0.08, 0.14))  # of an air duct
        made.rod(
            "duct",
            (-half, -0.05 - radius, top - radius),
            (half, -0.05 - radius, top - radius),
            radius,
            materials.surface("galvanised"),
            16,
        )
    else:
        made.box("tray", (-half, half), (-0.3, -0.1), (top - 0.1, top - 0.05), surface)
        for k in range(4):
            made.box(
                f"hanger_{k + 1}",
                (half * (-0.75 + 0.5 * k), half * (-0.75 + 0.5 * k) + 0.02),
                (-0.21, -0.19),
                (top - 0.05, top + 0.027),
                surface,
            )
    return made
