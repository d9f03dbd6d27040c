"""Chains that the kind of a file does not tell: turned mosaics, decoded JPEG, scaled pictures; by pictures and by D."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.camera_files import NAMES, write_pictures
from PIL import Image
from scipy.ndimage import gaussian_filter

from phibench.calibration.captures import tested_chain
from phibench.calibration.captures.imported_set import ImportedSet, import_pairs, open_imported
from phibench.calibration.captures.measure import Measurement, measure, read_setting
from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.calibration.captures.picture_files import read_photo
from phibench.calibration.captures.raw_frames import MOST_LIKENESS, PATTERNS, neighbour_likeness
from phibench.calibration.captures.stored_colours import stored_with_less_note
from phibench.calibration.captures.tested_chain import comb_quality, interpolation, jpeg_behind
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.spots.image_planes import ImageError

Change = Callable[[np.ndarray], np.ndarray]
CARD = sensor_card("srgb8")
TURNS = {(1, 0): np.s_[:, ::-1], (0, 1): np.s_[::-1], (1, 1): np.s_[::-1, ::-1]}


class Case:
    """Pictures of the pair of `tests/tiny.toml` that is seen."""

    def __init__(self, folder: Path, out: Path) -> None:
        dataset = open_dataset(folder)
        self.folder = out
        self.sample: Sample = next(s for s in dataset if s.row.down.visible and s.row.up.visible)
        self.files = {
            preset: write_pictures(dataset, self.sample, out / preset, preset)
            for preset in ("srgb8", "bayer-raw", "mjpeg")
        }

    def pixels(self, preset: str, name: str) -> np.ndarray:
        with Image.open(self.files[preset][name][0]) as picture:
            return np.array(picture)

    def measured(self, pixels: dict[str, np.ndarray], out: Path) -> Measurement:
        """Measurement of pictures that are stored as PNG."""
        setting = read_setting(self.folder / "srgb8" / "rig.toml")
        read = {}
        for name in NAMES:
            Image.fromarray(np.ascontiguousarray(pixels[name])).save(out / f"{name}.png")
            read[name] = (read_photo(out / f"{name}.png", setting.known.rig),)
        photos = PairPhotos(PositionPhotos(read["down"], read["down_off"]), PositionPhotos(read["up"], read["up_off"]))
        return measure(photos, self.sample.row.stroke_m, setting)

    def spot_pulls(self, found: Measurement, phase: tuple[int, int]) -> list[float]:
        """Distances of the spots from the truth in a turned picture, over their sigma by the covariance."""
        size, pulls = np.array([320, 180]), []
        for spot, true in ((found.down, self.sample.row.down), (found.up, self.sample.row.up)):
            uv = np.array([true.u_px, true.v_px])
            off = spot.uv_px - np.where(np.array(phase) == 1, size - 1 - uv, uv)
            pulls.append(float(np.sqrt(off @ np.linalg.solve(spot.covariance_px2, off))))
        return pulls


@pytest.fixture(scope="module")
def case(tiny_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case(tiny_dataset, tmp_path_factory.mktemp("chains"))


@pytest.fixture
def unaligned(monkeypatch: pytest.MonkeyPatch) -> None:
    """No outline is looked for, which takes seconds."""

    def nothing(*_: object) -> None:
        raise ImageError("not looked for")

    monkeypatch.setattr("phibench.calibration.captures.measure.find_outline", nothing)
    monkeypatch.setattr("phibench.calibration.captures.measure.other_size_note", lambda *_: "")


def test_interpolation_tells_each_phase_and_what_was_scaled(case: Case) -> None:
    image = case.pixels("srgb8", "down_off")
    drawn = interpolation([image], CARD)
    assert (drawn.phase, drawn.exact) == ((0, 0), True)
    # of two roundings, of the code and of the mean of two or four codes: sqrt((1 + 1/2 .. 1/4) / 12) = 0.32 to 0.35
    assert 0.31 < min(drawn.residual_codes.values()) < 0.36
    for phase, turn in TURNS.items():
        assert interpolation([image[turn]], CARD).phase == phase
    for size in ((160, 90), (480, 270)):
        scaled = np.array(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
        assert not interpolation([scaled], CARD).exact
    assert interpolation([np.full((64, 64, 3), 90, np.uint8)], CARD).phase is None


@pytest.mark.parametrize(("quality", "sampling"), [(40, "4:2:0"), (60, "4:2:2"), (76, "4:2:2"), (85, "4:2:0")])
def test_a_decoded_jpeg_tells_its_quality(case: Case, quality: int, sampling: str) -> None:
    image = case.pixels("srgb8", "down_off")
    assert comb_quality(image) is None
    file = io.BytesIO()
    Image.fromarray(image[:176]).save(file, "JPEG", quality=quality, subsampling=sampling)
    decoded = np.array(Image.open(file))
    assert jpeg_behind(decoded) == (quality, sampling)
    assert jpeg_behind(decoded[3:, 5:]) is None  # its blocks begin elsewhere


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
@pytest.mark.parametrize("preset", ["srgb8", "bayer-raw"])
@pytest.mark.parametrize("phase", TURNS)
def test_a_camera_that_is_read_out_turned_is_measured(
    case: Case, tmp_path: Path, preset: str, phase: tuple[int, int]
) -> None:
    """The rig is symmetric, so that D stays; as RGGB the spots were 5 to 25 of their sigmas off."""
    found = case.measured({name: case.pixels(preset, name)[TURNS[phase]] for name in NAMES}, tmp_path)
    # 4 sigma of one degree of freedom, and the distance that is as rare for two: 6e-5 each, 1e-3 of all these
    assert abs(found.depth_m - case.sample.row.depth_m) < 4.0 * found.sigma_m
    assert max(case.spot_pulls(found, phase)) < 4.4
    assert any(f"mosaic: {PATTERNS[phase]}" in note for note in found.notes)
    assert not found.doubts


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_a_png_of_a_jpeg_is_measured_as_the_jpeg(case: Case, tmp_path: Path) -> None:
    pixels = {name: case.pixels("mjpeg", name) for name in NAMES}
    found = case.measured(pixels, tmp_path)
    assert any("decoded JPEG's of quality 76, 4:2:2" in note for note in found.notes)
    assert abs(found.depth_m - case.sample.row.depth_m) < 4.0 * found.sigma_m
    assert max(case.spot_pulls(found, (0, 0))) < 4.4


@pytest.mark.slow
@pytest.mark.usefixtures("unaligned")
def test_a_smoothed_picture_is_doubtful_and_a_drawn_one_is_not(case: Case, tmp_path: Path) -> None:
    drawn = case.measured({name: case.pixels("srgb8", name) for name in NAMES}, tmp_path)
    assert not drawn.doubts
    assert not any("mosaic" in note or "processing" in note for note in drawn.notes)

    def scaled(image: np.ndarray) -> np.ndarray:
        small = Image.fromarray(image).resize((160, 90), Image.Resampling.BICUBIC)
        return np.array(small.resize((320, 180), Image.Resampling.BICUBIC))

    found = case.measured({name: scaled(case.pixels("srgb8", name)) for name in NAMES}, tmp_path)
    assert any("sigma does not hold" in doubt for doubt in found.doubts)
    assert found.down.sigma_px > 0.25


def recoded(image: np.ndarray, quality: int) -> np.ndarray:
    """Pixels of a JPEG of chroma 4:2:2."""
    Image.fromarray(image).save(file := io.BytesIO(), "JPEG", quality=quality, subsampling="4:2:2")
    return np.array(Image.open(file))


@pytest.mark.parametrize(
    ("down", "up", "words"),
    [
        (lambda x: x, lambda x: recoded(x, 85), "as it was interpolated .*up.*png is a decoded JPEG of quality 85"),
        (lambda x: recoded(x, 70), lambda x: recoded(x, 85), "up.*png is a decoded JPEG of quality 85.*quality 70"),
        (lambda x: x, lambda x: gaussian_filter(x, (1.0, 1.0, 0.0)), "up.*png was scaled, filtered or compressed"),
    ],
)
def test_pictures_that_were_stored_in_different_ways_are_refused(
    case: Case, tmp_path: Path, down: Change, up: Change, words: str
) -> None:
    """The spot of the changed one was 5.3 of its sigmas off without a word, or "has not the shape of one"."""
    changes = {"down": down, "up": up, "down_off": down, "up_off": up}
    with pytest.raises(DatasetError, match=words):
        case.measured({name: changes[name](case.pixels("srgb8", name)) for name in NAMES}, tmp_path)


def test_colours_that_were_stored_with_less_are_told(case: Case) -> None:
    """Of a picture that was I420 the spot was 4.9 of its sigmas off, of one of 5 and 6 bits the mosaic was wrong."""
    drawn = case.pixels("srgb8", "down_off")
    assert stored_with_less_note([drawn]) == ""
    chroma = np.array(Image.fromarray(drawn).convert("YCbCr"))
    chroma[:, 1::2, 1:] = chroma[:, ::2, 1:]
    halved = np.array(Image.fromarray(chroma, "YCbCr").convert("RGB"))
    for columns in (0, 1):
        assert "half the columns" in stored_with_less_note([halved[:, columns:]])
    rng = np.random.default_rng(5)
    wide = np.clip(rng.normal(np.linspace(30.0, 220.0, 320)[:, None], 3.0, (180, 320, 3)), 0, 255).astype(np.uint8)
    assert stored_with_less_note([wide]) == ""
    assert "fewer codes" in stored_with_less_note([wide & 0xFC])


def test_dn_whose_noise_is_alike_are_not_raw(case: Case) -> None:
    """Of DN that were smoothed by 0.6 px a spot was 8.3 of its sigmas off without a word."""
    dn = {name: case.pixels("bayer-raw", name).astype(float) for name in NAMES}
    assert neighbour_likeness(dn) < 0.03  # of 58 000 pixels: 0.004 is the standard deviation of each correlation
    soft = {name: np.rint(gaussian_filter(image, 0.6)) for name, image in dn.items()}
    assert neighbour_likeness(soft) > 5.0 * MOST_LIKENESS
    assert neighbour_likeness({name: dn[name] for name in ("down", "up")}) == 0.0


@pytest.mark.usefixtures("unaligned")
def test_a_sensor_without_filters_is_told(case: Case, tmp_path: Path) -> None:
    """Grey light of a spot on all four places: the pair's raw pixels, each 2 x 2 replaced by its mean."""
    grey = {}
    for name in NAMES:
        dn = case.pixels("bayer-raw", name).astype(float)
        mean = dn.reshape(90, 2, 160, 2).mean(axis=(1, 3))
        grey[name] = np.rint(np.kron(mean, np.ones((2, 2)))).astype(np.uint16)
    with pytest.raises(DatasetError, match="no colour filters"):
        case.measured(grey, tmp_path)


