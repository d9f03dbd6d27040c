"""Code behind a module: the imports that are found quickly are those of the whole files."""

from __future__ import annotations

import ast
from pathlib import Path

from phibench.datasets.store.provenance import closure, import_statements, imports_of

ROOT = Path(__file__).parents[3]


def test_import_statements_are_those_of_whole_files() -> None:
    """Of all that makes and scores; a statement that was overlooked would stand in one of these files."""
    modules = {"phibench.datasets.make", "phibench.benchmark.scores.score"}
    behind = frozenset[str]().union(*map(closure, modules))
    assert len(behind) > 150
    for name in behind:
        source = ROOT.joinpath(*name.split(".")[1:]).with_suffix(".py").read_text(encoding="utf-8")
        assert set(imports_of(ast.parse(import_statements(source)))) == set(imports_of(ast.parse(source))), name


def test_statements_inside_functions_over_several_lines_and_in_examples() -> None:
    source = '''"""An example:

from phibench.scenes.room import Room
"""
import phibench.scenes.camera
from phibench.scenes.rig import (
    Rig,  # of the sensor (one)
)
def later():
    from phibench.scenes import laser, mirror
'''
    found = import_statements(source)
    assert "room" not in found
    assert {name.split(".")[-1] for name in imports_of(ast.parse(found))} == {"camera", "rig", "laser", "mirror"}
