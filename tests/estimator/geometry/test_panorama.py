"""Unrolling: the model against the truth layer and against projected points, edges, the command, mistakes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.revolved_rigs import revolved
from PIL import Image

from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_dataset
from phibench.estimator.geometry.panorama import (
    PanoramaGrid,
    grid_pixels,
    panorama,
    pixels_by_model,
    pixels_by_truth,
    ray_directions,
    unrolled_values,
)
from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.room import default_rig, lab
from phibench.studies.isotropy.room_edges import RoomEdge, seen_edge, track, vertical_edges

GRID = PanoramaGrid(360, math.radians(-60.0), math.radians(30.0))


def test_grid_directions_and_places_are_inverse() -> None:
    d = GRID.directions()
    v, u = np.mgrid[: GRID.height_px, : GRID.width_px]
    # arctan2 of doubles: 1e-15 rad are 6e-14 px
    assert np.allclose(GRID.place(d * 3.0), np.stack([u, v], axis=-1), rtol=0.0, atol=1e-11)
    assert d.shape == (90, 360, 3)
    front, left = GRID.place(np.array([1.0, 0.0, 0.0])), GRID.place(np.array([0.0, 1.0, 0.0]))
    assert front[0] == pytest.approx(179.5)  # between the two columns in the middle
    assert left[0] == pytest.approx(89.5)  # seen from inside, the robot's left is on the left


@pytest.mark.parametrize("misalignment", [Misalignment(), Misalignment(tilt_x_rad=0.01, decentre_y_m=2e-3, k1=0.02)])
def test_pixel_of_a_grid_point_is_where_the_simulator_sees_it(misalignment: Misalignment) -> None:
    """Points at a finite distance, solved by the simulator as Alhazen's problem: other mathematics."""
    view, distance = default_rig().perturbed(misalignment).at(0.0), 3.0
    uv = pixels_by_model(view, GRID, distance)
    checked = 0
    for i in range(5, GRID.height_px, 20):
        for j in range(3, GRID.width_px, 40):
            point = view.sphere_centre_m + distance * GRID.directions()[i, j]
            spot = LaserSpot(tuple(float(x) for x in point), (0.0, 0.0, 1.0), 5e-3)
            truth = spot_truth(view, spot, ())
            # Newton stops at 1e-7 px
            assert np.allclose(uv[i, j], (truth.u_px, truth.v_px), rtol=0.0, atol=2e-7)
            checked += 1
    assert checked == 45


def test_distance_matters_because_a_sphere_has_no_single_viewpoint() -> None:
    far, near = (pixels_by_model(default_rig().at(0.0), GRID, distance) for distance in (1e9, 1.0))
    # at 1 m the ray's start, about 45 mm beside the centre, turns it by some 0.05 rad cos(angle): several pixels
    assert 1.0 < np.nanmax(np.linalg.norm(far - near, axis=-1)) < 10.0


@pytest.mark.parametrize("position", ["down", "up"])
def test_model_and_truth_layer_agree(tiny_dataset: Path, position: str) -> None:
    """The truth layer's float32 (0.2 um at 4 m, 6e-8 rad) is 2e-5 px, and so is its quadratic between pixels."""
    sample = open_dataset(tiny_dataset).samples[0]
    by_model, by_truth = (grid_pixels(sample, position, GRID, by) for by in ("model", "truth"))
    both = np.isfinite(by_model).all(axis=-1) & np.isfinite(by_truth).all(axis=-1)
    assert both.mean() > 0.9
    assert np.max(np.abs(by_model - by_truth)[both]) < 1e-3
    shifted = by_truth + 0.01
    assert np.max(np.abs(by_model - shifted)[both]) > 1e-3  # the tolerance would notice a hundredth of a pixel


