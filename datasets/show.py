"""Overview of a data set: a table, a JSON summary, and a contact sheet with the true spot positions marked."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from rich import box
from rich.console import Console
from rich.table import Table

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.pictures import (
    TEXT,
    Picture,
    captioned_picture,
    crop,
    display_exposure_s,
    enlarged,
    halved_planes,
    marked_picture,
    save_png,
    to_srgb,
)
from phibench.datasets.store.schema import ManifestRow, SpotRow
from phibench.scenes.rig import POSITIONS

_ZOOM = 8  # pixels of the enlarged window are shown 8 x 8
_COLUMNS = 2
_CAPTION_PX = 16


def show(folder: str | Path, console: Console | None = None, out: str | Path | None = None) -> Path:
    """Write the contact sheet of a data set and print its table; return the path of the sheet.

    Parameters
    ----------
    folder : path
    console : Console, optional
    out : path, optional
        PNG file for the contact sheet; by default `contact_sheet.png` in the folder.

    Raises
    ------
    DatasetError
        If the data set is damaged or unfinished, or, after the table, if the sheet cannot be written.
    """
    console, dataset = console or _console(), open_finished(folder)
    path = dataset.folder / schema.CONTACT_SHEET if out is None else Path(out)
    # the sheet comes first: who reads the table may leave before its end, as `head` does
    sheet, fault = contact_sheet(dataset, progress_console()), None
    try:
        save_png(path, sheet)
    except OSError as error:  # a disk that is full: the table is printed all the same
        fault = error
    _print_table(dataset, console)
    if fault is not None:
        raise DatasetError(f"the contact sheet was not written: {fault}, for example `--out sheet.png`") from fault
    console.print(f"contact sheet: {path}", highlight=False, soft_wrap=True)
    return path


def summary(folder: str | Path) -> dict[str, Any]:
    """Data set as one JSON document: what it is, and the manifest's rows as in `manifest.jsonl`.

    Raises
    ------
    DatasetError
        If the data set is damaged or unfinished.
    """
    dataset = open_finished(folder)
    info = dataset.info
    return {
        "name": info.name,
        "folder": str(dataset.folder),
        "schema_version": info.schema_version,
        "recipe_sha256": info.recipe_sha256,
        "samples": len(dataset),
        "left_out": [sample.model_dump(mode="json") for sample in info.left_out],
        "poses": len(info.poses),
        "rigs": len(dataset.rigs),
        "rooms": len(dataset.rooms),
        "presets": list(dataset.recipe.frames.presets) if dataset.recipe.frames else [],
        "rows": [row.model_dump(mode="json") for row in dataset.rows],
    }


class _PatientConsole(Console):
    """Console that goes on without output when its reader has left."""

    def on_broken_pipe(self) -> None:
        """Be quiet from now on; rich's own method ends the program."""
        with contextlib.suppress(SystemExit):  # rich ends the program where a pipe is closed
            super().on_broken_pipe()


def _console() -> Console:
    """Terminal as it is; wide enough for the table where the output goes to a file."""
    console = _PatientConsole(markup=False, emoji=False)
    return console if console.is_terminal else _PatientConsole(width=170, markup=False, emoji=False)


def table(dataset: Dataset) -> Table:
    """Table of all samples; each one's room takes the place of its experiment where there are several.

    Places, phi and D are those of the centre of the light, which scores refer to. The least sigma is that of phi_ray
    from one raw frame at the nominal exposure: "visible" is geometry alone, and a faint spot has a large one.
    """
    result = Table(title=_title(dataset), box=box.SIMPLE)
    several = len({row.room for row in dataset.rows}) > 1
    for heading in ("sample", "room" if several else "experiment"):
        result.add_column(heading, no_wrap=True)
    pixels = ("down u, v (px)", "up u, v (px)")
    for heading in ("D (m)", "h (m)", *pixels, "phi_ray (deg)", "least sigma (deg)", "visible"):
        result.add_column(heading, justify="right", no_wrap=True)
    for row in dataset.rows:
        result.add_row(*_cells(row, row.room if several else row.experiment))
    return result


