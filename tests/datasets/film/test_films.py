"""Films as data sets: made, read, checked, resumed; frames, bytes in videos, mistakes in one sentence."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import polars
import polars as pl
import pytest
from conftest import ROOT
from helpers.remembered_spots import SPOTS, RememberedSpots

from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.film import film_room, film_task
from phibench.datasets.film.drive_collisions import check_drives
from phibench.datasets.film.film_forecast import films_forecast, forecast_lines
from phibench.datasets.film.film_make import make_films
from phibench.datasets.film.film_plan import film_plans
from phibench.datasets.film.film_preview import picture
from phibench.datasets.film.film_read import Film, open_films
from phibench.datasets.film.film_store import verify_films
from phibench.datasets.film.film_video import read_frames, write_frames, write_lerobot, write_mp4, write_videos
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.store.layers import read_exr, write_exr
from phibench.render.film.key_views import PoseParts
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.robot.film.film_frames import film_frames

TEXT = (ROOT / "tests" / "films.toml").read_text(encoding="utf-8")
FILM = "seen-near-h0.300"


def film_of(folder: Path) -> Film:
    return open_films(folder)[FILM]


def test_truth_of_every_frame_is_the_stills(film_windows: Path) -> None:
    film, checked = film_of(film_windows), 0
    assert len(repr(film)) < 120  # a list of films can be printed
    scene = film.plan.scene
    for row in film.table.iter_rows(named=True):
        for prefix in ("", "row_"):
            time = row[f"{prefix}time_s"]
            still = spot_truth(scene.view_at(time), scene.spot_at(time), ())
            # what parquet holds are the doubles themselves
            assert (row[f"{prefix}u_px"], row[f"{prefix}v_px"]) == (still.u_px, still.v_px)
            assert row[f"{prefix}phi_ray_rad"] == still.phi_ray_rad
            assert row[f"{prefix}visible"]
            checked += 1
        assert row["encoder_m"] == pytest.approx(float(scene.carriage.position_m(row["time_s"])), abs=6 * 2e-4)
    assert checked == 20
    assert film.table["offset_m"].to_numpy()[-1] == pytest.approx(0.3, abs=1e-12)  # the stroke is over


def test_interpolated_views_are_held_to_a_quarter_of_the_noise(film_windows: Path, film_images: Path) -> None:
    for folder in (film_windows, film_images):
        info = film_of(folder).info
        assert 0.0 < max(info.pixel_ratio or 0.0, info.position_ratio or 0.0) <= 0.25
        assert len(info.keys_m) < 2 * info.frames


def test_the_proof_fails_where_key_views_are_too_far_apart(film_images: Path) -> None:
    film = film_of(film_images)
    plan, _ = film_plans(parse_recipe(TEXT))
    render = film_room.renderer(plan, film.plan, plan.room(film.plan.pair.room))
    # key views of a stroke of 2 m in place of 0.3 m: the board moves over the spot's window
    offsets = np.array([-0.3, 0.1, 0.5, 0.9])
    views = np.stack([render(film.plan.scene.rig.at(float(at)), (0, float(at)), 1) for at in offsets])
    parts = PoseParts.of(film.plan.scene)
    error = film_room.held_out_error(film.plan, render, parts, 0, offsets, views, film.spots)
    assert error.largest > 0.25


def test_a_windows_pixels_are_those_of_the_whole_frame(film_windows: Path, film_images: Path) -> None:
    part, all_ = film_of(film_windows), film_of(film_images)
    # the rooms differ by their rendering noise alone, so that the spot alone is compared: means, no draw
    for frame in (0, 4, 9):
        a, b = part.expected(frame, "mono-raw"), all_.expected(frame, "mono-raw")
        assert (a.u0_px, a.v0_px) == (b.u0_px, b.v0_px)
        np.testing.assert_array_equal(a.spot_e, b.spot_e)
        assert part.frame(frame, "bayer-raw").image.shape == (24, 24)
        assert part.window(frame).slices() == part.frame(frame, "mjpeg").region.slices()


def test_laser_off_frames_have_no_spot_and_others_have_their_flux(film_windows: Path) -> None:
    film = film_of(film_windows)
    scene, seen = film.plan.scene, set()
    for frame, time in enumerate(film.table["row_time_s"]):
        around = scene.code.mean_level(time + np.array([-4e-3, 0.0, 4e-3]), scene.times.exposure_s)
        if np.ptp(around) > 0.0:
            continue  # an edge of the code is near: the rows differ
        level = round(float(around[0]), 9)
        seen.add(level)
        total = spot_layer(scene.view_at(time), scene.spot_at(time), ()).total_electrons_per_s[0]
        # a rolling shutter stretches what moves down by (px per s) x (time from row to row): 5 px/s x 0.33 ms = 2e-3
        assert film.spots[frame].electrons_per_s[0].sum() == pytest.approx(level * total, rel=4e-3, abs=1.0)
    assert seen == {0.0, 1.0}


def test_other_lights_have_their_own_code_colour_and_path(film_images: Path) -> None:
    film = film_of(film_images)
    assert [one.name for one in film.plan.scene.lights] == ["beacon", "lamp"]
    rows = {name: film.lights_table.filter(polars.col("light") == name) for name in ("beacon", "lamp")}
    laser, lamp = film.light_spots
    # bits of 0.2 s and frames of 0.1 s: two frames lit, two dark, but for rows that see an edge of the code
    level = rows["beacon"]["row_laser_level"].to_numpy()
    light = np.array([one.electrons_per_s[0].sum() for one in laser])
    assert set(np.round(level, 9)) >= {0.0, 1.0}
    assert light[level == 0.0].max(initial=0.0) < 1e-3 * light.max()
    # a lamp of the colour (0.5, 1.0, 0.8), and it moves
    planes = np.array([one.electrons_per_s.sum(axis=(1, 2)) for one in lamp])
    np.testing.assert_allclose(planes[:, 0] / planes[:, 1], 0.5, rtol=1e-5)
    assert np.ptp(rows["lamp"]["row_u_px"].to_numpy()) > 1.0
    # a frame holds the light: one electron per photon that is counted, whatever else there is
    k = int(np.argmax(light))
    chain, both = Chain(film.sensor("ideal"), 0, film.plan.scene.rig.camera), film.light(k)
    stream = NoiseStream(("light", k))
    more = chain.frame(both, stream) - chain.frame(replace(both, others=both.others[1:]), stream)
    assert more[0].sum() == pytest.approx(film.sensor("ideal").exposure_s * light[k], rel=1e-4)


def test_a_dry_run_tells_bytes_and_time_and_leaves_out_what_is_made(film_images: Path, tmp_path: Path) -> None:
    recipe, out = film_images / "recipe.toml", tmp_path / "new"
    *lines, last = forecast_lines(recipe, out, workers=1)
    assert [line.split(":")[0] for line in lines] == [FILM]
    assert "to make: 1 film of 10 frames with" in last
    assert " MB, " in last
    assert not out.exists()
    assert list(forecast_lines(recipe, film_images)) == ["to make: nothing; 1 kept; nothing was rendered"]
    plan, films = film_plans(parse_recipe(recipe.read_text(encoding="utf-8")))
    folder = film_of(film_images)
    size = sum(path.stat().st_size for path in folder.folder.path.rglob("*") if path.is_file())
    # spots of so small an image take less than those of the constants
    assert 0.5 < films_forecast(plan, films).size / size < 3.0


def test_a_killed_run_goes_on_and_gives_the_same_bytes(film_windows: Path, tmp_path: Path, monkeypatch: Any) -> None:
    recipe = tmp_path / "films.toml"
    recipe.write_text(TEXT, encoding="utf-8")
    out, calls = tmp_path / "out", []

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    real = film_room.write_view
    monkeypatch.setattr(film_task, "frame_spots", RememberedSpots())  # of this test alone: computed again once
    with monkeypatch.context() as patch:
        patch.setattr(film_room, "write_view", lambda *a: killed() if len(calls) == 2 else (calls.append(1), real(*a)))
        with pytest.raises(KeyboardInterrupt):
            make_films(recipe, out, 1)
    with monkeypatch.context() as patch:
        patch.setattr(film_room, "write_view", lambda *a: (calls.append(1), real(*a)))
        patch.setattr(film_task, "write_spots", killed)
        with pytest.raises(KeyboardInterrupt):
            make_films(recipe, out, 1)
    with pytest.raises(DatasetError, match=r"no film\.json"):
        open_films(out)
    assert len(calls) == len(film_of(film_windows).info.keys_m)  # each view was rendered once
    calls.clear()
    monkeypatch.setattr(film_room, "write_view", lambda *a: (calls.append(1), real(*a)))
    assert make_films(recipe, out, 1).made == (FILM,)
    assert not calls  # the key views were there
    assert make_films(recipe, out, 1).made == ()
    ours, theirs = (
        {p.relative_to(d).as_posix(): p.read_bytes() for p in d.rglob("*") if p.is_file()} for d in (out, film_windows)
    )
    # times stand in the diary alone
    (line,) = ours.pop("log.jsonl").decode().splitlines()
    assert set(json.loads(line)) == {"time", "task", "key", "ok", "seconds", "peak_mb", "worker", "cpu_s"}
    assert {f"films/{FILM}/done.json", f"films/{FILM}/journal.txt", "journal.txt", "SHA256SUMS"} < set(ours)
    assert len(ours) > 10
    for name, data in ours.items():
        assert theirs[name] == data, name


@pytest.mark.slow
def test_damage_is_found_and_mended(film_windows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film_task, "frame_spots", SPOTS)
    out = tmp_path / "films"
    shutil.copytree(film_windows, out)
    assert verify_films(out) == []
    table = out / "films" / FILM / "film.parquet"
    table.write_bytes(table.read_bytes()[:-1])
    assert verify_films(out) == [f"films/{FILM}/film.parquet is damaged: its SHA-256 is not the listed one"]
    (out / "films" / FILM / "done.json").write_text(json.dumps({"film": 3}), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"done\.json is damaged.*again"):
        film_of(out)
    recipe = out / "again.toml"
    recipe.write_text(TEXT, encoding="utf-8")
    make_films(recipe, out, 1)
    assert verify_films(out) == []


def test_a_key_view_that_was_changed_under_its_own_header_is_rendered_again(
    film_windows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The header has the right key and the right sums of the changed pixels; the hash in the journal is another."""
    monkeypatch.setattr(film_task, "frame_spots", SPOTS)
    out = tmp_path / "films"
    shutil.copytree(film_windows, out)
    folder = film_of(out).folder
    view = sorted(folder.path.glob("views/*.exr"))[0]
    before, found = view.read_bytes(), read_exr(view)
    planes = {name: 2.0 * plane for name, plane in found.planes.items()}
    write_exr(view, planes, found.header, found.origin_px)
    assert view.read_bytes() != before
    assert len(verify_films(out)) == 1
    recipe = tmp_path / "films.toml"
    recipe.write_text(TEXT, encoding="utf-8")
    assert make_films(recipe, out, 1).made == (FILM,)
    assert view.read_bytes() == before
    assert verify_films(out) == []


