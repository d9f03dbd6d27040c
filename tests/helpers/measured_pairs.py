"""Figures of `phibench measure`: pairs of one rig written as camera files, calibrated and measured from them alone.

    phibench dataset make tests/one_rig.toml --out FOLDER
    PYTHONPATH=tests python tests/helpers/measured_pairs.py FOLDER PICTURES --preset bayer-raw --sensor --third 0

The rig file says what the drawing says, `[rig]` without any number: the true rig is off by its `[misalignment]`, and
its blur and filters are others. A third of the samples calibrate it, at the distances of a tape of 2 mm. The others are
measured by the calibration, with --own by their own outlines alone, too, and by the scorer that knows the true rig and
stroke. With --sensor the sensor is fitted to dark and flat raw frames of the same camera first. With --quick no outline
of a pair that is measured is looked for: with a calibration it only tells whether the mirror has moved.

Each pair is one line of JSON in PICTURES/rows.jsonl. Files of that kind are put together by

    PYTHONPATH=tests python tests/helpers/measured_pairs.py --summary ROWS.jsonl ...
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from helpers.sensor_captures import write_raw_capture

from phibench.calibration.captures import measure as command
from phibench.calibration.captures.imported_calibration import calibrate_imported
from phibench.calibration.captures.imported_set import import_pairs
from phibench.calibration.captures.measure import MeasureSetting, measure, read_setting
from phibench.calibration.captures.pair_list import photos_of, read_pair_list
from phibench.calibration.rig.from_dataset import CalibrationSources
from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.frames.sensor_file import write_sensor_file
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.settings import sensor

TAPE_M, PART = 0.002, 3
NAMES = ("down", "up", "down_off", "up_off")
_FAR = 0.1  # of D, by which the scorer's D may be off before another light was taken


@dataclass(frozen=True)
class Row:
    """One pair: true D; D, sigma, its parts, p and doubt of the command; D of the scorer that knows the rig."""

    setting: str
    name: str
    true_m: float
    known_m: float
    found_m: float
    sigma_m: float
    spot_m: float
    rig_m: float
    p_value: float
    doubtful: bool

    @property
    def pull(self) -> float:
        """Error over sigma."""
        return (self.found_m - self.true_m) / self.sigma_m


def seen(dataset: Dataset) -> list[Sample]:
    """Samples whose spot is seen in both images."""
    return [sample for sample in dataset if sample.row.down.visible and sample.row.up.visible]


# -- files ---------------------------------------------------------------------------------------------------------


def write_files(
    dataset: Dataset, samples: Sequence[Sample], folder: Path, preset: str, draws: int = 1, frames: int = 1
) -> None:
    """Camera files of samples, `pairs.csv` with a tape's D, and a rig file without a number."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, lines = np.random.default_rng(20261123), ["name,down,up,down_off,up_off,stroke_m,depth_m,depth_sigma_m"]
    pairs = pairs_of(dataset, samples, preset, draws, frames=FrameCounts(frames, frames))
    for number in range(len(pairs)):
        sample, draw = samples[number // draws], number % draws
        name = f"{sample.row.sample_id}-{draw}"
        groups = [_write_frames(pairs, number, image, folder / name) for image in NAMES]
        tape_m = sample.row.depth_m + TAPE_M * rng.standard_normal()
        lines.append(f"{name},{','.join(groups)},{sample.row.nominal_stroke_m},{tape_m:.4f},{TAPE_M}")
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    (folder / "rig.toml").write_text("[rig]\n")


def _write_frames(pairs, number: int, image: str, stem: Path) -> str:
    """Names of one image's files, as `pairs.csv` has them."""
    pair_draw, _, source = pairs.drawn_from(number)
    laser, names = not image.endswith("_off"), []
    for k in range(pair_draw.frames[0 if laser else 1]):
        frame = source.frame(image.removesuffix("_off"), pair_draw.draw, laser, k)
        file = stem.with_name(f"{stem.name}-{image}-{k}.{'png' if frame.jpeg is None else 'jpg'}")
        file.write_bytes(png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
        names.append(file.name)
    return ";".join(names)


def write_sensor(pictures: Path) -> Path:
    """Sensor file of dark and flat raw frames of the simulated camera; the set that calibrates takes it, too."""
    found = fit_sensor(write_raw_capture(pictures / "capture", sensor("bayer-raw")))
    write_sensor_file(pictures / "sensor.toml", found.file)
    shutil.copy(pictures / "sensor.toml", pictures / "calibrate" / "sensor.toml")
    return pictures / "sensor.toml"


# -- measuring -----------------------------------------------------------------------------------------------------


def known(dataset: Dataset, sample: Sample, preset: str, draw: int, frames: int) -> float:
    """D of the same frames by the scorer that knows rig and stroke; NaN where the method finds no spot."""
    pairs = pairs_of(dataset, [sample], preset, draw + 1, frames=FrameCounts(frames, frames))
    pair = replace(pairs.pair(draw), rig=sample.rig, stroke_m=sample.row.stroke_m)
    method = METHODS["chain_fit" if preset == "mjpeg" else "raw_maximum_likelihood"]
    answer = method(pair)
    if answer.down.uv_px is None or answer.up.uv_px is None:
        return float("nan")
    places = np.array(answer.down.uv_px), np.array(answer.up.uv_px)
    return float(depth_exact(sample.rig, sample.row.stroke_m, *places).depth_m)


def measured(
    dataset: Dataset, preset: str, folder: Path, name: str, setting: MeasureSetting, frames: int
) -> Iterator[Row]:
    """Results of the command for a folder's pairs; those that it refuses are printed."""
    by_id = {sample.row.sample_id: sample for sample in dataset}
    for listed in read_pair_list(folder):
        sample_id, draw = listed.name.rsplit("-", 1)
        sample = by_id[sample_id]
        try:
            found = measure(photos_of(folder, listed, setting), listed.stroke_m, setting)
        except DatasetError as error:
            print(f"{listed.name}: {error}", flush=True)
            continue
        known_m = known(dataset, sample, preset, int(draw), frames)
        depth = found.depth
        for doubt in found.doubts:
            print(f"{listed.name}: {doubt}", flush=True)
        parts = float(depth.sigma_spot_m), float(depth.sigma_calibration_m), float(depth.p_value), bool(found.doubts)
        yield Row(name, listed.name, sample.row.depth_m, known_m, found.depth_m, found.sigma_m, *parts)


def summary(name: str, rows: Sequence[Row]) -> str:
    """Rms relative errors, their ratio, and the pull, over pairs that are not doubtful and the scorer finds to 10 %.

    The interval of the pull is that of resampled samples: draws of one sample share its light.
    """
    both = [row for row in rows if abs(row.known_m / row.true_m - 1.0) < _FAR and not row.doubtful]
    found = np.array([row.found_m / row.true_m - 1.0 for row in both])
    other = np.array([row.known_m / row.true_m - 1.0 for row in both])
    rms, rms_known = (float(np.sqrt(np.mean(x**2))) for x in (found, other))
    groups: dict[str, list[float]] = {}
    for row in both:
        groups.setdefault(row.name.rsplit("-", 1)[0], []).append(row.pull**2)
    squares, rng = list(groups.values()), np.random.default_rng(1)
    again = [
        np.sqrt(np.mean(np.concatenate([squares[k] for k in rng.integers(0, len(squares), len(squares))])))
        for _ in range(2000)
    ]
    low, high = np.quantile(again, (0.16, 0.84))
    pull = float(np.sqrt(np.mean([row.pull**2 for row in both])))
    doubtful = sum(row.doubtful for row in rows)
    return (
        f"{name}: {len(both)} pairs of {len(groups)} samples, {doubtful} doubtful; rms of D {100.0 * rms:.3f} %, of "
        f"the scorer that knows the rig {100.0 * rms_known:.3f} %, ratio {rms / rms_known:.2f}; "
        f"pull {pull:.2f} ({low:.2f} to {high:.2f})"
    )


def run(options: argparse.Namespace) -> None:
    """Write, calibrate, measure."""
    dataset, pictures, preset = open_finished(options.folder), options.pictures, options.preset
    samples = seen(dataset)
    rest = [sample for k, sample in enumerate(samples) if k % PART != options.third]
    write_files(dataset, samples[options.third :: PART], pictures / "calibrate", preset)
    sensor_file = write_sensor(pictures) if options.sensor else None
    write_files(dataset, rest, pictures / "measure", preset, options.draws, options.frames)
    import_pairs(pictures / "calibrate", pictures / "set")
    with_spots = CalibrationSources(spots=True)
    print(calibrate_imported(pictures / "set", pictures / "rig.json", sources=with_spots).verdict, flush=True)
    rig = pictures / "measure" / "rig.toml"
    settings = [("calibrated", read_setting(rig, pictures / "rig.json", sensor_file))]
    settings += [("own outlines", read_setting(rig, sensor=sensor_file))] if options.own else []
    if options.quick:
        command.find_outline = _no_outline
    with (pictures / "rows.jsonl").open("w") as lines:
        for name, setting in settings:
            rows = []
            for row in measured(dataset, preset, pictures / "measure", name, setting, options.frames):
                rows.append(row)
                lines.write(json.dumps(asdict(row)) + "\n")
                lines.flush()
            print(summary(name, rows), flush=True)


def _no_outline(*_: object) -> None:
    raise ImageError("not looked for")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("pictures", type=Path, nargs="?")
    parser.add_argument("--preset", default="mjpeg", choices=("mjpeg", "bayer-raw"))
    parser.add_argument("--third", type=int, default=0, choices=range(PART))
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--frames", type=int, default=1)
    for flag in ("--own", "--sensor", "--quick"):
        parser.add_argument(flag, action="store_true")
    parser.add_argument("--summary", nargs="+", type=Path)
    options = parser.parse_args()
    if options.summary:
        lines = [line for path in options.summary for line in path.read_text().splitlines()]
        print(summary("together", [Row(**json.loads(line)) for line in lines]))
        return
    run(options)


if __name__ == "__main__":
    main()
