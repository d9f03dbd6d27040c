"""Dense pairs of films: which frames, at which heights, with which truth; and what is refused."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phibench.benchmark.dense.dense_films import DenseFilms, strokes_of
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_read import Film
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.geometry.reflection import image_of
from phibench.render.film.key_views import blended, key_weights
from phibench.scenes.frames import Array
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.drive import Drive
from phibench.scenes.motion.vehicle import Vehicle


@pytest.fixture(scope="module")
def folder(film_images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Film of whole images without its vibration and lights: the views of its room hold neither."""
    out = tmp_path_factory.mktemp("strokes") / "films"
    shutil.copytree(film_images, out)
    recipe = out / "recipe.toml"
    recipe.write_text(recipe.read_text(encoding="utf-8").split("[[film.vibration]]")[0], encoding="utf-8")
    return out


@pytest.fixture(scope="module")
def films(folder: Path) -> DenseFilms:
    return DenseFilms(folder, between=3)


@pytest.fixture(scope="module")
def pair(films: DenseFilms) -> DensePair:
    return films.pair(0)


def changed(film: Film, **scene: Any) -> Film:
    """Film with another carriage or drive."""
    return replace(film, plan=replace(film.plan, scene=replace(film.plan.scene, **scene)))


def test_frames_are_those_of_the_film_with_the_laser_off(films: DenseFilms, pair: DensePair) -> None:
    """The carriage rests until 0.2 s and from 0.75 s on; a frame is exposed for 47 ms in all, each 0.1 s."""
    film, stroke, _ = films.stroke(0)
    assert (stroke.down, stroke.up) == (1, 8)
    assert stroke.between == (4, 5, 6)
    for image, frame in ((pair.down, 1), (pair.up, 8), *zip(pair.between, stroke.between, strict=True)):
        assert np.array_equal(image, film.frame(frame, "mjpeg", laser=False).image)
        assert not image.flags.writeable
    assert pair.stroke_m == 0.3
    assert pair.between_m == tuple(film.table["encoder_m"].to_numpy()[list(stroke.between)])
    assert list(pair.between_m) == sorted(pair.between_m)
    assert films.pair(0).number == pair.number == 0


def test_each_frame_between_shows_the_room_from_its_height(films: DenseFilms) -> None:
    """The room's views at the heights of its rows fit a frame best: not where all are moved, or the rows are turned.

    Frames are drawn without noise. Their exposure is a mean over 17 mm of the way, 1 m/s.
    """
    film, _, _ = films.stroke(0)
    clean = DenseFilms(films.films, "ideal", between=3)
    pair, (keys,) = clean.pair(0), film.info.keys
    moved_m = np.linspace(-0.06, 0.06, 13)
    rows = np.arange(90) - 44.5
    for image, height_m, row_m in zip(pair.between, pair.between_m, pair.between_row_m, strict=True):

        def error(heights_m: Array, image: Array = image) -> float:
            room = blended(film.views, key_weights(keys, heights_m))
            return float(np.mean((image - pair.card.exposure_s * room) ** 2))

        errors = [error(height_m + moved + row_m * rows) for moved in moved_m]
        assert abs(moved_m[np.argmin(errors)]) < 1e-9
        assert min(errors) < 0.7 * error(height_m + 0.0 * rows) < 0.7 * error(height_m - row_m * rows)


def test_the_truth_is_where_the_estimator_projects_the_points(films: DenseFilms) -> None:
    truth = films.truth(0)
    seen = truth.scored
    assert seen.sum() > 1000
    points = truth.found.point_world_m[seen]
    up = image_of(truth.true_rig.at(0.3), points).uv_px
    np.testing.assert_allclose(truth.found.uv_px[seen], up, atol=1e-8)
    down = image_of(truth.true_rig.at(0.0), points).uv_px
    np.testing.assert_allclose(down, np.argwhere(seen)[:, ::-1], atol=1e-8)
    assert (truth.room, truth.sample_id, truth.stroke_m) == ("lab", "seen-near-h0.300", 0.3)
    assert truth.texture.shape == seen.shape


def test_a_stroke_down_and_a_stop_on_the_way_are_taken(films: DenseFilms) -> None:
    """Told heights are still those of the film, on its way up."""
    down = Carriage((0.3, 0.15, 0.0), (0.15, 0.0, 0.1), 2.0, 8.0)
    (stroke,) = strokes_of(changed(films.stroke(0)[0], carriage=down), 12)
    assert (stroke.down, stroke.up) == (8, 1)
    assert stroke.between == (3, 4, 5, 6, 7)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda film: changed(film, carriage=Carriage((0.0, 0.3), (0.02, 0.02), 1.0, 4.0)), "no stroke .* at both"),
        (lambda film: changed(film, carriage=Carriage((0.0,), (0.5,))), "no stroke from the stop 0.0"),
        (lambda film: changed(film, drive=Drive(Vehicle(), (), 0.0, 1.0)), "the robot drives"),
        (lambda film: replace(film, plan=replace(film.plan, window_px=24)), 'view = "full"'),
    ],
)
def test_films_without_a_stroke_of_whole_images_are_refused(
    films: DenseFilms, change: Callable[[Film], Film], sentence: str
) -> None:
    with pytest.raises(DatasetError, match=sentence):
        strokes_of(change(films.stroke(0)[0]))


def test_other_faults_are_told_in_a_sentence(
    folder: Path, film_images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DatasetError, match="the robot vibrates"):
        DenseFilms(film_images)
    with pytest.raises(DatasetError, match="draws = 0"):
        DenseFilms(folder, draws=0)
    with pytest.raises(DatasetError, match="pair 1: there are 1"):
        DenseFilms(folder).pair(1)
    assert main(["dense", "score", str(folder), "--method", "dense_sweep", "--frames", "2"]) != 0
    assert "leave --calibration and --frames out" in capsys.readouterr().err


def test_the_command_scores_with_the_frames_between(folder: Path, tmp_path: Path) -> None:
    """On the command line; the method's process takes seconds to start."""
    method = tmp_path / "mine.py"
    method.write_text(
        "import numpy as np\n"
        "from phibench.estimator.dense.dense_interface import DenseAnswer\n"
        "def depth(pair):\n"
        "    assert 2 < len(pair.between) == len(pair.between_m) <= 6\n"
        "    return DenseAnswer(depth_m=np.full(pair.shape, 2.0))\n"
    )
    out = tmp_path / "score.json"
    asked = ["score", str(folder), "--between", "--method", f"{method}:depth", "--out", str(out)]
    assert main(["dense", *asked]) == 0
    score = json.loads(out.read_text())
    assert score["pair_set"]["between"] == 6
    assert (score["pairs"], score["failures"]) == (1, {})