@pytest.mark.parametrize("name", ["film.avi", "film.mkv"])
def test_a_container_gives_the_cameras_bytes_back(film_images: Path, tmp_path: Path, name: str) -> None:
    film = film_of(film_images)
    sent = [film.frame(k).jpeg or b"" for k in range(4)]
    write_frames(tmp_path / name, sent, "mjpeg", film.plan.size, 10.0)
    assert list(read_frames(tmp_path / name)) == sent
    assert min(map(len, sent)) > 500
    raw = [film.frame(k, "yuyv").image.tobytes() for k in range(3)]
    write_frames(tmp_path / name, raw, "yuyv", film.plan.size, 10.0)
    assert list(read_frames(tmp_path / name)) == raw


def test_videos_and_pictures(film_windows: Path, film_images: Path, tmp_path: Path) -> None:
    (path,) = write_videos(film_images, tmp_path, "mjpeg", workers=1)
    assert len(list(read_frames(path))) == 10
    again = path.read_bytes()
    path.unlink()
    assert write_videos(film_images, tmp_path, "mjpeg", workers=1)[0].read_bytes() == again
    with pytest.raises(DatasetError, match="holds windows"):
        write_videos(film_windows, tmp_path, "mjpeg", workers=1)
    shown = [
        picture(film, film.frame(3, preset))
        for film in map(film_of, (film_windows, film_images))
        for preset in ("yuyv", "mjpeg", "bayer-raw")
    ]
    assert {one.ndim for one in shown} == {3}
    film = write_mp4(tmp_path / "a.mp4", shown[:2], 10.0)
    assert film.stat().st_size > 1000


