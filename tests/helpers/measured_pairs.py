"""Figures of `phibench measure`: pairs of one rig written as camera files, calibrated and measured from them alone.

    phibench dataset make tests/one_rig.toml --out FOLDER
    PYTHONPATH=tests python tests/helpers/measured_pairs.py FOLDER PICTURES [mjpeg | bayer-raw] [own] [sensor] [0 | 1]

The rig file says what the drawing says, `[rig]` without any number: the true rig is off by its `[misalignment]`, and
its blur and filters are others. A third of the samples, by the number 0 to 2, calibrate it, at the distances of a tape
of 2 mm. The others are measured by the calibration, with `own` by their own outlines alone, too, and by the scorer that
knows the true rig and stroke. With `sensor` the sensor is fitted to dark and flat raw frames of the same camera first.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from helpers.sensor_captures import write_raw_capture

from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.frames.sensor_file import write_sensor_file
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.estimator.captures.imported_calibration import calibrate_imported
from phibench.estimator.captures.imported_set import import_pairs
from phibench.estimator.captures.measure import Setting, measure, read_setting
from phibench.estimator.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.estimator.captures.picture_files import read_photo
from phibench.estimator.draw_pairs import pairs_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.sensor_fit.fit import fit_sensor
from phibench.render.sensor.settings import sensor

TAPE_M, PART = 0.002, 3
NAMES = ("down", "up", "down_off", "up_off")


@dataclass(frozen=True)
class Row:
    """One pair: true D, D and sigma of the command, D of the scorer that knows the rig."""

    sample_id: str
    true_m: float
    found_m: float
    sigma_m: float
    spot_m: float
    known_m: float


def seen(dataset: Dataset) -> list[Sample]:
    """Samples whose spot is seen in both images."""
    return [sample for sample in dataset if sample.row.down.visible and sample.row.up.visible]


def write_files(dataset: Dataset, samples: list[Sample], folder: Path, preset: str) -> None:
    """Camera files, `pairs.csv` with a tape's D, and a rig file without a number."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, lines = np.random.default_rng(20261123), ["name,down,up,down_off,up_off,stroke_m,depth_m,depth_sigma_m"]
    pairs = pairs_of(dataset, samples, preset)
    for number, sample in enumerate(samples):
        _, frames = pairs.pair_and_frames(number)
        files = []
        for name in NAMES:
            frame = frames.by_name[name]
            file = folder / f"{sample.row.sample_id}-{name}.{'png' if frame.jpeg is None else 'jpg'}"
            file.write_bytes(png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
            files.append(file.name)
        tape_m = sample.row.depth_m + TAPE_M * rng.standard_normal()
        lines.append(f"{sample.row.sample_id},{','.join(files)},{sample.row.nominal_stroke_m},{tape_m:.4f},{TAPE_M}")
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    (folder / "rig.toml").write_text("[rig]\n")


def write_sensor(pictures: Path) -> Path:
    """Sensor file of dark and flat raw frames of the simulated camera; the set that calibrates takes it, too."""
    found = fit_sensor(write_raw_capture(pictures / "capture", sensor("bayer-raw")))
    write_sensor_file(pictures / "sensor.toml", found.file)
    shutil.copy(pictures / "sensor.toml", pictures / "calibrate" / "sensor.toml")
    return pictures / "sensor.toml"


def known(dataset: Dataset, sample: Sample, preset: str) -> float:
    """D of the same frames by the scorer that knows rig and stroke; NaN where the method finds no spot."""
    pair = replace(pairs_of(dataset, [sample], preset).pair(0), rig=sample.rig, stroke_m=sample.row.stroke_m)
    method = METHODS["chain_fit" if preset == "mjpeg" else "raw_maximum_likelihood"]
    answer = method(pair)
    if answer.down.uv_px is None or answer.up.uv_px is None:
        return float("nan")
    places = np.array(answer.down.uv_px), np.array(answer.up.uv_px)
    return float(depth_exact(sample.rig, sample.row.stroke_m, *places).depth_m)


def measured(dataset: Dataset, sample: Sample, folder: Path, preset: str, setting: Setting) -> Row | None:
    """The command's result for one sample; None where it refuses."""
    end = "jpg" if preset == "mjpeg" else "png"
    read = [
        (read_photo(folder / f"{sample.row.sample_id}-{name}.{end}", setting.known.rig, setting.sensor),)
        for name in NAMES
    ]
    photos = PairPhotos(PositionPhotos(read[0], read[2]), PositionPhotos(read[1], read[3]))
    try:
        found = measure(photos, sample.row.nominal_stroke_m, setting)
    except DatasetError as error:
        print(f"{sample.row.sample_id}: {error}", flush=True)
        return None
    doubt = "" if found.one_point else " DOUBTFUL"
    known_m = known(dataset, sample, preset)
    row = Row(
        sample.row.sample_id,
        sample.row.depth_m,
        found.depth_m,
        found.sigma_m,
        float(found.depth.sigma_spot_m),
        known_m,
    )
    print(
        f"{row.sample_id}: true {row.true_m:.3f} m, found {row.found_m:.3f} +- {row.sigma_m:.3f} (spots "
        f"{row.spot_m:.3f}), rig known {row.known_m:.3f}{doubt}",
        flush=True,
    )
    return None if doubt else row


def summary(name: str, rows: list[Row]) -> str:
    """Rms relative errors, their ratio, and the pull, over pairs that the scorer finds to 10 %."""
    both = [row for row in rows if abs(row.known_m / row.true_m - 1.0) < 0.1]
    found = np.array([row.found_m / row.true_m - 1.0 for row in both])
    other = np.array([row.known_m / row.true_m - 1.0 for row in both])
    pull = np.array([(row.found_m - row.true_m) / row.sigma_m for row in both])
    rms, rms_known, pull_rms = (float(np.sqrt(np.mean(x**2))) for x in (found, other, pull))
    return (
        f"{name}: {len(both)} pairs, rms of D {100.0 * rms:.3f} %, of the scorer that knows the rig "
        f"{100.0 * rms_known:.3f} %, ratio {rms / rms_known:.2f}, pull {pull_rms:.2f}"
    )


def main(arguments: list[str]) -> None:
    """Print the figures."""
    dataset, pictures = open_finished(arguments[0]), Path(arguments[1])
    preset = arguments[2] if len(arguments) > 2 else "mjpeg"
    samples, which = seen(dataset), next((int(word) for word in arguments if word in ("0", "1", "2")), 0)
    first, rest = samples[which::PART], [sample for k, sample in enumerate(samples) if k % PART != which]
    write_files(dataset, first, pictures / "calibrate", preset)
    sensor_file = write_sensor(pictures) if "sensor" in arguments else None
    write_files(dataset, rest, pictures / "measure", preset)
    import_pairs(pictures / "calibrate", pictures / "set")
    calibration = calibrate_imported(pictures / "set", pictures / "rig.json", spots=True)
    print(calibration.verdict, flush=True)
    rig = pictures / "measure" / "rig.toml"
    settings = [("calibrated", read_setting(rig, pictures / "rig.json", sensor_file))]
    settings += [("own outlines", read_setting(rig, sensor=sensor_file))] if "own" in arguments else []
    for name, setting in settings:
        rows = [measured(dataset, sample, pictures / "measure", preset, setting) for sample in rest]
        print(summary(name, [row for row in rows if row is not None]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
