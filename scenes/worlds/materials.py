"""Materials by name: albedo ranges from published tables, patterns, glossy coats; and a room's surfaces made of them.

Ranges are of the band mean, by name and material. Their sources:

* OSRAM, Encyclopedia of Light, table of reflection factors: plaster 0.8, white tiles 0.7, maple and birch 0.6, light
  oak 0.4, concrete 0.3, dark walnut and dark oak 0.2, red brick 0.2, breeze block 0.1; paints from white 0.8 to
  black 0.1.
* DIAL, evo support, table of reflection factors: new red brick 0.10 to 0.15, untreated concrete 0.2 to 0.3, light wood
  0.3 to 0.6, dark wood 0.10 to 0.15.
* Reflection coefficients of finishes as in Chinese lighting standards: cement screed 0.32, plywood 0.58, terrazzo 0.10
  to 0.70, marble 0.08 to 0.60, glazed tiles 0.08 to 0.80, cast iron 0.15, asphalt 0.10, curtains 0.3 to 0.5, wood
  laminate 0.12 to 0.36.

Ratios of the bands, and of 650 nm to band R, are ours, after the spectra's known course: wood, brick, skin and dyes
rise towards 650 nm, leaves fall there (chlorophyll), greys stay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from phibench.scenes.frames import Array, Vector
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.shapes import Bitmap, Texture, Uniform
from phibench.scenes.worlds import patterns
from phibench.scenes.worlds.patterns import Draw, Shape2
from phibench.scenes.worlds.room_properties import RoomProperties

_DARKEST, _BRIGHTEST = 0.015, 0.92  # nothing ordinary is beyond


@dataclass(frozen=True)
class Material:
    """Recipe of a surface.

    Attributes
    ----------
    albedo : 2 floats
        Range of the green band.
    red, blue : 2 floats each
        Ranges of the other bands, relative to green.
    laser : 2 floats
        Range at 650 nm, relative to band R.
    pattern : function or None
        None: one albedo everywhere.
    shape : 2 ints
        Rows and columns of the bitmap.
    second : 2 floats
        Range of the second colour's brightness relative to the first.
    third : 2 floats
        The same of the third: joints, mortar, ornaments.
    coated : float
        Factor on `RoomProperties.gloss`: probability of a coat; 0 for what is never glossy.
    """

    albedo: tuple[float, float]
    red: tuple[float, float] = (1.0, 1.0)
    blue: tuple[float, float] = (1.0, 1.0)
    laser: tuple[float, float] = (1.0, 1.0)
    pattern: Draw | None = None
    shape: Shape2 = (64, 64)
    texel_m: float = 0.008
    second: tuple[float, float] = (0.6, 0.85)
    third: tuple[float, float] = (0.4, 0.8)
    coated: float = 0.0


@dataclass(frozen=True)
class Surface:
    """Texture and coat of a shape: a texture and the refractive index of its coat, 0 for none."""

    texture: Texture
    coat: float = 0.0


_WOOD: dict[str, Any] = {
    "pattern": patterns.wood,
    "shape": (64, 128),
    "texel_m": 0.006,
    "second": (0.55, 0.8),
    "coated": 0.6,
}
_WORN: dict[str, Any] = {"pattern": patterns.worn, "second": (0.82, 0.95), "third": (1.1, 1.6)}
_FLOOR: dict[str, Any] = {"shape": (192, 192), "texel_m": 0.010}
_BIG: dict[str, Any] = {"shape": (128, 128), "texel_m": 0.012}

MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        # Wood.
        "light_wood": Material((0.3, 0.55), (1.15, 1.35), (0.5, 0.7), (1.05, 1.15), **_WOOD),
        "dark_wood": Material((0.06, 0.16), (1.3, 1.7), (0.4, 0.7), (1.1, 1.3), **_WOOD),
        "red_wood": Material((0.12, 0.22), (1.6, 2.1), (0.4, 0.6), (1.1, 1.25), **_WOOD),
        "plywood": Material((0.4, 0.58), (1.15, 1.3), (0.55, 0.7), (1.05, 1.1), **(_WOOD | {"coated": 0.2})),
        # Floors; the albedo follows the property.
        "planks": Material((0.1, 0.4), (1.2, 1.5), (0.5, 0.7), (1.05, 1.2), patterns.planks, coated=1.0, **_FLOOR),
        "parquet": Material(
            (0.1, 0.4), (1.25, 1.5), (0.45, 0.65), (1.05, 1.2), patterns.parquet, (160, 160), 0.008, coated=1.0
        ),
        "floor_tiles": Material((0.1, 0.6), (0.95, 1.15), (0.8, 1.0), pattern=patterns.tiles, coated=1.0, **_FLOOR),
        "checker_floor": Material(
            (0.1, 0.6),
            (0.9, 1.2),
            (0.7, 1.1),
            pattern=patterns.checker,
            second=(0.1, 0.5),
            third=(0.1, 0.5),
            coated=1.0,
            **_FLOOR,
        ),
        "carpet": Material(
            (0.06, 0.3),
            (0.8, 1.9),
            (0.5, 1.4),
            (1.05, 1.3),
            patterns.carpet,
            second=(0.4, 0.8),
            third=(0.6, 2.2),
            **_FLOOR,
        ),
        "plain_carpet": Material((0.05, 0.3), (0.8, 1.3), (0.7, 1.2), (1.0, 1.2), patterns.pile, **_BIG),
        "terrazzo": Material(
            (0.1, 0.6),
            (0.98, 1.1),
            (0.85, 1.0),
            pattern=patterns.terrazzo,
            shape=(160, 160),
            texel_m=0.007,
            second=(0.4, 0.8),
            third=(0.3, 1.3),
            coated=1.0,
        ),
        "screed": Material((0.18, 0.35), (1.0, 1.1), (0.85, 0.95), pattern=patterns.concrete, coated=0.3, **_FLOOR),
        # Walls and ceilings; the albedo follows the property.
        "plaster": Material((0.5, 0.85), pattern=patterns.plain, second=(0.86, 0.94), **_BIG),
        "wallpaper": Material((0.4, 0.8), pattern=patterns.wallpaper, second=(0.5, 0.9), **_BIG),
        "brick_wall": Material(
            (0.1, 0.2), (1.8, 2.6), (0.6, 0.8), (1.1, 1.2), patterns.bricks, (96, 128), 0.008, (0.5, 0.8), (1.8, 3.0)
        ),
        "painted_brick": Material(
            (0.4, 0.8), pattern=patterns.bricks, shape=(96, 128), texel_m=0.008, second=(0.9, 1.0), third=(0.8, 0.95)
        ),
        "concrete_wall": Material((0.2, 0.4), (1.0, 1.08), (0.85, 0.97), pattern=patterns.concrete, **_BIG),
        "wall_tiles": Material(
            (0.4, 0.8),
            (0.95, 1.05),
            (0.9, 1.1),
            pattern=patterns.tiles,
            shape=(128, 128),
            texel_m=0.007,
            second=(0.7, 1.0),
            third=(0.5, 0.8),
            coated=1.0,
        ),
        "wall_boards": Material(
            (0.2, 0.5), (1.15, 1.4), (0.5, 0.75), (1.05, 1.15), patterns.planks, (128, 128), 0.009, coated=0.3
        ),
        "ceiling_panels": Material(
            (0.6, 0.85), pattern=patterns.panels, second=(0.4, 0.6), third=(0.6, 0.8), shape=(120, 120), texel_m=0.010
        ),
        # Furniture and things.
        "white_lacquer": Material(
            (0.65, 0.82), (0.98, 1.02), (0.9, 1.0), pattern=patterns.metal, second=(0.93, 0.97), coated=1.0
        ),
        "grey_lacquer": Material(
            (0.2, 0.45), (0.95, 1.02), (0.95, 1.1), pattern=patterns.metal, second=(0.85, 0.95), coated=0.8
        ),
        "dark_plastic": Material((0.025, 0.06), coated=0.7, **_WORN),
        "grey_plastic": Material((0.15, 0.4), (0.97, 1.03), (0.9, 1.05), coated=0.5, **_WORN),
        "white_plastic": Material((0.6, 0.8), (0.98, 1.03), (0.85, 0.97), coated=0.6, **_WORN),
        "steel": Material((0.3, 0.5), (1.0, 1.05), (0.93, 1.0), pattern=patterns.metal, second=(0.7, 0.9)),
        "cast_iron": Material((0.06, 0.15), (1.0, 1.1), (0.9, 1.0), pattern=patterns.concrete, second=(0.5, 0.8)),
        "copper": Material((0.15, 0.25), (1.8, 2.4), (0.5, 0.7), (1.05, 1.2)),
        "galvanised": Material(
            (0.35, 0.5), (0.97, 1.0), (1.0, 1.05), pattern=patterns.terrazzo, second=(0.75, 0.9), third=(0.8, 1.1)
        ),
        "cardboard": Material(
            (0.22, 0.36), (1.25, 1.45), (0.55, 0.7), (1.05, 1.15), patterns.metal, second=(0.75, 0.9)
        ),
        "paper": Material((0.65, 0.8), (0.98, 1.03), (0.85, 1.0), (1.0, 1.03)),
        "cloth_grey": Material((0.08, 0.3), (0.9, 1.15), (0.8, 1.15), (1.05, 1.3), patterns.pile),
        "cloth_blue": Material((0.05, 0.15), (0.5, 0.9), (1.3, 2.2), (1.0, 1.5), patterns.pile),
        "cloth_red": Material((0.04, 0.1), (3.0, 5.5), (0.7, 1.2), (1.1, 1.3), patterns.pile),
        "cloth_green": Material((0.1, 0.25), (0.5, 0.9), (0.5, 0.9), (0.9, 1.3), patterns.pile),
        "plaid": Material(
            (0.1, 0.4), (0.8, 1.8), (0.5, 1.3), (1.05, 1.25), patterns.plaid, second=(0.3, 0.8), third=(0.8, 1.8)
        ),
        "curtain": Material(
            (0.3, 0.5), (0.9, 1.3), (0.6, 1.1), (1.0, 1.1), patterns.wallpaper, (64, 64), 0.010, (0.6, 0.9)
        ),
        "leather": Material((0.04, 0.12), (1.2, 2.2), (0.4, 0.9), (1.1, 1.2), patterns.concrete, coated=0.8),
        "skin": Material((0.12, 0.42), (1.3, 1.6), (0.65, 0.8), (1.08, 1.2)),
        "hair": Material((0.02, 0.15), (1.1, 1.6), (0.5, 0.8), (1.1, 1.3), patterns.metal, (32, 32)),
        "leaves": Material(
            (0.08, 0.16), (0.45, 0.75), (0.35, 0.55), (0.6, 0.9), patterns.foliage, (48, 48), second=(0.4, 0.7)
        ),
        "soil": Material((0.04, 0.09), (1.2, 1.5), (0.6, 0.8), (1.05, 1.15), patterns.concrete, (32, 32)),
        "terracotta": Material((0.15, 0.25), (1.8, 2.3), (0.5, 0.65), (1.08, 1.15), patterns.concrete, (32, 32)),
        "porcelain": Material((0.65, 0.8), (0.98, 1.02), (0.9, 1.0), coated=1.0),
        "pegboard": Material(
            (0.2, 0.6),
            (1.1, 1.4),
            (0.5, 0.9),
            (1.0, 1.1),
            patterns.pegboard,
            (64, 64),
            0.0065,
            (0.85, 0.95),
            (0.05, 0.15),
        ),
        "cork": Material((0.2, 0.3), (1.4, 1.7), (0.45, 0.6), (1.05, 1.15), patterns.terrazzo, (64, 64), 0.005),
        "rubber": Material((0.03, 0.06), (1.0, 1.05), (0.95, 1.0), pattern=patterns.concrete, shape=(32, 32)),
        "paint_red": Material((0.03, 0.07), (6.0, 10.0), (0.7, 1.1), (1.05, 1.2), coated=0.8, **_WORN),
        "paint_blue": Material((0.06, 0.2), (0.3, 0.6), (1.6, 2.6), (0.8, 1.1), coated=0.8, **_WORN),
        "paint_green": Material((0.12, 0.3), (0.25, 0.6), (0.4, 0.8), (0.8, 1.0), coated=0.8, **_WORN),
        "paint_yellow": Material((0.4, 0.55), (1.3, 1.5), (0.06, 0.2), (1.02, 1.08), coated=0.8, **_WORN),
        "paint_orange": Material((0.16, 0.25), (2.4, 3.2), (0.1, 0.3), (1.05, 1.15), coated=0.8, **_WORN),
        "dark_glass": Material((0.015, 0.03), coated=2.0),
    }
)


WOODS = ("light_wood", "dark_wood", "red_wood", "plywood")
PAINTS = ("paint_red", "paint_blue", "paint_green", "paint_yellow", "paint_orange")
CLOTHS = ("cloth_grey", "cloth_blue", "cloth_red", "cloth_green", "plaid")
CASES = ("white_lacquer", "grey_lacquer", "light_wood", "dark_wood", "red_wood")
THINGS = (*PAINTS, "cardboard", "white_plastic", "dark_plastic", "grey_plastic", "steel", "porcelain", "paper")
"""Names of materials that pieces of furniture choose from."""
Rng = np.random.Generator


@dataclass
class MaterialSet:
    """Surfaces of one room, made when first asked for, so that shapes of one material share one bitmap.

    Each name has a random stream of its own: which materials a room uses changes none of them.
    """

    properties: RoomProperties
    stream: tuple[Name, ...]
    _kept: dict[tuple[str, int, bool], Surface] = field(default_factory=dict)

    def surface(self, name: str, kind: int = 0, *, upright: bool = False) -> Surface:
        """Surface of a material; other kinds have other colours; `upright` turns the grain along y."""
        key = (name, kind, upright)
        if key not in self._kept:
            self._kept[key] = _turned(self.surface(name, kind)) if upright else self._made(name, kind)
        return self._kept[key]

    def shell(self, part: str, name: str, albedo: float) -> Surface:
        """Surface of the floor, the walls or the ceiling with a stated mean albedo of the green band.

        Walls take a hue after `RoomProperties.saturation`, unless the material has its own.
        """
        key = (f"{part}:{name}:{albedo}", 0, False)
        if key not in self._kept:
            rng = generator(*self.stream, "material", part, name)
            made = replace(MATERIALS[name], albedo=(albedo, albedo))
            if made.red == (1.0, 1.0) and part == "wall":
                made = _tinted(made, self.properties.saturation, rng)
            self._kept[key] = self._drawn(made, rng)
        return self._kept[key]

    def _made(self, name: str, kind: int) -> Surface:
        return self._drawn(MATERIALS[name], generator(*self.stream, "material", name, kind))

    def _drawn(self, material: Material, rng: np.random.Generator) -> Surface:
        colours = _colours(material, rng)
        coat = float(rng.uniform(1.4, 1.6)) if rng.random() < material.coated * self.properties.gloss else 0.0
        if material.pattern is None and material.laser == (1.0, 1.0):
            return Surface(Uniform(_albedo(colours[0])), coat)
        if material.pattern is None:
            return Surface(Bitmap(colours[:1, None].astype(np.float32), (material.texel_m, material.texel_m)), coat)
        values = material.pattern(rng, material.shape, colours)
        return Surface(albedo_bitmap(values, material.texel_m, self.properties.pattern_contrast), coat)

    def print(self, values: Array, size_m: Vector, coat: float = 0.0) -> Surface:
        """Surface of a picture that fills a rectangle of a size once."""
        rows, columns = values.shape[:2]
        texel = (size_m[0] / columns, size_m[1] / rows)
        origin = (-0.5 * size_m[0], -0.5 * size_m[1])
        return Surface(Bitmap(np.clip(values, _DARKEST, _BRIGHTEST), texel, origin), coat)


def one_of(rng: Rng, materials: MaterialSet, names: tuple[str, ...], kinds: int = 1, upright: bool = False) -> Surface:
    """Surface of one of some materials, in one of so many colours."""
    return materials.surface(names[rng.integers(len(names))], int(rng.integers(kinds)), upright=upright)


def albedo_bitmap(values: Array, texel_m: float, contrast: float) -> Bitmap:
    """Bitmap of a pattern with its contrast multiplied; the mean stays, but for what would leave the range."""
    mean = values.mean(axis=(0, 1))
    return Bitmap(np.clip(mean + contrast * (values - mean), _DARKEST, _BRIGHTEST), (texel_m, texel_m))


def _turned(surface: Surface) -> Surface:
    texture = surface.texture
    if not isinstance(texture, Bitmap):
        return surface
    values = np.ascontiguousarray(np.swapaxes(texture.values, 0, 1))
    return replace(surface, texture=Bitmap(values, texture.texel_m[::-1], texture.origin_m[::-1]))


def _colours(material: Material, rng: np.random.Generator) -> Array:
    """Three colours (3, 4) of one hue; the second and the third brighter or darker, and their hues a little off."""
    green = rng.uniform(*material.albedo)
    ratio = np.array([rng.uniform(*material.red), 1.0, rng.uniform(*material.blue), 1.0])
    ratio[3] = ratio[0] * rng.uniform(*material.laser)
    level = np.array([1.0, rng.uniform(*material.second), rng.uniform(*material.third)])
    own = 1.0 + (level[:, None] != 1.0) * rng.normal(0.0, 0.04, (3, 4)) * (np.ptp(ratio) > 0.0)
    colours = green * level[:, None] * ratio * own
    if material.laser == (1.0, 1.0):
        colours[:, 3] = colours[:, 0]
    return np.clip(colours, _DARKEST, _BRIGHTEST)


def _tinted(material: Material, saturation: float, rng: np.random.Generator) -> Material:
    """Paint of a random hue. Bright colours are paler, as pigments are."""
    hue, strength = rng.uniform(0.0, 2.0 * np.pi), saturation * rng.beta(1.2, 2.5) * (1.1 - material.albedo[0])
    red, blue = float(1.0 + strength * np.cos(hue)), float(1.0 + strength * np.cos(hue - 2.0))
    return replace(material, red=(red, red), blue=(blue, blue), laser=(1.0, 1.1))


def _albedo(colour: Array) -> Vector:
    return tuple(float(value) for value in colour[:3])