def test_the_enlarged_square_stands_where_the_picture_is_empty(film_images: Path) -> None:
    """The mirror fills the height: a corner's middle is outside of it. The rest of the picture is the frame's own."""
    film = film_of(film_images)
    frame = film.frame(3, "mjpeg")
    shown = picture(film, frame)[: 4 * 90, : 4 * 160]
    plain = np.kron(np.asarray(frame.image), np.ones((4, 4, 1), np.uint8))
    changed = np.abs(shown.astype(int) - plain).max(axis=2) > 0
    corners = {(v, u): changed[v : v + 40, u : u + 40].mean() for v in (0, 320) for u in (0, 600)}
    (place,) = [corner for corner, share in corners.items() if share > 0.2]  # the square
    inset = np.zeros_like(changed)
    inset[place[0] and 360 - 144 :, place[1] and 640 - 144 :][:144, :144] = True
    outline = 4.0 * (film.plan.scene.rig.outline_px() + 0.5)
    assert not inset[tuple(np.clip(outline.T[::-1].astype(int), 0, [[359], [639]]))].any()
    track = 4.0 * (film.table.select("row_v_px", "row_u_px").to_numpy() + 0.5)
    assert not inset[tuple(track.T.astype(int))].any()


def test_films_are_laid_out_as_lerobot_reads_them(film_images: Path, film_windows: Path, tmp_path: Path) -> None:
    """Against libraries alone: pandas for the tasks' names, PyAV for the times. LeRobot 0.4.4 reads such a folder."""
    import pandas  # here: importing it takes as long as collecting ten files

    film, out = film_of(film_images), tmp_path / "set"
    info = json.loads(write_lerobot(film_images, out, draws=2, workers=1).read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 10)
    assert (info["total_episodes"], info["total_frames"], info["splits"]) == (2, 20, {"train": "0:2"})
    assert list(pandas.read_parquet(out / "meta/tasks.parquet").index) == [
        "find the laser spot in the mirror, and its distance"
    ]
    episodes = pl.read_parquet(out / "meta/episodes/**/*.parquet").to_dicts()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(0, 10), (10, 20)]
    for number, episode in enumerate(episodes):
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        rows = pl.read_parquet(out / info["data_path"].format(**place))
        names = {name for name, feature in info["features"].items() if feature["dtype"] != "video"}
        assert set(rows.columns) == names
        for name in names:
            (size,) = info["features"][name]["shape"]
            assert rows[name].to_numpy().reshape(len(rows), -1).shape == (10, size)
        assert rows["index"].to_list() == list(range(10 * number, 10 * number + 10))
        truth = film.table.select("row_light_u_px", "row_light_v_px").to_numpy()
        assert np.array_equal(rows["truth.spot_px"].to_numpy(), truth, equal_nan=True)
        assert np.allclose(rows["observation.state"].to_numpy()[:, 0], film.table["encoder_m"].to_numpy(), atol=1e-7)
        video = out / info["video_path"].format(video_key="observation.images.camera", **place)
        assert list(read_frames(video)) == [film.frame(k, "mjpeg", number).jpeg for k in range(10)]
        with av.open(str(video)) as container:
            times = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
        # LeRobot's tolerance
        assert np.allclose(times, rows["timestamp"].to_numpy(), atol=1e-4)
    stats = json.loads((out / "meta/stats.json").read_text())
    assert np.shape(stats["observation.images.camera"]["mean"]) == (3, 1, 1)
    assert stats["observation.state"]["max"][0] == pytest.approx(film.table["encoder_m"].max(), abs=1e-7)
    with pytest.raises(DatasetError, match="holds windows"):
        write_lerobot(film_windows, tmp_path / "other", workers=1)


