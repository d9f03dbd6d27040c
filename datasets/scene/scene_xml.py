"""Scene as Mitsuba XML with the files that it names: meshes as PLY, pictures as PFM.

Numbers are written so that they read back exactly. Files are named after the shape and their contents: both stroke
positions share what is the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from phibench.datasets.store.files import write_bytes, write_text
from phibench.render.plugins.plugin_tree import BitmapPlugin, Plugin, Rgb, SceneSetting, Triangles, Value

FOLDERS = {"ply": "meshes", "pfm": "pictures"}


def write_scene(path: Path, scene: Plugin) -> Path:
    """Write a scene as XML and its meshes and pictures beside it, each atomically; the XML comes last."""
    return write_text(path, _Writer(path.parent).text(scene))


class _Writer:
    """Lines of one XML file; equal contents are written once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, str] = {}

    def text(self, scene: Plugin) -> str:
        settings = {value.name: value.value for value in scene.all_values() if isinstance(value, SceneSetting)}
        lines = ['<?xml version="1.0" encoding="utf-8"?>', '<scene version="3.0.0">']
        lines += [f'    <default name="{name}" value="{value}"/>' for name, value in settings.items()]
        for name, value in scene.values.items():
            lines += self._lines(name, value, 1)
        return "\n".join([*lines, "</scene>", ""])

    def _lines(self, name: str, value: Value, depth: int) -> Iterator[str]:
        indent = "    " * depth
        if not isinstance(value, Plugin):
            yield f"{indent}{self._line(name, value)}"
            return
        if value.label:
            yield f"{indent}<!-- {value.label.replace('--', '- -')} -->"
        own = f" id={quoteattr(value.name)}" if value.name else "" if depth == 1 else f" name={quoteattr(name)}"
        head = f"{indent}<{value.kind} type={quoteattr(value.type)}{own}"
        if not value.values:
            yield f"{head}/>"
            return
        yield f"{head}>"
        for key, inner in value.values.items():
            yield from self._lines(key, inner, depth + 1)
        yield f"{indent}</{value.kind}>"

    def _line(self, name: str, value: Value) -> str:
        if isinstance(value, np.ndarray):
            if value.ndim == 2:
                return f'<transform name="{name}"><matrix value="{_numbers(value.ravel())}"/></transform>'
            x, y, z = (repr(float(number)) for number in value)
            return f'<point name="{name}" x="{x}" y="{y}" z="{z}"/>'
        if isinstance(value, Rgb):
            return f'<rgb name="{name}" value="{_numbers(np.array(value.values))}"/>'
        if isinstance(value, SceneSetting):
            return f'<integer name="{name}" value="${value.name}"/>'
        if isinstance(value, bool):
            return f'<boolean name="{name}" value="{str(value).lower()}"/>'
        if isinstance(value, int | float):
            return f'<float name="{name}" value="{float(value)!r}"/>'
        if isinstance(value, BitmapPlugin | Triangles):
            value = self._file(value)
        return f"<string name={quoteattr(name)} value={quoteattr(str(value))}/>"

    def _file(self, content: BitmapPlugin | Triangles) -> str:
        """Name of a file with this content; written now if it is not yet."""
        data = content.data()
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._names:
            name = f"{FOLDERS[content.suffix]}/{content.name}-{digest[:8]}.{content.suffix}"
            write_bytes(self._folder / name, data)
            self._names[digest] = name
        return self._names[digest]


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in values)
