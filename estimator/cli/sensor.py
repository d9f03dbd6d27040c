"""Command `phibench sensor fit`: numbers of a camera from its own frames."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from phibench.estimator.cli.options import SENSOR

sensor = App(name="sensor", group=SENSOR, help="Measure a camera from its own frames.")


@sensor.command
def fit(folder: Path, *, out: Path) -> int:
    """Fit a camera's gain, noise, fixed pattern, tone curve, sharpness, JPEG and lens to frames of it.

    docs/capture.md says which frames to take, and how.

    Parameters
    ----------
    folder
        Folder with dark/, flat/LEVEL/, exposure/SECONDS/, dark-exposure/SECONDS/, edge/ and chessboard/; any of them.
    out
        Sensor file to write, TOML; `dataset frames`, `score` and others take it as --sensor.
    """
    from phibench.datasets.frames.sensor_file import write_sensor_file
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.sensor_fit.fit import fit_sensor

    require_writable(out)
    found = fit_sensor(folder)
    write_sensor_file(out, found.file)
    tables = found.file.tables
    print(f"{'number':22s} {'value':>12s} {'sigma':>10s}")
    for name, value in found.file.numbers.items():
        sigma = tables.sigma.get(name)
        shown = f"{value:12.5g}" if isinstance(value, float | int) else f"{value!s:>12s}"
        print(f"{name:22s} {shown} {'' if sigma is None else f'{sigma:10.2g}'}".rstrip())
    for name, one in tables.measured.items():
        print(f"measured {name}: {one.value} {one.unit}, sigma {one.sigma}")
    for name, why in tables.not_determined.items():
        print(f"{name}: not determined from these frames: {why}")
    print(f"{out}: sensor file of {found.capture.frames} frames; use it with `phibench dataset frames --sensor {out}`")
    return 0
