"""Page about a sensor fit: the numbers with their sigmas, what was not determined, and plots. Markdown or HTML."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from phibench.calibration.sensor_fit.capture_folder import CaptureError
from phibench.calibration.sensor_fit.fit_sensor import SensorFit
from phibench.calibration.sensor_fit.noise_levels import encoded_by
from phibench.datasets.common.shown_text import html_text, markdown_cell, markdown_text, table_lines
from phibench.datasets.store.files import write_bytes, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SUFFIXES = (".html", ".md")


def require_page(path: Path) -> Path:
    """Path of a page.

    Raises
    ------
    CaptureError
        If its ending is neither .html nor .md.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise CaptureError(f"{path}: a page ends in .html or .md")
    return path


def write_page(path: Path, found: SensorFit) -> Path:
    """Write the page; plots are in an HTML page, and beside a Markdown page as PNG."""
    rows = numbers_of(found)
    plot = _plots(found)
    if path.suffix.lower() == ".md":
        source = (f"* {markdown_text(line)}" for line in _source_lines(found))
        lines = ["# Sensor fit", "", *source, ""]
        lines += table_lines(("number", "value", "sigma"), [tuple(map(markdown_cell, row)) for row in rows])
        lines += ["", *(f"* {markdown_text(said)}" for said in remarks_of(found))]
        if plot is not None:
            picture = path.with_suffix(".png")
            write_bytes(picture, plot)
            lines += ["", f"![Plots of the fit]({picture.name})"]
        return write_text(path, "\n".join(lines) + "\n")
    return write_text(path, _html(found, rows, plot))


def numbers_of(found: SensorFit) -> list[tuple[str, str, str]]:
    """Name, value, sigma of every number that was found, as text."""
    tables = found.file.tables
    rows = []
    for name, value in found.file.numbers.items():
        sigma = tables.sigma.get(name)
        rows.append((name, _text(value), _sigma(sigma)))
    for name, measured in tables.measured.items():
        sigma_text = _sigma(measured.sigma) if measured.sigma != 0.0 else ""
        unit = "" if measured.unit == "1" else f" {measured.unit}"
        rows.append((f"measured {name}", f"{_text(measured.value)}{unit}", sigma_text))
    return rows


def remarks_of(found: SensorFit) -> list[str]:
    """Sentences beside the numbers: findings, numbers that are assumed, and those not determined."""
    tables = found.file.tables
    return [
        *(f"finding, {name}: {said}" for name, said in tables.findings.items()),
        *(f"{name}: assumed: {why}" for name, why in tables.assumed.items()),
        *(f"{name}: not determined from these frames: {why}" for name, why in tables.not_determined.items()),
    ]


def _sigma(sigma: float | list[float] | None) -> str:
    if sigma is None:
        return ""
    return ", ".join(f"{one:.2g}" for one in sigma) if isinstance(sigma, list) else f"{sigma:.2g}"


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"{len(value)} values" if len(value) > 4 else ", ".join(_text(one) for one in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _source_lines(found: SensorFit) -> list[str]:
    return [f"{name}: {value}" for name, value in found.file.tables.source.items()]


def _html(found: SensorFit, rows: list[tuple[str, str, str]], plot: bytes | None) -> str:
    cells = "".join("<tr>" + "".join(f"<td>{html_text(x)}</td>" for x in row) + "</tr>\n" for row in rows)
    missing = "".join(f"<li>{html_text(said)}</li>\n" for said in remarks_of(found))
    source = "".join(f"<li>{html_text(line)}</li>" for line in _source_lines(found))
    image = "" if plot is None else f'<img alt="plots" src="data:image/png;base64,{base64.b64encode(plot).decode()}">'
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Sensor fit</title>\n'
        "<style>body{font-family:sans-serif;max-width:60em;margin:2em auto}td{padding:0 1em 0 0}</style></head>\n"
        f"<body><h1>Sensor fit</h1><ul>{source}</ul>\n<table><tr><th>number</th><th>value</th><th>sigma</th></tr>\n"
        f"{cells}</table>\n<ul>{missing}</ul>\n{image}</body></html>\n"
    )


# -- plots -----------------------------------------------------------------------------------------------------------


def _plots(found: SensorFit) -> bytes | None:
    """PNG of all plots that the fit gives; None without any."""
    from matplotlib.figure import Figure

    panels = [
        draw
        for part, draw in (
            (found.transfer, _draw_transfer),
            (found.tone, _draw_tone),
            (found.noise if found.noise is not None and found.noise.values else None, _draw_noise),
            (found.edges, _draw_edge),
        )
        if part is not None
    ]
    if not panels:
        return None
    figure = Figure(figsize=(5.0 * len(panels), 3.6), layout="constrained")
    for axes, draw in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        draw(axes, found)
    file = io.BytesIO()
    # no date and version in the file: same input, same bytes
    figure.savefig(file, format="png", dpi=100, metadata={"Software": None})
    return file.getvalue()


def _draw_transfer(axes: Axes, found: SensorFit) -> None:
    assert found.transfer is not None
    points = found.transfer.points
    for site in dict.fromkeys(point.site for point in points):
        own = [point for point in points if point.site == site]
        axes.loglog([p.signal_dn for p in own], [max(p.variance_dn2, 1e-3) for p in own], ".", label=site)
    response = found.transfer.response
    gain = float(response.gain[0])
    signal: Any = np.geomspace(max(min(p.signal_dn for p in points), 1.0), max(p.signal_dn for p in points), 100)
    axes.loglog(signal, gain * signal, "k-", lw=0.8, label=f"K = {gain:.4g} DN/e-")
    if response.is_bent:
        inside = signal[signal <= response.reach_dn]
        noise = [gain * float(response.linear(y) / response.slope(y) ** 2) for y in inside]
        axes.loglog(inside, noise, "k--", lw=0.8, label="bent response")
    axes.set(xlabel="signal, DN", ylabel="temporal variance less the dark's, DN$^2$", title="Photon transfer")
    axes.legend(fontsize=8)


def _draw_tone(axes: Axes, found: SensorFit) -> None:
    assert found.tone is not None
    tone = found.tone
    fine = np.linspace(0.0, 1.0, 200)
    axes.plot(np.array(tone.seconds) / tone.white_s, tone.codes, "k.")
    axes.plot(fine, encoded_by(tone.curve, fine, tone.points), "C0-", lw=0.8, label=tone.curve)
    axes.set(xlabel="exposure time / time of white", ylabel="code", title="Tone curve")
    axes.legend(fontsize=8)


def _draw_noise(axes: Axes, found: SensorFit) -> None:
    assert found.noise is not None
    levels = found.noise.levels
    codes = [level.codes[1] for level in levels]
    main = "Y'" if found.capture.kind == "yuyv" else "R"
    covariances = [level.planes[0].covariance[0] for level in levels]
    axes.plot(codes, [np.sqrt(max(float(covariance[0]), 0.0)) for covariance in covariances], "k.-", label="rms, codes")
    for column, label in ((1, "correlation beside"), (2, "correlation below")):
        axes.plot(codes, [float(covariance[column] / covariance[0]) for covariance in covariances], label=label)
    axes.set(xlabel="green code", title=f"Noise of {main}")
    axes.legend(fontsize=8)


def _draw_edge(axes: Axes, found: SensorFit) -> None:
    assert found.edges is not None
    axes.plot(*found.edges.profile, "k.-", lw=0.8)
    axes.set(xlabel="distance, px", ylabel="share of the step", title=f"Edge spread, {found.edges.edges} edges")