def faulty(change: str, by: str = "") -> str:
    assert change in TEXT
    return TEXT.replace(change, by)


def driving(*rows: str) -> str:
    return TEXT.replace("frames = 10\n", "") + "".join(f"\n[[film.drive]]\n{row}\n" for row in rows)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (driving("length_m = 0.5\nstart_s = 0.1"), r"makes a stroke only while it stands"),
        (driving("length_m = 5.0"), r"runs into 'wall_east' after 9\d%"),
        (driving("turn_deg = -28.0", "length_m = 3.2"), r"leg 2 of the drive runs into 'table"),
        (driving("flipper_deg = -90.0"), r"turn from -80\.2 to 91\.7 deg"),
        (driving("speed_m_per_s = 0.1"), r"neither drives nor turns"),
        (driving("length_m = 0.1\nspeed_m_per_s = 0.6"), r"run 0\.5 m/s at most"),
        (driving("length_m = 0.3\nstart_s = 1.0", "length_m = 0.1\nstart_s = 1.1"), r"start it then or later"),
        (faulty("bit_s = 0.2", "bit_s = 2.0"), r"must hold the whole code"),
        (faulty('code = "110"', 'code = "000"'), r"never lights the laser"),
        (faulty("pauses_s = [0.2, 0.1]", "pauses_s = [0.2]"), r"1 pauses_s for 2 stops"),
        (faulty("rate_hz = 10.0", "rate_hz = 60.0\nexposure_s = 0.02"), r"longer than a frame"),
        (faulty("high_hz = 20.0", "high_hz = 2.0"), r"exchange them"),
        (faulty("frames = 10", "path = [[1.0, 0.0, 0.0], [0.5, 0.1, 0.0]]"), r"must rise"),
        (faulty('name = "lamp"', 'name = "target"'), r"must differ"),
        (faulty('code = "10"', 'code = "10000000"'), r"light 'beacon'.*must hold the whole code"),
        (faulty("speed_m_per_s = 1.0", "speed = 0.5"), r"speed_m_per_s"),
        (TEXT[: TEXT.index("[film]")], r"has no \[film\]"),
    ],
)
def test_each_mistake_is_one_sentence(text: str, words: str) -> None:
    with pytest.raises((RecipeError, DatasetError), match=words):
        check_drives(*film_plans(parse_recipe(text)))


