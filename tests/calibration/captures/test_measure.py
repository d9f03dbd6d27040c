"""`phibench measure`: D from camera files, its standard deviation, and one sentence for every mistake."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.camera_files import NAMES, write_pictures
from PIL import Image

from phibench.calibration.captures.measure import _corrected, measure, read_setting
from phibench.calibration.captures.measurement_doubts import apart_note, calibration_note
from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.calibration.captures.picture_files import read_photo
from phibench.calibration.outline.outline_result import Outline, outlines_as_one
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.spots.image_planes import ImageError

Files = dict[str, list[Path]]


class Case:
    """Camera files of the pair of `tests/tiny.toml` that is seen, three frames of each kind."""

    def __init__(self, folder: Path, out: Path) -> None:
        dataset = open_dataset(folder)
        self.sample: Sample = next(s for s in dataset if s.row.down.visible and s.row.up.visible)
        self.folder = out
        self.jpg = write_pictures(dataset, self.sample, out, "mjpeg", 3)
        # a third of the camera's own exposure: photons rule, and not the responsivity's pattern
        self.raw = write_pictures(dataset, self.sample, out, "bayer-raw", 3, 1.0 / 60.0)

    def arguments(self, files: Files, stroke_m: float | None = None, names: tuple[str, ...] = NAMES) -> list[str]:
        """Command line for the first frames."""
        given = [word for name in names for word in (f"--{name.replace('_', '-')}", str(files[name][0]))]
        stroke = self.sample.row.stroke_m if stroke_m is None else stroke_m
        return ["measure", *given, "--stroke-m", str(stroke), "--rig", str(self.folder / "rig.toml")]


@pytest.fixture(scope="module")
def case(tiny_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case(tiny_dataset, tmp_path_factory.mktemp("pictures"))


@pytest.fixture
def unaligned(monkeypatch: pytest.MonkeyPatch) -> None:
    """No outline is looked for, which takes seconds: the rig is then as a ruler gives it."""

    def nothing(*_: object) -> None:
        raise ImageError("not looked for")

    monkeypatch.setattr("phibench.calibration.captures.measure.find_outline", nothing)
    monkeypatch.setattr("phibench.calibration.captures.measure.other_size_note", lambda *_: "")


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """The one sentence with which a command ends."""
    assert main(arguments) == 2
    # a slow machine says that it still runs
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if ": running for " not in line]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.usefixtures("unaligned")
def test_the_command_gives_d_and_a_picture(case: Case, tmp_path: Path, capsys) -> None:
    out = tmp_path / "found.png"
    assert main([*case.arguments(case.raw), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    depth, sigma = (float(x) for x in re.findall(r"D = ([\d.]+) m, sigma ([\d.]+) m", text)[0])
    # 4 sigma: by chance in 6e-5 of all cases; and the sigma is of the size that the paper's rig has
    assert abs(depth - case.sample.row.depth_m) < 4.0 * sigma
    assert 0.001 < sigma < 0.4
    for words in ("assumed", "one point", "errors of a ruler; no outline: not looked for"):
        assert words in text
    with Image.open(out) as picture:
        assert picture.size[0] > 2 * 600


def test_the_outline_corrects_the_rig_and_the_spots_say_their_blur(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    setting, true = read_setting(case.folder / "rig.toml"), case.sample.rig
    # a mirror 2 mm further away than in the rig file, seen to 0.05 mm across and 0.1 mm along
    s, C = true.sphere_in_camera_m + np.array([0.0, 0.0, 2e-3]), np.diag([5e-5, 5e-5, 1e-4]) ** 2
    outline = Outline(s, C, 1.0, 1.0, 0.9, 0.1, 1000, 5)
    monkeypatch.setattr("phibench.calibration.captures.measure.find_outline", lambda *_: outline)
    read = {name: (read_photo(paths[0], setting.known.rig),) for name, paths in case.raw.items()}
    photos = PairPhotos(PositionPhotos(read["down"], read["down_off"]), PositionPhotos(read["up"], read["up_off"]))
    stages: list[str] = []
    found = measure(photos, case.sample.row.stroke_m, setting, stages.append)
    assert stages == ["trying what the files stand for", "looking for the mirror's outline", "fitting the spots"]
    # the outline says |s| / R only: most of it goes into the distance, whose ruler is the worst
    assert 1e-3 < found.rig.sphere_in_camera_m[2] - setting.known.rig.sphere_in_camera_m[2] < 2e-3
    # two bright spots against an outline's 0.90 px: theirs is 0.70 px, to some 0.03 px; 2 sigma
    assert abs(found.rig.camera.blur_sigma_px - true.camera.blur_sigma_px) < 0.06
    assert any("corrected by the mirror's outline" in note for note in found.notes)


def test_outlines_of_one_rig_claim_what_one_does() -> None:
    C = np.diag([5e-5, 5e-5, 1e-4]) ** 2
    outlines = [Outline(np.array([0.0, 0.0, z]), C, 1.0, 1.0, 0.9, 0.1, 1000, 5) for z in (0.26, 0.26, 0.26)]
    assert np.allclose(outlines_as_one(outlines).covariance, C, rtol=1e-12, atol=0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_sigma_falls_with_the_frames(case: Case) -> None:
    setting = read_setting(case.folder / "rig.toml")
    read = {name: [read_photo(path, setting.known.rig) for path in paths] for name, paths in case.raw.items()}

    def spots(count: int) -> tuple[float, float]:
        groups = {name: tuple(photos[:count]) for name, photos in read.items()}
        photos = PairPhotos(
            PositionPhotos(groups["down"], groups["down_off"]), PositionPhotos(groups["up"], groups["up_off"])
        )
        found = measure(photos, case.sample.row.stroke_m, setting)
        return float(found.depth.sigma_spot_m), abs(found.depth_m - case.sample.row.depth_m) / found.sigma_m

    (one, _), (three, pull) = spots(1), spots(3)
    # sqrt(3) for pure noise; the responsivity's pattern does not average, the fit's own misfit scatters
    assert 1.3 < one / three < 2.0
    assert pull < 4.0


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_jpeg_frames_are_fitted_together(case: Case, capsys) -> None:
    several = [word for name in NAMES for word in (f"--{name.replace('_', '-')}", *map(str, case.jpg[name]))]
    stroke = ["--stroke-m", str(case.sample.row.stroke_m), "--rig", str(case.folder / "rig.toml")]
    assert main(["measure", *several, *stroke]) == 0
    text = capsys.readouterr().out
    depth, sigma = (float(x) for x in re.findall(r"D = ([\d.]+) m, sigma ([\d.]+) m", text)[0])
    assert abs(depth - case.sample.row.depth_m) < 4.0 * sigma
    assert "3 of each position" in text


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_swapped_positions_are_told(case: Case, capsys) -> None:
    swapped = {"down": case.raw["up"], "up": case.raw["down"]}
    swapped |= {"down_off": case.raw["up_off"], "up_off": case.raw["down_off"]}
    assert "swapped" in refused(capsys, case.arguments(swapped))


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_laser_on_and_off_exchanged_is_told(case: Case, capsys) -> None:
    dark = {"down": case.raw["down_off"], "up": case.raw["up_off"]}
    dark |= {"down_off": case.raw["down"], "up_off": case.raw["up"]}
    assert "laser on and off are exchanged" in refused(capsys, case.arguments(dark))


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_all_four_pictures_exchanged_are_told(case: Case, capsys) -> None:
    crossed = {"down": case.raw["up_off"], "up": case.raw["down_off"]}
    crossed |= {"down_off": case.raw["up"], "up_off": case.raw["down"]}
    assert "laser on and off are exchanged, and down and up, too" in refused(capsys, case.arguments(crossed))


@pytest.mark.usefixtures("unaligned")
def test_laser_on_and_off_exchanged_at_one_position_is_told(case: Case, capsys) -> None:
    one = {**case.raw, "up": case.raw["up_off"], "up_off": case.raw["up"]}
    said = refused(capsys, case.arguments(one))
    assert "exchanged at the position up: the spot is in" in said
    assert "down" not in said.partition("exchanged at")[2]


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_red_and_blue_exchanged_are_told(case: Case, tmp_path: Path, capsys) -> None:
    """Frames that OpenCV counts as B, G, R, stored as if they were R, G, B: D was 6 sigma off, with the wrong doubt."""
    swapped = {}
    for name in NAMES:
        with Image.open(case.jpg[name][0]) as picture:
            colours = Image.fromarray(np.ascontiguousarray(np.array(picture)[..., ::-1]))
            swapped[name] = [tmp_path / f"{name}.jpg"]
            colours.save(swapped[name][0], qtables=picture.quantization, subsampling="4:2:2")
    assert "red and blue are exchanged" in refused(capsys, case.arguments(swapped))


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
@pytest.mark.parametrize("kind", ["raw", "jpg"])
def test_a_camera_that_moved_between_on_and_off_is_told(case: Case, tmp_path: Path, kind: str, capsys) -> None:
    """Three pixels: the edges that remain are no spot, and their remedy is not an exchange. A found D is doubtful."""
    files, moved = getattr(case, kind), {}
    for name in ("down_off", "up_off"):
        with Image.open(files[name][0]) as picture:
            shifted = Image.fromarray(np.roll(np.array(picture), 3, axis=1))
            moved[name] = [tmp_path / f"{name}{files[name][0].suffix}"]
            options = {"qtables": picture.quantization, "subsampling": "4:2:2"} if kind == "jpg" else {}
            shifted.save(moved[name][0], **options)
    main(case.arguments({**files, **moved}))
    said = "".join(capsys.readouterr())
    assert "exchanged" not in said
    found = re.search(r"the camera moved between laser on and off, by ([\d.]+) px", said)
    # a parabola through the correlation errs by up to 0.1 px
    assert found is not None
    assert found[1] in ("2.9", "3.0", "3.1")


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
@pytest.mark.parametrize(("degrees", "far_px"), [(2.0, 0), (0.0, 40)])
def test_a_camera_that_turned_or_moved_far_is_told(
    case: Case, tmp_path: Path, degrees: float, far_px: int, capsys
) -> None:
    """A turn about the middle moves the whole by nothing: the light was called too faint."""
    moved = {}
    for name in ("down_off", "up_off"):
        with Image.open(case.jpg[name][0]) as picture:
            turned = picture.rotate(degrees, Image.Resampling.BICUBIC) if degrees else picture.copy()
            shifted = Image.fromarray(np.roll(np.array(turned), far_px, axis=1))
            moved[name] = [tmp_path / f"{name}.jpg"]
            shifted.save(moved[name][0], qtables=picture.quantization, subsampling="4:2:2")
    main(case.arguments({**case.jpg, **moved}))
    said = "".join(capsys.readouterr())
    found = re.search(r"the camera moved between laser on and off, by ([\d.]+) px", said)
    assert found is not None
    assert float(found[1]) == pytest.approx(far_px, abs=0.3) if far_px else float(found[1]) > 1.0  # 2 deg of 30 px


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_light_that_changed_between_on_and_off_is_told(case: Case, tmp_path: Path, capsys) -> None:
    relit = {}
    for name in ("down_off", "up_off"):
        with Image.open(case.raw[name][0]) as picture:
            brighter = 64.0 + 1.3 * (np.array(picture, float) - 64.0)
        relit[name] = [tmp_path / f"{name}.png"]
        Image.fromarray(np.clip(np.rint(brighter), 0, 1023).astype(np.uint16)).save(relit[name][0])
    swapped = {**case.raw, **relit, "down": case.raw["down_off"][1:], "up": case.raw["up_off"][1:]}
    said = refused(capsys, case.arguments(swapped))
    assert "the light changed between laser on and off" in said


@pytest.mark.usefixtures("unaligned")
def test_light_that_changed_makes_no_other_chain(case: Case, tmp_path: Path, capsys) -> None:
    """The room is left in laser on less laser off, and makes neighbours alike: DN were called smoothed."""
    relit = {}
    for name in ("down_off", "up_off"):
        with Image.open(case.raw[name][0]) as picture:
            darker = np.rint(64.0 + 0.8 * (np.array(picture, float) - 64.0)).astype(np.uint16)
        relit[name] = [tmp_path / f"{name}.png"]
        Image.fromarray(darker).save(relit[name][0])
    main(case.arguments({**case.raw, **relit}))
    said = "".join(capsys.readouterr())
    assert "doubtful: the light changed between laser on and off" in said
    assert "another chain" not in said


@pytest.mark.usefixtures("unaligned")
def test_a_difference_for_laser_on_is_told(case: Case, tmp_path: Path, capsys) -> None:
    given = {}
    for name in ("down", "up"):
        on, off = (np.array(Image.open(case.jpg[key][0]), int) for key in (name, f"{name}_off"))
        given[name], given[f"{name}_off"] = [tmp_path / f"{name}.png"], [tmp_path / f"{name}_off.png"]
        Image.fromarray(np.clip(on - off, 0, 255).astype(np.uint8)).save(given[name][0])
        Image.fromarray(off.astype(np.uint8)).save(given[f"{name}_off"][0])
    assert re.search(
        r"down\.png is black beside .*down_off\.png: a difference of both", refused(capsys, case.arguments(given))
    )


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_laser_off_pictures_of_the_other_position_are_told(case: Case, capsys) -> None:
    mixed = {**case.raw, "down_off": case.raw["up_off"], "up_off": case.raw["down_off"]}
    assert "laser off are exchanged" in refused(capsys, case.arguments(mixed))


def test_a_laser_off_picture_of_one_position_alone_is_told(case: Case, capsys) -> None:
    text = refused(capsys, case.arguments(case.raw, names=("down", "up", "down_off")))
    assert "with the laser off: 1 down and 0 up" in text


def test_a_stroke_with_a_comma_is_told(case: Case, capsys) -> None:
    arguments = case.arguments(case.raw)
    arguments[arguments.index("--stroke-m") + 1] = "0,425"
    assert main(arguments) == 2
    assert "write 0.425" in "".join(capsys.readouterr())


def test_a_list_between_semicolons_and_a_folder_without_out_are_told(case: Case, tmp_path: Path, capsys) -> None:
    rig = ["--rig", str(case.folder / "rig.toml")]
    assert "give --out" in refused(capsys, ["measure", str(tmp_path), *rig])
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        head = mark.join(("name", "down", "up", "stroke_m"))
        (tmp_path / "pairs.csv").write_text(f"{head}\n{mark.join(('a', 'a.jpg', 'b.jpg', '1,0'))}\n")
        out = ["--out", str(tmp_path / "out.csv")]
        assert name in refused(capsys, ["measure", str(tmp_path), *rig, *out])


@pytest.mark.usefixtures("unaligned")
def test_a_stroke_in_centimetres_is_told(case: Case, capsys) -> None:
    text = refused(capsys, case.arguments(case.raw, 0.01 * case.sample.row.stroke_m))
    assert "stroke contradicts" in text
    low, high = (float(x) for x in re.findall(r"a stroke of ([\d.e-]+) to ([\d.e-]+) m", text)[0])
    assert low < case.sample.row.stroke_m < high


@pytest.mark.parametrize(("factor", "unit"), [(1e2, "centimetres"), (1e3, "millimetres")])
def test_a_long_stroke_is_asked_for_its_unit(case: Case, capsys, factor: float, unit: str) -> None:
    text = refused(capsys, case.arguments(case.raw, factor * 0.3293))
    assert text.endswith(f"if these are {unit}, write 0.3293")


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_a_laser_that_is_off_is_told(case: Case, capsys) -> None:
    dark = {"down": case.raw["down_off"][1:], "up": case.raw["up_off"][1:]}
    dark |= {"down_off": case.raw["down_off"], "up_off": case.raw["up_off"]}
    arguments = case.arguments(dark)
    text = refused(capsys, arguments)
    assert "no laser spot" in text
    assert "rim" not in text
    rig = case.folder / "hyperboloid.toml"
    of_sphere = re.sub("(radius_m|z_c_m) = .*\n", "", (case.folder / "rig.toml").read_text())
    rig.write_text(of_sphere + '\n[rig.mirror]\nshape = "hyperboloid"\n')
    # the lens is in the outer focus: the rim's rays come from the inner one, 24.4 mm above the vertex, and the rim is
    # 28.6 mm above it: atan(4.1 / 60) = 3.9 degrees
    assert "rim hides what is more than about 4 degrees above" in refused(capsys, [*arguments[:-1], str(rig)])


def test_the_same_picture_twice_is_told(case: Case, capsys) -> None:
    files = {"down": case.jpg["down"], "up": case.jpg["down"]}
    assert "the same picture" in refused(capsys, case.arguments(files, names=("down", "up")))


def test_pictures_of_two_cameras_are_told(case: Case, tmp_path: Path, capsys) -> None:
    names = ("down", "up")
    with Image.open(case.jpg["up"][0]) as picture:
        smaller, coarser, other = (tmp_path / f"{name}.jpg" for name in ("smaller", "coarser", "other"))
        picture.resize((160, 90)).save(smaller, subsampling="4:2:2")
        picture.save(coarser, quality=30, subsampling="4:2:2")
        exif = Image.Exif()
        exif[0x0110] = "Another"
        picture.save(other, exif=exif, qtables=picture.quantization, subsampling="4:2:2")
    for path, word in ((smaller, "size"), (coarser, "quantisation tables"), (other, "Another")):
        assert word in refused(capsys, case.arguments({**case.jpg, "up": [path]}, names=names))
    assert "kind" in refused(capsys, case.arguments({**case.jpg, "up": case.raw["up"]}, names=names))


def test_pictures_turned_differently_by_exif_and_no_picture_are_told(case: Case, tmp_path: Path, capsys) -> None:
    exif, turned, none = Image.Exif(), tmp_path / "turned.jpg", tmp_path / "none.jpg"
    exif[0x0112] = 3
    with Image.open(case.jpg["up"][0]) as picture:
        picture.save(turned, exif=exif, qtables=picture.quantization, subsampling="4:2:2")
    none.write_text("no picture at all")
    for path, word in (
        (turned, "EXIF orientation 1 and 3"),
        (none, "is not a picture"),
        (tmp_path / "a.jpg", "missing"),
    ):
        assert word in refused(capsys, case.arguments({**case.jpg, "up": [path]}, names=("down", "up")))


def test_pictures_of_another_size_than_the_rigs_are_told(case: Case, tmp_path: Path, capsys) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text("[rig]\n")
    arguments = [str(rig) if word.endswith("rig.toml") else word for word in case.arguments(case.jpg)]
    assert "320 x 180 pixels, the camera of the rig file 1280 x 720" in refused(capsys, arguments)


def test_a_pgm_and_a_headerless_file_hold_the_same_dn(case: Case, tmp_path: Path) -> None:
    setting = read_setting(case.folder / "rig.toml")
    with Image.open(case.raw["down"][0]) as picture:
        dn = np.array(picture).astype(np.uint16)
    (tmp_path / "a.pgm").write_bytes(b"P5\n# a camera's\n320 180\n1023\n" + dn.astype(">u2").tobytes())
    (tmp_path / "a.raw").write_bytes(dn.astype("<u2").tobytes())
    (tmp_path / "sensor.toml").write_text('preset = "bayer-raw"\nread_noise_e = 5.0\n')
    known = read_setting(case.folder / "rig.toml", sensor=tmp_path / "sensor.toml")
    assert known.sensor is not None
    assert known.sensor.sensor().read_noise_e == 5.0
    for path in (tmp_path / "a.pgm", tmp_path / "a.raw"):
        assert np.array_equal(read_photo(path, known.known.rig, known.sensor).pixels, dn)
    with pytest.raises(DatasetError, match="headerless"):
        read_photo(tmp_path / "a.raw", setting.known.rig)
    (tmp_path / "b.raw").write_bytes(dn.tobytes()[:-2])
    with pytest.raises(DatasetError, match="bytes"):
        read_photo(tmp_path / "b.raw", known.known.rig, known.sensor)
    for head in (b"P5 320 180 1023 ", b"P5 0 0 1023\n", b"P5 99999999 9 9\n", b"P5\n"):
        (tmp_path / "b.pgm").write_bytes(head + bytes(3))
        with pytest.raises(DatasetError, match="PGM"):
            read_photo(tmp_path / "b.pgm", setting.known.rig)


def test_a_faulty_sensor_file_is_told(case: Case, tmp_path: Path, capsys) -> None:
    sensor = tmp_path / "sensor.toml"
    for text, word in (
        ('preset = "film"\n', "no sensor preset 'film'"),
        ("read_noise_e = -1.0\n", "read_noise_e"),
        ("nonsense", "TOML"),
    ):
        sensor.write_text(text)
        assert word in refused(capsys, [*case.arguments(case.jpg), "--sensor", str(sensor)])


def test_a_grey_jpeg_is_told(case: Case, tmp_path: Path, capsys) -> None:
    with Image.open(io.BytesIO(case.jpg["up"][0].read_bytes())) as picture:
        for name in ("down", "up"):
            picture.convert("L").rotate(180 * (name == "up")).save(tmp_path / f"{name}.jpg")
    grey = {name: [tmp_path / f"{name}.jpg"] for name in ("down", "up")}
    assert "grey picture of 8 bits" in refused(capsys, case.arguments(grey, names=("down", "up")))


@pytest.mark.parametrize(
    ("depth_m", "words"),
    [
        (0.2600, "still where it was"),
        (0.2577, "0.9 % larger (the lens was refocused, or"),
        (0.2623, "0.9 % smaller"),
    ],
)
def test_a_calibration_says_that_the_lens_was_turned(depth_m: float, words: str) -> None:
    """0.26 m then, with 20 um along the axis: a lens turned from far to 0.46 m moves the outline's place by 2.3 mm."""

    def outline(depth: float) -> Outline:
        return Outline(np.array([0.0, 0.0, depth]), np.diag([4e-6, 4e-6, 2e-5]) ** 2, 1.0, 1.0, 0.7, 0.1, 1000, 5)

    made = {"sphere_in_camera_m": [[0.0, 0.0, 0.26]], "sigma_m": [[4e-6, 4e-6, 2e-5]]}
    held = SimpleNamespace(made_from=made)
    assert words in "; ".join(calibration_note(held, [outline(depth_m)]))


