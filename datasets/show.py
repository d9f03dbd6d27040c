"""A data set at a glance: a table, and a contact sheet with the true spot positions marked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from rich import box
from rich.console import Console
from rich.table import Table

from phibench.datasets import layout
from phibench.datasets.preview import Picture, exposure_s, halved, save_png, to_srgb
from phibench.datasets.progress import Steps
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.datasets.schema import ManifestRow, SpotRow
from phibench.scenes.rig import POSITIONS

_CROP_PX, _ZOOM = 24, 8  # the enlarged window measures 24 x 24 pixels, each shown 8 x 8
_COLUMNS = 2
_MARK, _TEXT = (0, 255, 80), (255, 255, 255)
_CAPTION_PX = 16


def show(folder: str | Path, console: Console | None = None) -> Path:
    """Print the table of a data set and write its contact sheet; return the path of the sheet."""
    console, dataset = console or _console(), open_finished(folder)
    console.print(table(dataset))
    path = dataset.folder / layout.CONTACT_SHEET
    save_png(path, contact_sheet(dataset, console))
    console.print(f"contact sheet: {path}", highlight=False, soft_wrap=True)
    return path


def _console() -> Console:
    """Terminal as it is; wide enough for the table where the output goes to a file."""
    console = Console()
    return console if console.is_terminal else Console(width=170)


def table(dataset: Dataset) -> Table:
    """Table of all samples."""
    title = f"{dataset.info.name}: {len(dataset)} stroke pairs, {len(dataset.info.poses)} mirror poses"
    result = Table(title=title, box=box.SIMPLE)
    for heading in ("sample", "experiment"):
        result.add_column(heading)
    for heading in ("D (m)", "h (m)", "down u, v (px)", "up u, v (px)", "phi_ray (deg)", "visible", "certificate"):
        result.add_column(heading, justify="right")
    for row in dataset.rows:
        result.add_row(*_cells(row))
    return result


def contact_sheet(dataset: Dataset, console: Console) -> Picture:
    """One strip per sample: both frames with a cross at the true spot, and the spot's surroundings enlarged."""
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


def _cells(row: ManifestRow) -> tuple[str, ...]:
    spots = (row.down, row.up)
    passed = all(spot.certificate is not None and spot.certificate.passed for spot in spots)
    return (
        row.sample_id,
        row.experiment,
        f"{row.depth_m:.3f}",
        f"{row.stroke_m:.3f}",
        *(f"{spot.u_px:.2f}, {spot.v_px:.2f}" for spot in spots),
        " / ".join(f"{np.degrees(spot.phi_ray_rad):.3f}" for spot in spots),
        " / ".join("yes" if spot.visible else spot.cause for spot in spots),
        "passed" if passed else "-",
    )


def _strip(sample: Sample) -> Picture:
    parts = [part for position in POSITIONS for part in _pictures(sample, position)]
    strip = np.concatenate([np.pad(part, ((0, _height(parts) - len(part)), (0, 4), (0, 0))) for part in parts], axis=1)
    image = Image.fromarray(np.pad(strip, ((_CAPTION_PX, 4), (0, 0), (0, 0))))
    row = sample.row
    caption = f"{row.sample_id}   D = {row.depth_m:.3f} m   h = {row.stroke_m:.3f} m   left: down, right: up"
    ImageDraw.Draw(image).text((4, 2), caption, fill=_TEXT)
    return np.asarray(image)


def _height(parts: list[Picture]) -> int:
    return max(len(part) for part in parts)


def _pictures(sample: Sample, position: str) -> tuple[Picture, Picture]:
    detector, spot = sample.dataset.rig.camera.detector, sample.truth_row(position)
    frame = sample.frame(position)
    exposure = exposure_s(halved(sample.ambient(position)), detector)
    overview = _marked(to_srgb(halved(halved(frame)), detector, exposure), spot)
    crop = _crop(frame, spot)
    peak = float(crop[1].max(initial=1.0))
    return overview, _enlarged(to_srgb(crop, detector, min(exposure, 1.0 / peak)), spot)


def _marked(picture: Picture, spot: SpotRow) -> Picture:
    """Frame at a quarter of its size, with a cross that leaves the spot itself free."""
    if not np.isfinite(spot.u_px):
        return picture
    image = Image.fromarray(picture)
    _cross(ImageDraw.Draw(image), (spot.u_px + 0.5) / 4.0, (spot.v_px + 0.5) / 4.0, 3.0, 8.0)
    return np.asarray(image)


def _crop(frame: np.ndarray, spot: SpotRow) -> np.ndarray:
    """Window of 24 x 24 pixels around the spot, black outside the image, shape (3, 24, 24)."""
    result = np.zeros((3, _CROP_PX, _CROP_PX))
    corner = _corner(spot)
    if corner is not None:
        (u0, v0), (height, width) = corner, frame.shape[1:]
        rows, columns = (slice(max(x, 0), max(min(x + _CROP_PX, n), 0)) for x, n in ((v0, height), (u0, width)))
        part = frame[:, rows, columns]
        if part.size:
            v, u = rows.start - v0, columns.start - u0
            result[:, v : v + part.shape[1], u : u + part.shape[2]] = part
    return result


def _corner(spot: SpotRow) -> tuple[int, int] | None:
    if not np.isfinite(spot.u_px):
        return None
    return round(spot.u_px) - _CROP_PX // 2, round(spot.v_px) - _CROP_PX // 2


def _enlarged(picture: Picture, spot: SpotRow) -> Picture:
    image = Image.fromarray(np.kron(picture, np.ones((_ZOOM, _ZOOM, 1), np.uint8)))
    corner = _corner(spot)
    if corner is not None:
        u, v = ((x - x0 + 0.5) * _ZOOM for x, x0 in zip((spot.u_px, spot.v_px), corner, strict=True))
        _cross(ImageDraw.Draw(image), u, v, 2.5 * _ZOOM, 6.0 * _ZOOM)
    return np.asarray(image)


def _cross(draw: ImageDraw.ImageDraw, u: float, v: float, inner: float, outer: float) -> None:
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        draw.line((u + du * inner, v + dv * inner, u + du * outer, v + dv * outer), fill=_MARK)