def test_a_film_of_a_driving_robot_has_views_along_its_way(tmp_path: Path) -> None:
    recipe = tmp_path / "drive.toml"
    text = driving("length_m = 0.03\nturn_deg = 3.0").replace(
        "pauses_s = [0.2, 0.1]", "stops = [0.0]\npauses_s = [0.1]"
    )
    text = text[: text.index("[[film.lights]]")] + text[text.index("[[film.drive]]") :]
    recipe.write_text(text.replace('code = "110"\n', ""), encoding="utf-8")
    make_films(recipe, tmp_path / "out", 1)
    film = film_of(tmp_path / "out")
    assert len(film.info.key_counts) == 1
    assert max(film.info.pixel_ratio or 1.0, film.info.position_ratio or 1.0) <= 0.25
    end = film.table.row(-1, named=True)
    assert end["rig_angles_rad"][2] == float(film.plan.scene.robot_state(end["time_s"])[2])
    assert end["rig_angles_rad"][2] == pytest.approx(np.radians(3.0), rel=0.02)  # it slows down, and a frame is 0.1 s
    assert end["rig_world_m"][0] > 0.029
    # 3 cm of track have a standard deviation of 1.7 mm, slip of 2 % one of 0.6 mm: six of them
    assert np.mean(end["tracks_m"]) == pytest.approx(0.03 / 0.97, abs=6 * 1.8e-3)
    # the room turns in the image: the last frame's differs from the first one's, and is smooth in between
    first, middle, last = (film.room(k) for k in (0, len(film) // 2, len(film) - 1))
    assert np.abs(last - first).mean() > np.abs(middle - first).mean() > 0.0
    with pytest.raises(DatasetError, match="takes it to stand"):
        film_frames(film)
    still = spot_truth(film.plan.scene.view_at(end["time_s"]), film.plan.scene.spot_at(end["time_s"]), ())
    assert (end["u_px"], end["v_px"], end["phi_ray_rad"]) == (still.u_px, still.v_px, still.phi_ray_rad)


def test_frames_beside_which_the_flux_bends_are_put_together_from_parts() -> None:
    assert film_task._bends(np.array([1.0, 1.01, 1.02, 0.3, 0.0, 0.0, 0.0])) == [1, 2, 3, 4, 5]
    assert film_task._bends(1.0 + 0.01 * np.arange(9.0)) == []
    assert film_task._bends(np.zeros(3)) == []


def test_a_motion_between_images_is_complete_at_the_pairs_stroke() -> None:
    wrong = "[misalignment]\nyaw_rad = 0.01\nshift_x_m = 2e-3\n\n[film]"
    plan, (film, *_) = film_plans(parse_recipe(TEXT[: TEXT.index("[[film.vibration]]")].replace("[film]", wrong)))
    rig, scene = plan.rigs[film.pair.rig], film.scene
    assert rig.motion is not None
    assert scene.view_at(9.0).T_world_camera == rig.at(film.pair.stroke_m).T_world_camera
    assert scene.view_at(0.0).T_world_camera == rig.at(0.0).T_world_camera
    part = float(scene.offset_m(0.4)) / film.pair.stroke_m
    assert 0.0 < part < 1.0
    yaw = scene.view_at(0.4).T_world_camera.R @ rig.T_world_camera.R.T
    assert np.arctan2(yaw[1, 0], yaw[0, 0]) == pytest.approx(0.01 * part, abs=1e-12)
    # the estimator's rig knows nothing of it
    assert film.nominal.rig.motion is None


def test_a_target_that_is_never_seen_is_one_sentence(tmp_path: Path) -> None:
    recipe = tmp_path / "hidden.toml"
    # behind the cabinet of the lab
    hidden = TEXT.replace("depth_m = 1.5", "depth_m = 4.9").replace("azimuth_deg = 100.0", "azimuth_deg = 228.1")
    hidden = hidden.replace("height_m = 0.50", "height_m = 0.45").replace("frames = 10", "frames = 3")
    recipe.write_text(hidden.replace('code = "110"\n', "").replace('code = "10"\n', ""), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"never seen|an image all the time"):
        make_films(recipe, tmp_path / "out", 1)


def test_other_folders_are_refused(film_windows: Path, tiny_dataset: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "films.toml"
    recipe.write_text(TEXT, encoding="utf-8")
    with pytest.raises(DatasetError, match="data set of pairs"):
        make_films(recipe, tiny_dataset, 1)
    with pytest.raises(DatasetError, match="holds no films"):
        open_films(tmp_path)
    recipe.write_text(TEXT.replace('name = "films"', 'name = "others"'), encoding="utf-8")
    with pytest.raises(DatasetError, match="holds the films of 'films'"):
        make_films(recipe, film_windows, 1)
    with pytest.raises(DatasetError, match="frames 0 to 9"):
        film_of(film_windows).room(10)


def test_the_centre_of_the_light_is_that_of_its_electrons(film_images: Path) -> None:
    film, whole = film_of(film_images), 0
    for row in film.table.iter_rows(named=True):
        # boards are even: light and axis are 0.3 mpx apart (docs/model.md), D by as little
        light = np.array([row["row_light_u_px"], row["row_light_v_px"]])
        assert light == pytest.approx([row["row_u_px"], row["row_v_px"]], abs=0.005)
        assert row["row_light_depth_m"] == pytest.approx(row["depth_m"], rel=1e-4)
        if row["row_laser_level"] < 1.0:  # lit during a part of the exposure: the mean place is another one
            continue
        image = film.spots[row["frame"]]
        plane = image.electrons_per_s[0].astype(float)
        v, u = np.mgrid[: plane.shape[0], : plane.shape[1]]
        centre = np.array([(u * plane).sum(), (v * plane).sum()]) / plane.sum() + image.origin_px
        # rows see the spot at their own times: 5 px/s x 0.33 ms a row stretch a spot of 2 px by 0.01 px, evenly
        assert centre == pytest.approx(light, abs=0.01)
        whole += 1
    assert whole >= 1
    assert film.light_depth_m == pytest.approx(film.table["depth_m"][0], rel=1e-4)
