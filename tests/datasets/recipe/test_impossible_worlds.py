"""Worlds that cannot be: low rooms, and spots on lamps, panes, gloss, the ball or the camera; one sentence each.

Sentences of single files are tested with their readers: a mesh without scale or lower than the stroke in
`test_mesh_room`, a panorama box lower than the stroke in `test_panorama_room`, a picture of the wrong aspect in
`test_panorama_files`, and each surface that carries no spot in `test_ray_spots`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.proof_rooms import generated, mesh_settings, panorama_settings

from phibench.cli import main as cli
from phibench.datasets.plan import sampling
from phibench.datasets.recipe.spot_placement import by_ray
from phibench.datasets.recipe.tables import LaserTable
from phibench.datasets.rooms.panorama_room import PanoramaSettings, panorama_room
from phibench.render.optics.truth import spot_truth
from phibench.scenes.frames import as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.room import Room, carriage, default_rig
from phibench.scenes.shapes import Uniform, rectangle
from phibench.scenes.validation import SceneError

WORLDS = (Path(__file__).resolve().parents[2] / "tiny_worlds.toml").read_text(encoding="utf-8")


def said(folder: Path, capsys: pytest.CaptureFixture[str], **changes: str) -> str:
    """What `phibench dataset make` says about the tiny worlds with some lines changed; it must end with 2."""
    text = WORLDS
    for key, value in changes.items():
        [line] = [line for line in text.splitlines() if line.startswith(f"{key} =")]
        text = text.replace(line, f"{key} = {value}")
    (folder / "recipe.toml").write_text(text, encoding="utf-8")
    assert cli.main(["dataset", "make", str(folder / "recipe.toml"), "--out", str(folder / "out")]) == 2
    shown = capsys.readouterr().err
    assert "Traceback" not in shown
    assert len([line for line in shown.splitlines() if not line.endswith("recipe.toml has 1 fault:")]) == 1
    assert not (folder / "out").exists()
    return shown


def test_a_generated_room_lower_than_the_stroke(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The mirror's top is at 0.77 m when down; rooms are 2.3 to 4.5 m high."""
    text = said(tmp_path, capsys, windows="1\nheight_m = 2.4", stroke_m="{ uniform = [1.7, 1.8] }")
    assert "rooms.properties.height_m: the ceiling can be at 2.4 m, and the mirror's top is at 2.47 m with" in text
    text = said(tmp_path, capsys, windows="1\nheight_m = 2.4", stroke_m="{ uniform = [1.62, 1.8] }", samples="1")
    assert "the mirror's top at 2." in text
    assert "is above the ceiling or what hangs from it, at 2.3" in text
    assert "; change the numbers that are fixed or narrow the distributions (stroke_m, spot.azimuth_deg" in text
    assert "boards" not in text  # there are none to move


def everywhere(**options: Any) -> Room:
    """Six walls, all of one kind."""
    walls = [((2, 0, 1), (-1, 0, 0)), ((-2, 0, 1), (1, 0, 0)), ((0, 2, 1), (0, -1, 0)), ((0, -2, 1), (0, 1, 0))]
    walls += [((0, 0, 2.5), (0, 0, -1)), ((0, 0, 0), (0, 0, 1))]
    return Room("same", tuple(rectangle(f"wall_{k}", p, n, (6, 6), **options) for k, (p, n) in enumerate(walls)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"window": True, "radiance_w_m2_sr": (1.0, 1.0, 1.0)}, "a window"),
        ({"radiance_w_m2_sr": (1.0, 1.0, 1.0)}, "a lamp"),
        ({"texture": Uniform((0.04, 0.3, 0.3)), "coat": 1.5}, "which is like a mirror"),
    ],
)
def test_a_room_of_nothing_that_carries_a_spot(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, Any],
    words: str,
) -> None:
    """Drawn spots are drawn anew a hundred times, and the last reason is told."""
    monkeypatch.setattr(sampling, "room_of", lambda *_: everywhere(**options))
    text = said(tmp_path, capsys)
    assert "sample 0 has no possible rig, spot and stroke in room000000 in 100 draws; the last: the ray meets" in text
    assert words in text


def test_gloss_that_is_no_mirror_is_allowed() -> None:
    """A coat of index 1.5 mirrors 4 % at right angles; the ground below scatters the rest by its albedo, from 5 %."""
    room = everywhere(texture=Uniform((0.06, 0.3, 0.3)), coat=1.5)
    [placed] = by_ray(LaserTable(albedo="surface"), room, np.array([0.0]), np.array([0.5]))
    assert placed[0] == "wall_0"


@pytest.mark.slow
@pytest.mark.parametrize("number", range(2))
def test_no_spot_lies_on_lamp_pane_ball_or_camera(number: int) -> None:
    """600 rays in generated rooms, with lamps and panes in reach of some: what they carry is matt and not the robot's.

    Rays go past ball, camera and mast, which rooms do not hold: a spot lies 0.3 m or more from the axis, and the
    carriage with a decentre and a tilt within 0.1 m.
    """
    room, rng = generated(number), np.random.default_rng(number)
    azimuth, height, rise = rng.uniform(0, 360, 600), rng.uniform(0.3, 2.0, 600), rng.uniform(-30, 85, 600)
    placed = by_ray(LaserTable(albedo="surface"), room, azimuth, height, rise)
    spots = [one for one in placed if not isinstance(one, str)]
    assert len(spots) > 300
    bad = {s.name for s in room.surfaces if s.window or s.emits}
    assert bad
    assert not bad & {name for name, _ in spots}
    refused = " ".join(one for one in placed if isinstance(one, str))
    assert ", a lamp" in refused
    places = np.array([spot.position_world_m for _, spot in spots])
    assert np.hypot(*places[:, :2].T).min() >= 0.3
    for offset_m in (0.0, 1.0):
        view = default_rig().at(offset_m)
        assert min(box.distance_m(place) for box in carriage(view) for place in places[::7]) > 0.2


def test_a_spot_on_the_ball_or_the_camera_is_never_visible() -> None:
    """In Python any spot may be asked for. On the ball nothing is reflected; the housing's top faces the mirror."""
    view, rng = default_rig().at(0.0), np.random.default_rng(0)
    shapes = Room("empty", (), ()).shapes(view)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for n in normals:
        for radius in (0.06 + 1e-6, 0.03):
            spot = LaserSpot(as_vector(view.sphere_centre_m + radius * n), as_vector(n), 4e-3)
            assert spot_truth(view, spot, shapes).cause in ("no_reflection", "faces_away", "mirror_edge")
    housing, mast = carriage(view)
    for box in (housing, mast):
        for axis in range(2):
            for sign in (-1.0, 1.0):
                normal = sign * np.eye(3)[axis]
                place = box.T_world_shape.t + 0.5 * np.array(box.size_m) * normal
                assert not spot_truth(view, LaserSpot(as_vector(place), as_vector(normal), 4e-3), shapes).visible


def test_a_panorama_on_a_mesh_lower_than_the_stroke(tmp_path: Path) -> None:
    """2.8 m high; a stroke of 2.1 m would lift the mirror to 2.90 m."""
    tall = panorama_settings("mesh", tmp_path, rows=32)
    assert isinstance(panorama_room(tall), Room)
    low = mesh_settings("curved", tmp_path, ())
    settings = PanoramaSettings(
        tall.path, tall.point_m, mesh=type(low)(low.path, 1.0, "y", (0.0, 0.0, 0.0), stroke_m=2.1)
    )
    with pytest.raises(SceneError, match=r"in the way of the mirror, which rises to 2\.90 m with a stroke of 2\.1 m"):
        panorama_room(settings)