def test_an_imported_set_has_the_chain_that_its_pictures_show(case: Case, tmp_path: Path) -> None:
    """A turned PNG keeps its phase, a PNG of a JPEG the JPEG's tables; turned DN are told what to cut off."""

    def imported(preset: str, turn: object, name: str) -> ImportedSet:
        folder = tmp_path / name
        folder.mkdir()
        for image in NAMES:
            Image.fromarray(np.ascontiguousarray(case.pixels(preset, image)[turn])).save(folder / f"{image}.png")
        (folder / "rig.toml").write_bytes((case.folder / preset / "rig.toml").read_bytes())
        columns = ",".join(f"{image}.png" for image in NAMES)
        text = f"name,{','.join(NAMES)},stroke_m\na,{columns},{case.sample.row.stroke_m}\n"
        (folder / "pairs.csv").write_text(text)
        return open_imported(import_pairs(folder, tmp_path / f"{name}-set").folder)

    for phase in ((0, 0), (1, 0), (1, 1)):
        found = imported("srgb8", TURNS.get(phase, ...), f"turned{phase[0]}{phase[1]}")
        assert (found.card.output, found.card.mosaic_phase) == ("srgb8", phase)
    found = imported("mjpeg", ..., "decoded")
    assert (found.card.output, found.card.jpeg_quality, found.card.jpeg_subsampling) == ("mjpeg", 76, "4:2:2")
    assert found.pair(found.rows[0]).down.shape == (180, 320, 3)
    with pytest.raises(DatasetError, match=r"begins with GRBG: .* cut 1 columns and 0 rows"):
        imported("bayer-raw", TURNS[1, 0], "dn")


@pytest.mark.parametrize(
    ("off", "words"), [((), "the laser off, too"), ((object(),), "smoothed before; give the camera")]
)
def test_a_light_that_is_no_spot_asks_for_pictures_with_the_laser_off(
    off: tuple[object, ...], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Codes 16 sigma off are another thing of the room or another chain; with laser-off pictures, the chain alone."""
    monkeypatch.setattr(tested_chain, "phase_weights", lambda _: ({(0, 0): 1.0}, 16.0))
    photos, card = SimpleNamespace(down=SimpleNamespace(off=off), up=SimpleNamespace(off=off)), sensor_card("srgb8")
    assert words in tested_chain._of_outputs(cast(Any, photos), card, lambda *_: cast(Any, None)).doubt
