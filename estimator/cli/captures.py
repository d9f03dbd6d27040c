"""Commands `phibench measure` and `phibench import`: D from a person's own pictures, and data sets of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

Pictures = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")]


def measure(
    *,
    down: Pictures,
    up: Pictures,
    stroke_m: float,
    rig: Path,
    down_off: Pictures = (),
    up_off: Pictures = (),
    stroke_sigma_m: float = 0.0,
    calibration: Path | None = None,
    sensor: Path | None = None,
    out: Path | None = None,
) -> int:
    """Measure D from two pictures of a laser spot in the mirror, down and up.

    Parameters
    ----------
    down, up
        Pictures at stroke position 1 and 2, laser on: JPEG, PNG, PGM or headerless .raw. Several frames of each
        position may be given, as many of both.
    stroke_m
        Stroke between the two positions, metres.
    rig
        TOML file with what is known of the rig: `[rig]` of a recipe. docs/measure.md has an example.
    down_off, up_off
        The same with the laser off.
    stroke_sigma_m
        How well this stroke is known besides what is common to all strokes, one standard deviation.
    calibration
        File of `phibench calibrate`, made with the same rig file.
    sensor
        TOML file of the sensor; by default the preset of the kind of file is assumed.
    out
        PNG or JPEG to write: spots, epipolar line and outline.
    """
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.captures.measure import PairPhotos, PositionPhotos, read_setting
    from phibench.estimator.captures.measure import measure as measured
    from phibench.estimator.captures.measure_picture import write_measure_picture
    from phibench.estimator.captures.picture_files import read_photo

    if out is not None:
        require_writable(out)
    setting = read_setting(rig, calibration, sensor, stroke_sigma_m)
    groups = [
        tuple(read_photo(path, setting.known.rig, setting.sensor) for path in paths)
        for paths in (down, up, down_off, up_off)
    ]
    photos = PairPhotos(PositionPhotos(groups[0], groups[2]), PositionPhotos(groups[1], groups[3]))
    found = measured(photos, stroke_m, setting)
    print(f"D = {found.depth_m:.4f} m, sigma {found.sigma_m:.4f} m")
    spot_m, rig_m = float(found.depth.sigma_spot_m), float(found.depth.sigma_calibration_m)
    print(f"of which the spots {spot_m:.4f} m, the rig {rig_m:.4f} m, this stroke {found.depth.sigma_stroke_m:.4f} m")
    for position, spot in (("down", found.down), ("up", found.up)):
        print(f"{position}: spot at ({spot.uv_px[0]:.3f}, {spot.uv_px[1]:.3f}) px, sigma {spot.sigma_px:.3f} px")
    for note in found.notes:
        print(note)
    if out is not None:
        print(f"{write_measure_picture(out, found)}: spots, epipolar line and outline")
    return 0
