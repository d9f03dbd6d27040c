"""Exported scenes: opened by Mitsuba without phibench, the same as the dictionary, with what is refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

import phibench
from phibench.cli.main import main
from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.scene.scene_export import expected_radiance, export_scene
from phibench.datasets.store.layers import read_exr
from phibench.render.setup.variant import activate

# A process without phibench: the import is refused. Its variant needs no LLVM.
STRANGER = """
import json, sys
sys.modules["phibench"] = None
import mitsuba as mi, numpy as np
mi.set_variant("scalar_rgb")
path, settings = sys.argv[1], json.loads(sys.argv[2])
image = np.array(mi.render(mi.load_file(path, **settings)))
print(json.dumps([image.shape, image.mean(axis=(0, 1)).tolist()]))
assert not [name for name in sys.modules if name.startswith("phibench.")]
"""


@pytest.fixture(scope="module")
def sample(smallest_dataset: Path) -> Sample:
    return open_dataset(smallest_dataset)[0]


@pytest.fixture(scope="module")
def exported(sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "out"
    export_scene(sample, folder)
    return folder


def by_a_stranger(path: Path, **settings: int) -> tuple[list[int], np.ndarray]:
    """Shape and mean of a rendered scene, in a folder of its own."""
    command = [sys.executable, "-c", STRANGER, str(path), json.dumps(settings)]
    child = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, timeout=300, check=False)
    assert child.returncode == 0, child.stderr
    shape, mean = json.loads(child.stdout.splitlines()[-1])
    return shape, np.array(mean)


@pytest.mark.slow
@pytest.mark.parametrize("position", ["down", "up"])
def test_an_unmodified_mitsuba_opens_it(sample: Sample, exported: Path, position: str) -> None:
    """Mean light of a window in the mirror: a room baked this coarsely, 0.5 m, agrees to some percents."""
    window = {"crop_offset_x": 50, "crop_offset_y": 60, "crop_width": 60, "crop_height": 14}
    shape, mean = by_a_stranger(exported / f"{position}-ambient.xml", spp=64, **window)
    assert shape == [14, 60, 3]
    ours = expected_radiance(sample, position, "ambient")[:, 60:74, 50:110].mean(axis=(1, 2))
    assert mean == pytest.approx(ours, rel=0.1)


def test_the_spot_has_its_flux(sample: Sample, exported: Path) -> None:
    """Means of the window around the spot, 1e5 samples of which 1 in 30 meets it: 3 sigma are 5 %."""
    row = sample.row.down
    u, v, side = round(row.u_px), round(row.v_px), 8
    window = {"crop_offset_x": u - side // 2, "crop_offset_y": v - side // 2, "crop_width": side, "crop_height": side}
    _, mean = by_a_stranger(exported / "down-spot.xml", spp=2025, **window)
    ours = expected_radiance(sample, "down", "spot")[:, v - 4 : v + 4, u - 4 : u + 4].mean(axis=(1, 2))
    assert mean == pytest.approx(ours, rel=0.05)
    assert mean[0] > 0.0


def test_the_dictionary_is_the_same_scene(sample: Sample, exported: Path) -> None:
    """Pixels of both, same seed. float32 sums in another order: 1e-5."""
    mi = activate()
    ordered = {"parallel": False, "optimize": False}  # else lamps have another order, and other random numbers
    taken = mi.load_dict(phibench.mitsuba_scene(sample, "down"), **ordered)
    scenes = (mi.load_file(str(exported / "down.xml"), **ordered), taken)
    one, two = (np.array(mi.render(scene, spp=4, seed=1)) for scene in scenes)
    assert one.shape == (90, 160, 3)
    assert np.abs(one - two).max() <= 1e-5 * one.max()


def test_files_of_an_export(exported: Path) -> None:
    names = sorted(path.name for path in exported.iterdir())
    lights = [f"{place}{light}" for place in ("down", "up") for light in ("-ambient", "-spot", "")]
    assert names == sorted(
        [
            *("README.md", "meshes", "pictures", "down.glb", "up.glb"),
            *(f"{light}{end}" for light in lights for end in (".xml", "-phibench.exr")),
        ]
    )
    text = (exported / "README.md").read_text(encoding="utf-8")
    assert "sigma 0.7 px" in text


def test_the_gltf_has_room_rig_mirror_and_camera(sample: Sample, exported: Path) -> None:
    """Read by another program: the mirror's ball, the camera's place and way, the spot before its board."""
    scene = trimesh.load(exported / "up.glb")
    nodes = set(scene.graph.nodes_geometry)
    assert {"mirror", "laser_spot", "robot_mast", "camera_housing", "floor"} <= nodes
    ball, view = scene.geometry["mirror"], sample.view("up")
    x, y, z = view.sphere_centre_m
    assert ball.bounds.mean(axis=0) == pytest.approx([x, z, -y], abs=1e-6)
    # facets of two degrees lie inside the ball; normals outwards give a volume above 0
    assert ball.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.06**3, rel=1e-3)
    x, y, z = sample.row.spot_world_m
    assert scene.geometry["laser_spot"].vertices.mean(axis=0) == pytest.approx([x, z, -y], abs=2e-4)
    data = (exported / "up.glb").read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (node,) = [one for one in document["nodes"] if "camera" in one]
    matrix = np.reshape(node["matrix"], (4, 4)).T
    x, y, z = view.camera_centre_m
    assert matrix[:3, 3] == pytest.approx([x, z, -y])
    assert -matrix[:3, 2] == pytest.approx([0.0, 1.0, 0.0])  # looks up, along -z of its own


def test_the_readmes_comparison_runs(exported: Path) -> None:
    """What README.md says to type, with the scene rendered coarsely; two bounces lack 12 % of its light."""
    script = """
