"""The tutorials run from beginning to end, and what they show is what their texts say."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
NUMBER = r"-?\d+\.\d+"


def run(name: str, folder: Path) -> str:
    """Text of all outputs of a tutorial that was executed in a folder."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("nothing renders here: Mitsuba is not installed")
    pytest.importorskip("nbclient")
    pytest.importorskip("jupytext")
    spec = importlib.util.spec_from_file_location("run_notebook", ROOT / "docs" / "run_notebook.py")
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    cells = module.executed(ROOT / "docs" / "tutorials" / f"{name}.py", folder).cells
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    return "\n".join(str(o.get("text") or o.get("data", {}).get("text/plain", "")) for o in outputs)


def test_every_tutorial_is_tested_and_says_first_what_comes_out() -> None:
    assert [path.stem for path in TUTORIALS] == ["own_method", "own_rig", "real_frames"]
    for path in TUTORIALS:
        first = path.read_text(encoding="utf-8").split("# %% [markdown]\n")[1]
        assert re.match(r"# # Tutorial \d: .*\n#\n# At the end you have:\n#\n# \* ", first)


@pytest.mark.slow
def test_tutorial_of_a_method(tmp_path: Path) -> None:
    text = run("own_method", tmp_path)
    rms = {name: float(re.search(rf"^{name} +({NUMBER}) \(", text, re.M)[1]) for name in ("mine", "chain_fit")}  # type: ignore[index]
    # a quarter of a pixel's bias against the fit of the chain; the noise is drawn from named streams, always the same
    assert 0.1 < rms["chain_fit"] < rms["mine"] < 0.6
    assert (tmp_path / "sample.html").stat().st_size > 1e5


@pytest.mark.slow
def test_tutorial_of_a_rig(tmp_path: Path) -> None:
    text = run("own_rig", tmp_path)
    assert "hyperboloid" in (tmp_path / "workshop" / "dataset.json").read_text(encoding="utf-8")
    assert "Traceback" not in text
    assert re.search(r"rim_radius_m.*60", text)  # the refusal of the wrong recipe
    assert len(re.findall(rf"^ +{NUMBER} +{NUMBER} +{NUMBER}$", text, re.M)) >= 2  # rows of D and its two sigmas
    assert len(re.findall("mm of D per mm of the stroke", text)) >= 2


@pytest.mark.slow
def test_tutorial_of_real_frames(tmp_path: Path) -> None:
    text = run("real_frames", tmp_path)
    found = re.findall(rf"^wall-\w+-h0\.500: D = ({NUMBER}) m, sigma ({NUMBER}) m; ok", text, re.M)
    assert len(found) == 3
    # 4 sigmas: 1 in 5000 for three pairs, and the frames are the same in every run
    for (depth, sigma), true in zip(sorted(found), (1.4, 2.0, 2.8), strict=True):
        assert abs(float(depth) - true) < 4.0 * float(sigma)
    assert (tmp_path / "mine.json").is_file()