def _outline(x: float, y: float, z: float) -> Outline:
    return Outline(np.array([x, y, z]), np.diag([2e-5, 2e-5, 1e-4]) ** 2, 1.0, 1.0, 0.7, 0.1, 1000, 5)


def test_a_mirror_elsewhere_in_the_second_picture_is_told() -> None:
    """4 px aside, and 1 % larger: a camera that was pushed, or zoomed, from one position to the other."""
    first = _outline(0.0, 0.0, 0.26)
    assert not apart_note([first, _outline(2e-5, -2e-5, 0.2601)])
    assert not apart_note([first])
    assert "moved by 0.73 mm (26 sigma) from the picture down" in apart_note([first, _outline(7.3e-4, 0.0, 0.26)])
    assert "1.0 % larger" in apart_note([first, _outline(0.0, 0.0, 0.2574)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("", ""),
        ("z_c_m = 0.263", ""),
        ("radius_m = 0.05", "20.0 % larger than fx_px, radius_m and z_c_m say"),
        ("z_c_m = 0.30", "15.4 % larger"),
        ("fx_px = 1550.0\nfy_px = 1550.0", "7.7 % smaller"),
    ],
)
def test_a_rig_file_that_the_outline_contradicts_is_told(tmp_path: Path, given: str, said: str) -> None:
    """D was 17 % off without a word: outlines tell the radius over the distance, and the rig file both."""
    (tmp_path / "rig.toml").write_text(f"[rig]\n{given}\n")
    setting = read_setting(tmp_path / "rig.toml")
    camera, radius = setting.known.rig.camera, setting.known.rig.sphere.radius_m
    # the same picture, by the focal length and the radius that the file says: 60 mm at 0.26 m under 1430 px
    z = 0.26 * radius / 0.06 * camera.fx_px / 1430.0
    doubt = _corrected(setting, [_outline(0.0, 0.0, z)], "")[-1]
    assert said in doubt
    assert bool(doubt) == bool(said)