import mitsuba as mi
mi.set_variant("scalar_rgb")
image = mi.render(mi.load_file("down-ambient.xml", spp=4))
mi.util.write_bitmap("down-ambient.exr", image)
"""
    text = (exported / "README.md").read_text(encoding="utf-8")
    lines = text.split("python - <<'END'\n", 1)[1].split("    END\n", 1)[0].splitlines()
    code = "\n".join(line.removeprefix("    ") for line in lines)
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    run = [
        subprocess.run(
            [sys.executable, "-c", part], cwd=exported, capture_output=True, text=True, check=True, env=environment
        )
        for part in (script, code)
    ]
    (exported / "down-ambient.exr").unlink()
    ratios = json.loads(run[1].stdout[run[1].stdout.index("[") :])
    assert len(ratios) == 3
    assert ratios == pytest.approx([1.0, 1.0, 1.0], abs=0.2)


def test_the_same_sample_gives_the_same_bytes(sample: Sample, exported: Path, tmp_path: Path) -> None:
    export_scene(sample, tmp_path / "again", ("down",))
    files = [path for path in (tmp_path / "again").rglob("*") if path.is_file() and path.name != "README.md"]
    assert len(files) > 8
    for path in files:
        assert path.read_bytes() == (exported / path.relative_to(tmp_path / "again")).read_bytes()


def test_command(smallest_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["scene", "export", str(smallest_dataset), "--sample", "0", "--position", "up"]
    assert main([*arguments, "--out", str(tmp_path / "s")]) == 0
    out = capsys.readouterr().out
    assert "not carried: The Gaussian blur" in out
    assert "mitsuba -m llvm_ad_rgb" in out
    assert not (tmp_path / "s" / "down.xml").exists()
    planes = read_exr(tmp_path / "s" / "up-phibench.exr").planes
    assert planes["R"].max() > planes["R"].mean() > 0.0


@pytest.mark.parametrize(
    ("sample_id", "out", "words"),
    [
        ("table1-d2.180-h0.800", "new", "no sample 'table1-d2.180-h0.800'"),
        ("7", "new", "numbered from 0 to"),
        ("0", "other", "is there and is no exported scene"),
    ],
)
def test_mistakes_are_one_sentence(
    smallest_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], sample_id: str, out: str, words: str
) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("all of it", encoding="utf-8")
    command = ["scene", "export", str(smallest_dataset), "--sample", sample_id, "--out", str(tmp_path / out)]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_importing_phibench_does_not_import_mitsuba(python: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    child = python("import phibench, sys; phibench.mitsuba_scene; print('mitsuba' in sys.modules)")
    assert child.stdout.strip() == "False", child.stderr