def narrow_table(dataset: Dataset) -> Table:
    """Table of all samples for terminals of 80 columns: a line for each image, without phi."""
    result = Table(title=_title(dataset), box=None, padding=(0, 1, 0, 0))
    for heading in ("sample", "D (m)", "h (m)", "image", "u, v (px)", "sd (deg)", "visible"):
        words = heading in ("sample", "image", "visible")
        result.add_column(heading, justify="left" if words else "right", no_wrap=True)
    for row in dataset.rows:
        numbers = (row.sample_id, f"{row.centre_depth_m:.3f}", f"{row.stroke_m:.3f}")
        for position, cells in zip(POSITIONS, (numbers, ("", "", "")), strict=True):
            spot = row.position(position)
            result.add_row(*cells, position, _pixel(spot), _least_sigma(spot), "yes" if spot.visible else spot.cause)
    return result


def _print_table(dataset: Dataset, console: Console) -> None:
    """Print the table that fits, or the narrow one uncut: neither numbers nor names are shortened."""
    endless = console.options.update(width=10_000)  # to measure a table that nothing cuts
    wide, narrow = table(dataset), narrow_table(dataset)
    grid = wide if console.measure(wide, options=endless).maximum <= console.width else narrow
    width = console.width
    console.width = max(width, console.measure(grid, options=endless).maximum)
    try:
        console.print(grid)
    finally:
        console.width = width


def contact_sheet(dataset: Dataset, console: Console) -> Picture:
    """One strip per sample: both frames with a cross at the centre of the light, and the surroundings enlarged."""
    strips = []
    with Steps(console, "contact sheet", len(dataset)) as steps:
        for sample in dataset:
            strips.append(_strip(sample))
            steps.advance()
    blank = np.zeros_like(strips[0])
    columns = min(_COLUMNS, len(strips))
    strips += [blank] * (-len(strips) % columns)
    rows = [np.concatenate(strips[i : i + columns], axis=1) for i in range(0, len(strips), columns)]
    return np.concatenate(rows)


def _title(dataset: Dataset) -> str:
    checks = [spot.certificate.passed for row in dataset.rows for spot in (row.down, row.up) if spot.certificate]
    return (
        f"{dataset.info.name}: {len(dataset)} stroke pairs, {len(dataset.info.poses)} mirror poses; "
        f"certificates passed: {sum(checks)} of {len(checks)}"
    )


def _pixel(spot: SpotRow) -> str:
    return f"{spot.centre.u_px:.2f}, {spot.centre.v_px:.2f}" if np.isfinite(spot.u_px) else "-"


def _least_sigma(spot: SpotRow) -> str:
    """Sigma of phi_ray that the sensor's noise leaves at best, degrees: to two digits."""
    return f"{np.degrees(spot.noise.phi_sensor_rad):.2g}" if spot.noise else "-"


def _cells(row: ManifestRow, group: str) -> tuple[str, ...]:
    spots = (row.down, row.up)
    return (
        row.sample_id,
        group,
        f"{row.centre_depth_m:.3f}",
        f"{row.stroke_m:.3f}",
        *(_pixel(spot) for spot in spots),
        " / ".join(f"{np.degrees(spot.centre.phi_ray_rad):.3f}" for spot in spots),
        " / ".join(_least_sigma(spot) for spot in spots),
        " / ".join("yes" if spot.visible else spot.cause for spot in spots),
    )


def _strip(sample: Sample) -> Picture:
    parts = [picture for position in POSITIONS for picture in _pictures(sample, position)]
    strip = np.concatenate(
        [np.pad(picture, ((0, _height(parts) - len(picture)), (0, 4), (0, 0))) for picture in parts], axis=1
    )
    image = Image.fromarray(np.pad(strip, ((_CAPTION_PX, 4), (0, 0), (0, 0))))
    row = sample.row
    caption = f"{row.sample_id}   D = {row.centre_depth_m:.3f} m   h = {row.stroke_m:.3f} m   left: down, right: up"
    ImageDraw.Draw(image).text((4, 2), caption, fill=TEXT)
    return np.asarray(image)


def _height(parts: list[Picture]) -> int:
    return max(len(picture) for picture in parts)


def _pictures(sample: Sample, position: str) -> tuple[Picture, Picture]:
    detector, spot = sample.rig.camera.detector, sample.truth_row(position)
    frame = sample.expected_image(position)
    exposure = display_exposure_s(halved_planes(sample.ambient(position)), detector)
    overview = marked_picture(to_srgb(halved_planes(halved_planes(frame)), detector, exposure), spot.centre, 4)
    window = crop(frame, spot.centre)
    peak = float(window[1].max(initial=1.0))
    close = enlarged(to_srgb(window, detector, min(exposure, 1.0 / peak)), spot.centre, _ZOOM)
    return overview, close if spot.visible else captioned_picture(close, f"{position}: not visible\n{spot.cause}")