@pytest.mark.slow
def test_truth_of_a_misaligned_rig_differs_from_the_nominal_model(misaligned_dataset: Path) -> None:
    sample = open_dataset(misaligned_dataset).samples[0]
    by_model, by_truth = (grid_pixels(sample, "down", GRID, by) for by in ("model", "truth"))
    true = pixels_by_model(sample.view("down"), GRID)
    both = np.isfinite(by_model + by_truth + true).all(axis=-1)
    assert both.mean() > 0.9
    # the truth's search takes P on the sphere: 50 um of form over 1 m or more are 5e-5 rad, a pixel is 3 mrad or more
    assert np.max(np.abs(true - by_truth)[both]) < 5e-5 / 3e-3 + 1e-3
    assert np.max(np.abs(by_model - by_truth)[both]) > 1.0


QUARTER = {"width_px": 320, "height_px": 180, "fx_px": 357.5, "fy_px": 357.5, "cx_px": 159.5, "cy_px": 89.5}


@pytest.mark.parametrize("shape", ["ellipsoid", "paraboloid", "hyperboloid", "polynomial"])
def test_model_and_truth_layer_agree_on_mirrors_of_revolution(shape: str) -> None:
    """Of tilted mirrors. The quadratic between pixels is 4^3 times as wrong as in a whole image, 1e-3 px; more at rims.

    A ray that starts 5 mm aside meets a wall at 2 m at 2.5e-3 rad, and a pixel of this image is 1e-2 rad or more.
    """
    grid = PanoramaGrid(160, GRID.low_rad, GRID.high_rad)
    view = revolved(shape, aligned=False, **QUARTER).at(0.0)
    truth = truth_layer(view, lab().shapes(view))
    by_model, by_truth = pixels_by_model(view, grid), pixels_by_truth(ray_directions(truth, view), grid)
    seen, both = (np.isfinite(uv).all(axis=-1) for uv in (by_model, by_model + by_truth))
    assert both.sum() > 0.98 * seen.sum() > 3000
    off = np.abs(by_model - by_truth)[both]
    assert np.median(off) < 1e-4
    assert off.max() < 5e-3
    rig = view.rig
    aside = replace(
        rig, T_camera_sphere=replace(rig.T_camera_sphere, translation_m=(0.0, 0.0, rig.T_camera_sphere.t[2]))
    )
    wrong = pixels_by_truth(ray_directions(truth, aside.at(0.0)), grid)
    assert np.nanmedian(np.abs(wrong - by_model)) > 0.02


def test_a_cone_has_no_place_of_a_normal() -> None:
    view = revolved("cone", **QUARTER).at(0.0)
    with pytest.raises(DatasetError, match="same slope everywhere: use the model"):
        ray_directions(truth_layer(view, lab().shapes(view)), view)


def test_unrolled_is_bilinear_and_empty_where_nothing_is_seen() -> None:
    v, u = np.mgrid[:10, :12]
    image = 2.0 * u + 3.0 * v + 0.5 * u * v  # what bilinear interpolation keeps
    where = np.array([[[3.25, 4.5], [np.nan, 1.0], [10.9, 8.75]]])
    found = unrolled_values(image, where)
    expected = 2.0 * where[..., 0] + 3.0 * where[..., 1] + 0.5 * where[..., 0] * where[..., 1]
    assert np.allclose(found[0, [0, 2]], expected[0, [0, 2]], rtol=1e-13)
    assert np.isnan(found[0, 1])
    assert unrolled_values(np.stack([image] * 3, axis=-1), where).shape == (1, 3, 3)


def _striped(grid: PanoramaGrid, edge_px: np.ndarray, blur_px: float) -> np.ndarray:
    """A panorama with one upright edge at the columns `edge_px`, one per row, blurred."""
    from scipy.special import ndtr

    columns = np.arange(grid.width_px)
    return 1.0 + 3.0 * ndtr((columns - edge_px[:, None]) / blur_px)


@pytest.mark.parametrize("lean", [0.0, -0.7, 1.9])
def test_edge_is_measured_where_it_is(lean: float) -> None:
    """A blurred step that leans by a known number of columns; levels at 4 blurs are off by 3e-5 of the step."""
    grid = PanoramaGrid(720, -0.3, 0.3)
    rows = np.arange(grid.height_px)
    edge = 200.3 + lean * (rows - rows.mean()) / np.ptp(rows)
    expected = np.array([[200.0, rows[-1]], [200.0, rows[0]]])
    found = seen_edge(_striped(grid, edge, 1.0), grid, "step", expected)
    assert found is not None
    kept = (found.rows - 1) / np.ptp(rows)
    assert found.lean_px == pytest.approx(lean * kept, abs=2e-3)
    assert found.offset_px == pytest.approx(0.3, abs=2e-3)
    assert found.expected_lean_px == pytest.approx(0.0, abs=1e-12)


