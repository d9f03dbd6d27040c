"""Command `phibench sensor fit`: numbers of a camera from its own frames."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from phibench.estimator.cli.options import SENSOR

sensor = App(name="sensor", group=SENSOR, help="Measure a camera from its own frames.")


@sensor.command
def fit(folder: Path, *, out: Path, page: Path | None = None) -> int:
    """Fit a camera's gain, noise, fixed pattern, tone curve, sharpness, JPEG and lens to frames of it.

    docs/capture.md says which frames to take, and how.

    Parameters
    ----------
    folder
        Folder with dark/, flat/LEVEL/, exposure/SECONDS/, dark-exposure/SECONDS/, edge/ and chessboard/; any of them.
    out
        Sensor file to write, TOML; `dataset frames`, `score` and others take it as --sensor.
    page
        Page to write, .html or .md: the numbers, and plots of what they were fitted to.
    """
    from phibench.datasets.frames.sensor_file import write_sensor_file
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.sensor_fit.fit import fit_sensor
    from phibench.estimator.sensor_fit.fit_page import numbers_of, require_page, write_page

    for target in filter(None, (out, page)):
        require_writable(target)
    if page is not None:
        require_page(page)
    found = fit_sensor(folder)
    write_sensor_file(out, found.file)
    print(f"{'number':32s} {'value':>14s} {'sigma':>10s}")
    for name, value, sigma in numbers_of(found):
        print(f"{name:32s} {value:>14s} {sigma:>10s}".rstrip())
    for name, why in found.file.tables.not_determined.items():
        print(f"{name}: not determined from these frames: {why}")
    if page is not None:
        print(f"{write_page(page, found)}: numbers and plots")
    print(f"{out}: sensor file of {found.capture.frames} frames; use it with `phibench dataset frames --sensor {out}`")
    return 0
