"""Commands `phibench measure`, `import`, `sensor fit`: D from own pictures, data sets of them, their camera fitted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from phibench.cli.options import SENSOR, Metres, SensorFile

if TYPE_CHECKING:
    from phibench.calibration.captures.measure import MeasureSetting

Pictures = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="", show_default=False)]


@Parameter(name="*")
@dataclass(frozen=True)
class PairPictures:
    """Pictures of one pair, and its stroke.

    Parameters
    ----------
    down
        Picture at stroke position 1, laser on: JPEG, PNG, PGM or headerless .raw. Several frames may be given.
    up
        The same at stroke position 2; as many frames as of position 1.
    stroke_m
        Stroke between the two positions, metres.
    down_off
        Picture at stroke position 1, laser off.
    up_off
        The same at stroke position 2.
    stroke_sigma_m
        How well this stroke is known besides what is common to all strokes, one standard deviation.
    """

    down: Pictures = ()
    up: Pictures = ()
    stroke_m: Metres | None = None
    down_off: Pictures = ()
    up_off: Pictures = ()
    stroke_sigma_m: Metres = 0.0


_FOLDER = PairPictures()


def measure(
    directory: Path | None = None,
    *,
    rig: Path,
    pair: PairPictures = _FOLDER,
    calibration: Path | None = None,
    sensor: SensorFile = None,
    out: Path | None = None,
) -> int:
    """Measure D from two pictures of a laser spot in the mirror, down and up; or from a folder of such pairs.

    Parameters
    ----------
    directory
        Folder with pictures and `pairs.csv`, instead of --down, --up and --stroke-m.
    rig
        TOML file with what is known of the rig: `[rig]` of a recipe. docs/measure.md has an example.
    calibration
        File of `phibench calibrate`, made with the same rig file.
    out
        PNG or JPEG to write: spots, epipolar line and outline. Of a folder, CSV of the results.
    """
    from phibench.calibration.captures.measure import read_setting
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.store.files import require_writable

    whole = bool(pair.down and pair.up and pair.stroke_m is not None)  # 0 m is told apart from none
    if (directory is None) != whole or (directory and (pair.down or pair.up or pair.stroke_m)):
        raise DatasetError("give --down, --up and --stroke-m, or a folder with pairs.csv instead of them")
    if out is not None:
        require_writable(out)
    setting = read_setting(rig, calibration, sensor, pair.stroke_sigma_m)
    if directory is not None:
        return _measure_folder(directory, setting, out)
    return _measure_pair(pair, setting, out)


def _measure_pair(pair: PairPictures, setting: MeasureSetting, out: Path | None) -> int:
    from phibench.calibration.captures.measure import measure as measured
    from phibench.calibration.captures.measure_picture import write_measure_picture
    from phibench.calibration.captures.pair_photos import read_photos
    from phibench.datasets.common.progress import progress_console, stages

    files = {"down": pair.down, "up": pair.up, "down_off": pair.down_off, "up_off": pair.up_off}
    with stages(progress_console(), "measure") as told:
        photos = read_photos(files, setting.known.rig, setting.sensor)
        measurement = measured(photos, pair.stroke_m or 0.0, setting, told)
    print(f"D = {measurement.depth_m:.4f} m, sigma {measurement.sigma_m:.4f} m")
    spot_m, rig_m = float(measurement.depth.sigma_spot_m), float(measurement.depth.sigma_calibration_m)
    print(
        f"of which the spots {spot_m:.4f} m, the rig {rig_m:.4f} m, this stroke "
        f"{measurement.depth.sigma_stroke_m:.4f} m"
    )
    for position, spot in (("down", measurement.down), ("up", measurement.up)):
        print(f"{position}: spot at ({spot.uv_px[0]:.3f}, {spot.uv_px[1]:.3f}) px, sigma {spot.sigma_px:.3f} px")
    for note in measurement.notes:
        print(note)
    if out is not None:
        print(f"{write_measure_picture(out, measurement)}: spots, epipolar line and outline")
    return 0


def _measure_folder(directory: Path, setting: MeasureSetting, out: Path | None) -> int:
    """Exit code 1 if a pair could not be measured, or contradicts itself or the tape."""
    from phibench.calibration.captures.pair_list import PairOutcome, measured_pairs, write_results
    from phibench.datasets.common.errors import DatasetError

    if out is None or out.suffix.lower() != ".csv":
        given = "without --out" if out is None else f"--out {out}"
        raise DatasetError(f"{given}: the results of a folder are a CSV file; give --out with a name that ends in .csv")

    def told(result: PairOutcome) -> None:
        measurement = result.found
        text = "" if measurement is None else f"D = {measurement.depth_m:.4f} m, sigma {measurement.sigma_m:.4f} m; "
        print(f"{result.row.name}: {text}{result.status}", flush=True)

    results = measured_pairs(directory, setting, told)
    told_depth = sum(result.found is not None for result in results)
    print(f"{write_results(out, results)}: D of {told_depth} of {len(results)} pairs")
    return 0 if all(result.status == "ok" for result in results) else 1


def import_(directory: Path, *, out: Path, rig: Path | None = None, sensor: Path | None = None) -> int:
    """Make a data set of real pairs, which `score`, `compare`, `report` and `calibrate` take like a rendered one.

    Parameters
    ----------
    directory
        Folder with pictures and `pairs.csv`; the D of a tape with its standard deviation is the truth of a pair.
    out
        Folder to write, new or empty.
    rig
        Rig file; `rig.toml` of the folder by default.
    sensor
        Sensor file; `sensor.toml` of the folder by default, and if there is none the preset of the kind of picture.
    """
    from phibench.calibration.captures.imported_set import import_pairs

    made = import_pairs(directory, out, rig, sensor)
    print(f"{made.folder}: {made.pairs} pair{'s' * (made.pairs != 1)}, {made.with_depth} of them with a measured D")
    print(made.sensor)
    return 0


sensor = App(name="sensor", group=SENSOR, help="Measure a camera from its own frames.")


@sensor.command
def fit(frames: Path, *, out: Path, page: Path | None = None) -> int:
    """Fit a camera's gain, noise, fixed pattern, tone curve, sharpness, JPEG and lens to frames of it.

    docs/capture.md says which frames to take, and how.

    Parameters
    ----------
    frames
        Folder with dark/, flat/LEVEL/, exposure/SECONDS/, dark-exposure/SECONDS/, edge/ and chessboard/, any of them;
        or a descriptor file of EMVA 1288.
    out
        Sensor file to write, TOML; `dataset frames`, `score` and others take it as --sensor.
    page
        Page to write, .html or .md: the numbers, and plots of what they were fitted to.
    """
    from phibench.calibration.sensor_fit.fit_page import numbers_of, remarks_of, require_page, write_page
    from phibench.calibration.sensor_fit.fit_sensor import fit_sensor
    from phibench.datasets.frames.sensor_file import write_sensor_file
    from phibench.datasets.store.files import require_writable

    for target in filter(None, (out, page)):  # before the minutes of the fit
        require_writable(target)
    if page is not None:
        require_page(page)
    fitted = fit_sensor(frames)
    write_sensor_file(out, fitted.file)
    print(f"{'number':32s} {'value':>14s} {'sigma':>10s}")
    for name, value, sigma in numbers_of(fitted):
        print(f"{name:32s} {value:>14s} {sigma:>10s}".rstrip())
    for said in remarks_of(fitted):
        print(said)
    if page is not None:
        print(f"{write_page(page, fitted)}: numbers and plots")
    print(f"{out}: sensor file of {fitted.capture.frames} frames; use it with `phibench dataset frames --sensor {out}`")
    return 0
