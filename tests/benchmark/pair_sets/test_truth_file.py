"""The truth's file: what is no truth is refused with its place, though its hash is the one that was sealed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.bench_cases import cases

from phibench.benchmark.pair_sets.frames_set import read_truth_file, truth_document, truth_text
from phibench.datasets.common.errors import DatasetError

TEXT = "0123456789abcdef" * 4
Change = Callable[[dict[str, Any]], object]


def read(path: Path, document: dict[str, Any]) -> list[Any]:
    path.write_text(json.dumps(document))
    return read_truth_file(path, hashlib.sha256(path.read_bytes()).hexdigest())


def document() -> dict[str, Any]:
    return dict(json.loads(truth_text(list(cases(2).truths), TEXT, TEXT)))


def test_a_truth_is_read_to_the_bit(tmp_path: Path) -> None:
    found = read(tmp_path / "truth.json", document())
    assert [truth_document(one) for one in found] == [truth_document(one) for one in cases(2).truths]


FAULTS: dict[str, tuple[Change, str]] = {
    "another format": (lambda d: d.update(format="phibench truth 3"), "format"),
    "no truths": (lambda d: d.pop("truths"), "truths"),
    "more": (lambda d: d["truths"][1].update(more=1), "truths.1.more"),
    "both names": (lambda d: d["truths"][1].update(believed_stroke_m=1.0), "truths.1.believed_stroke_m"),
    "a text for a number": (lambda d: d["truths"][1].update(depth_m="1"), "truths.1.depth_m"),
    "a truth value for a number": (lambda d: d["truths"][1].update(number=True), "truths.1.number"),
    "no depth": (lambda d: d["truths"][1].update(depth_m=None), "truths.1.depth_m"),
    "too large": (lambda d: d["truths"][1]["down"].update(electrons=1e200), "truths.1.down.electrons"),
    "an escape code": (lambda d: d["truths"][1].update(sample_id="\x1b[31m"), "truths.1.sample_id"),
    "a long name": (lambda d: d["truths"][1]["up"].update(cause="a" * 201), "truths.1.up.cause"),
    "a ragged matrix": (lambda d: d["truths"][1]["up"].update(bound_px2=[[1.0], [0.0, 1.0]]), "truths.1.up.bound_px2"),
    "three coordinates": (lambda d: d["truths"][1]["up"].update(uv_px=[1.0] * 3), "truths.1.up.uv_px"),
    "no ray": (lambda d: d["truths"][1]["up"]["phi_rad"].pop("ray"), "truths.1.up.phi_rad.ray"),
    "many distractions": (lambda d: d["truths"][1]["up"].update(distractions=[{}] * 1001), "truths.1.up.distractions"),
    "another rig": (lambda d: d["truths"][1]["true_rig"].pop("camera"), "truths.1: not a valid Rig"),
    "a number of 400 digits": (lambda d: d["truths"][1].update(draw=10**400), "truths.1.draw"),
}


@pytest.mark.parametrize(("change", "place"), FAULTS.values(), ids=FAULTS)
def test_what_is_no_truth_is_refused_with_its_place(tmp_path: Path, change: Change, place: str) -> None:
    content = document()
    change(content)
    with pytest.raises(DatasetError) as caught:
        read(tmp_path / "truth.json", content)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path / 'truth.json'} is damaged: ")
    assert place in text
    assert text.endswith("; give the truth's file")
    assert "\n" not in text
