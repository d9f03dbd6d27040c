"""Samples against Mitsuba's path tracer: a sound one passes, a wrong one is noticed, and the command tells."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from phibench.cli.main import main
from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.scene import scene_check
from phibench.datasets.scene.scene_check import RendererDifference, ViewComparison, check_view, chosen_samples
from phibench.scenes.metals import ReflectanceTable


@pytest.fixture(scope="module")
def sample(smallest_dataset: Path) -> Sample:
    return open_dataset(smallest_dataset)[0]


@pytest.fixture
def without_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave ambient light out: a room baked with texels of 0.5 m does not agree."""
    monkeypatch.setattr(scene_check, "_ambient", lambda _: {})


@pytest.mark.slow
@pytest.mark.usefixtures("without_light")
def test_outline_and_spot_of_a_sound_sample(sample: Sample) -> None:
    checked = check_view(sample, "down")
    assert set(checked.differences) == {"outline", "flux of the spot", "centroid of the spot"}
    assert checked.faults == []
    assert checked.differences["outline"].error < 0.005
    assert checked.differences["flux of the spot"].error < 0.005
    assert checked.differences["centroid of the spot"].error < 0.005


@pytest.mark.usefixtures("without_light")
def test_a_mirror_of_another_size_is_noticed(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers of R = 60 mm, scene of 60.6 mm: the outline by 0.4 px, the spot by its place, many errors of few rays."""
    monkeypatch.setattr(scene_check, "_SPOT_SAMPLES", scene_check._SPOT_SAMPLES // 16)
    rig = sample.rig
    wrong = replace(rig, mirror=replace(rig.mirror, radius_m=1.01 * rig.sphere.radius_m))
    right = scene_check.sample_scene
    monkeypatch.setattr(
        scene_check,
        "sample_scene",
        lambda one, position, light: right(
            replace(one, dataset=replace(one.dataset, rigs={one.row.rig: wrong})), position, light
        ),
    )
    checked = check_view(sample, "down")
    assert checked.differences["outline"].value == pytest.approx(0.4, rel=0.2)
    assert "down: outline of Mitsuba's path tracer differs by" in checked.faults[0]
    assert any("centroid" in fault for fault in checked.faults)


def test_a_mirror_that_no_plugin_holds_is_left_out_with_its_cause(sample: Sample) -> None:
    rig = sample.rig
    table = ReflectanceTable((550.0,), (0.5, 0.6), (0.0, 60.0))
    odd = replace(rig, mirror=replace(rig.mirror, reflectance_table=table))
    checked = check_view(replace(sample, dataset=replace(sample.dataset, rigs={sample.row.rig: odd})), "down")
    assert checked.differences == {}
    assert checked.faults == []
    assert checked.left_out[0].startswith("not compared: the mirror has a measured reflectance at 2 angles")


@pytest.mark.parametrize(("value", "fault"), [(0.004, False), (-0.0079, False), (0.0081, True), (float("nan"), True)])
def test_faults_begin_beyond_tolerance_and_three_errors(value: float, fault: bool) -> None:
    assert RendererDifference(value, 0.001, 0.005, "1").fault == fault


def test_samples_are_spread(smallest_dataset: Path) -> None:
    dataset = open_dataset(smallest_dataset)
    assert [one.row.sample_id for one in chosen_samples(dataset, 1)] == [dataset[0].row.sample_id]
    assert len(chosen_samples(dataset, 100)) == len(dataset)


@pytest.mark.parametrize(("value", "code"), [(0.001, 0), (0.05, 1)])
def test_command(
    smallest_dataset: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    value: float,
    code: int,
) -> None:
    def checks(one: Sample) -> Iterator[ViewComparison]:
        found = {"light in the mirror": RendererDifference(value, 0.001, 0.005, "1")}
        yield ViewComparison(one.row.sample_id, "down", found, ())

    monkeypatch.setattr(scene_check, "check_sample", checks)
    name = open_dataset(smallest_dataset)[0].row.sample_id
    assert main(["dataset", "verify", str(smallest_dataset), "--mitsuba", "1"]) == code
    out = capsys.readouterr().out
    assert f"{name} down: light in the mirror {100.0 * value:+.2f} % +- 0.10" in out
    assert ("differs by +5.00 % +- 0.10" in out) == (code == 1)
    assert main(["dataset", "verify", str(smallest_dataset), "--mitsuba", "1", "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert document["valid"] == (code == 0)
    assert document["notes"][0].startswith(f"Mitsuba: {name} down")