def test_edge_without_contrast_is_not_measured() -> None:
    grid = PanoramaGrid(720, -0.3, 0.3)
    expected = np.array([[200.0, grid.height_px - 1.0], [200.0, 0.0]])
    assert seen_edge(np.ones((grid.height_px, grid.width_px)), grid, "none", expected) is None


def test_upright_edge_is_one_column_for_an_aligned_rig_and_leans_for_a_tilted_one() -> None:
    """The plane of a vertical edge and the axis is a mirror plane of the aligned rig: its rays keep the azimuth."""
    rig = default_rig()
    edges = tuple(vertical_edges(lab(), ("door",)))
    assert [edge.name for edge in edges] == ["door left", "door right"]
    leans = []
    for true in (rig, rig.perturbed(Misalignment(tilt_y_rad=0.0087))):
        columns = [track(true.at(0.0), rig.at(0.0), GRID, edge)[:, 0] for edge in edges]
        leans.append(max(float(np.ptp(each)) for each in columns))
    assert leans[0] < 1e-6
    assert leans[1] > 0.1


def test_faces_of_a_solid_look_at_the_axis() -> None:
    edges = tuple(vertical_edges(lab(), ("cabinet",)))
    assert all(isinstance(edge, RoomEdge) for edge in edges)
    assert [float(edge.low_m[0]) for edge in edges] == pytest.approx([-4.15, -4.15])  # its side towards the robot


def test_command_writes_a_panorama(tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "p.png"
    for by in ("model", "truth"):
        assert main(["dataset", "panorama", str(tiny_dataset), "--out", str(out), "--width", "180", "--by", by]) == 0
        with Image.open(out) as picture:
            assert picture.size == (180, 45)
            assert np.asarray(picture).max() > 0
    assert "by truth" in capsys.readouterr().out


def test_command_unrolls_a_picture_file(tiny_dataset: Path, tmp_path: Path) -> None:
    """A picture that is white on its left half: the panorama is white where u is small."""
    sample = open_dataset(tiny_dataset).samples[0]
    camera = sample.rig.camera
    image = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    image[:, : round(camera.cx_px)] = 255
    Image.fromarray(image).save(tmp_path / "half.png")
    out = tmp_path / "p.png"
    picture = ["--image", str(tmp_path / "half.png"), "--width", "90"]
    assert main(["dataset", "panorama", str(tiny_dataset), "--out", str(out), *picture]) == 0
    with Image.open(out) as found:
        share = float(np.mean(np.asarray(found) == 255))
    assert 0.4 < share < 0.6
    with pytest.raises(DatasetError, match="give a whole frame"):
        panorama(sample, "down", GRID, image=image[:-1])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--elevation-deg", "30", "-10"], "lower one first"),
        (["--elevation-deg", "-95", "10"], "-90 to 90"),
        (["--width", "3"], "16 to 16384"),
        (["--preset", "bayer-raw"], "no colour picture"),
        (["--sample", "nothing"], "no sample 'nothing'"),
        (["--distance-m", "0.01"], "above the mirror's radius"),
        (["--by", "truth", "--distance-m", "2"], "needs the model"),
    ],
)
def test_mistakes_end_in_a_sentence(
    tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    assert main(["dataset", "panorama", str(tiny_dataset), "--out", str(tmp_path / "p.png"), *options]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()


def test_pixels_outside_of_the_image_are_left_out() -> None:
    rig = default_rig()
    small = replace(rig, camera=replace(rig.camera, height_px=400, cy_px=199.5))
    uv = pixels_by_model(small.at(0.0), GRID)
    seen = np.isfinite(uv).all(axis=-1)
    assert 0.3 < seen.mean() < 1.0
    assert np.all(small.camera.contains(uv[seen]))
