"""Materials of a glTF file: colour, emission and opacity, and their pictures with the coordinates of each.

glTF 2.0, section 5.19 (Khronos Group, 2021; ISO/IEC 12113:2022), KHR_texture_transform,
KHR_materials_emissive_strength and KHR_materials_pbrSpecularGlossiness. Metal, gloss and relief are not kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from phibench.datasets.rooms.gltf_arrays import GltfDocument
from phibench.datasets.rooms.mesh_parts import BLACK, BRIGHTEST, ROUNDED, WHITE, three_numbers
from phibench.scenes.frames import Vector
from phibench.scenes.validation import printable_line

_GLOSSY = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True)
class GltfTexture:
    """Use of a picture by a material."""

    index: Any
    uv_set: int
    transform: dict[str, Any]


@dataclass(frozen=True)
class GltfMaterial:
    """Material, its colours linear."""

    name: str = ""
    colour: Vector = WHITE
    picture: GltfTexture | None = None
    light: Vector = BLACK
    light_picture: GltfTexture | None = None
    two_sided: bool = False
    opacity: float = 1.0
    cutoff: float | None = None
    """Opacity below which nothing is seen; of what blends the least above 0, None of what is opaque whatever it is."""


def gltf_material(document: GltfDocument, row: dict[str, Any]) -> GltfMaterial:
    """Material of its table.

    Raises
    ------
    RoomError
        If it has colours, emission or opacity that glTF does not allow.
    """
    extensions = document.table(row, "extensions")
    base, factor, texture = document.table(row, "pbrMetallicRoughness"), "baseColorFactor", "baseColorTexture"
    if _GLOSSY in extensions:
        base, factor, texture = document.table(extensions, _GLOSSY), "diffuseFactor", "diffuseTexture"
    emission = document.table(extensions, "KHR_materials_emissive_strength")
    strength = document.number(emission, "emissiveStrength", 1.0)
    light = tuple(x * strength for x in document.numbers(row, "emissiveFactor", BLACK))
    four = document.numbers(base, factor, (1.0, 1.0, 1.0, 1.0))
    colour, shown = three_numbers(four[:3]), printable_line(str(row.get("name", "")), 60)
    if not colour or not three_numbers(light):
        raise document.file.fault(
            f"has a material '{shown}' with a colour or emission that is not three numbers from 0 up"
        )
    if max(colour) > 1.0 + ROUNDED:
        raise document.file.fault(f"has a material '{shown}' with a {factor} up to {max(colour):g}: it ends at 1")
    mode = row.get("alphaMode", "OPAQUE")
    cutoffs = {"OPAQUE": None, "MASK": document.number(row, "alphaCutoff", 0.5), "BLEND": math.ulp(0.0)}
    if mode not in cutoffs:
        raise document.file.fault(f"has the alphaMode {printable_line(str(mode), 20)}, which glTF does not know")
    return GltfMaterial(
        str(row.get("name", "")),
        tuple(min(x, 1.0) for x in colour),
        _texture(document, base, texture),
        tuple(min(x, BRIGHTEST) for x in light),
        _texture(document, row, "emissiveTexture"),
        document.truth(row, "doubleSided", False),
        four[3],
        cutoffs[mode],
    )


def _texture(document: GltfDocument, owner: dict[str, Any], key: str) -> GltfTexture | None:
    if owner.get(key) is None:
        return None
    stated = document.table(owner, key)
    transform = document.table(document.table(stated, "extensions"), "KHR_texture_transform")
    uv_set = document.whole(transform if "texCoord" in transform else stated, "texCoord", 0, 100)
    return GltfTexture(stated.get("index"), uv_set, transform)
