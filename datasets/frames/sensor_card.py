"""Sensor card (a sensor's numbers that an estimator may know), and reader and writer of measured sensor files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.store.files import write_text
from phibench.datasets.store.schema import Document
from phibench.render.sensor.settings import Sensor, SensorError, sensor
from phibench.scenes.validation import structural_faults


@dataclass(frozen=True)
class SensorCard:
    """Numbers of one sensor, as `render.sensor.settings.Sensor` defines them.

    Attributes
    ----------
    name : str
    mosaic : "bayer" (RGGB, red at even row and even column) or "mono"
    exposure_s : float
    shot_noise : bool
    full_well_e, read_noise_e, row_noise_e, dsnu_e : float, electrons
    prnu : float, relative
    dark_e_per_s : float
    dn_per_e : float
        Overall system gain K, analogue gain included.
    black_level_dn : float
    top_dn : int
        Largest code.
    output : "electrons", "raw", "srgb8", "yuyv" or "mjpeg"
        Stage after which the chain ends.
    white_balance : 3 floats
        Gains of R, G, B on linear planes.
    colour_matrix : 3 x 3
        Rows give linear sRGB from white-balanced R, G, B.
    sharpen_amount : float
        Gain of the unsharp mask x + amount (x - blur x), blur (1 2 1)/4 along both axes, after the tone curve.
    jpeg_quality : int
        libjpeg's quality.
    jpeg_subsampling : "4:4:4", "4:2:2" or "4:2:0"
    jpeg_qtables : two tables of 64 steps, row by row, or None
        Of luma and chroma, in place of the quality.
    transfer_function : "srgb", "rec709" or "table"
        Tone curve from linear to encoded R, G, B.
    transfer_points : pairs (linear, encoded), or None
        Of "table"; straight lines join them.
    denoise_luma, denoise_chroma : float
        Share d of the blur in x + d (blur x - x), on Y' and on Cb, Cr, after the unsharp mask.
    denoise_reach_px : int
        Of the blur in Y': 1 is (1 2 1)/4, 2 is (1 4 6 4 1)/16.
    denoise_vertical : float
        Share v of that blur along columns: v (blur) + (1 - v) (no blur).
    denoise_threshold_codes : float or None
        T: a difference d of Y' counts as d exp(-d^2 / 2 T^2) in the blur; as d if T is None.
    ycbcr_range : "full" or "limited"
        Of "yuyv", BT.601: Y' on 0 to 255, or on 16 to 235.
    chroma_taps : 3 floats
        Of "yuyv": weights of columns 2k - 1, 2k and 2k + 1 in chroma sample k.
    mosaic_phase : (du, dv)
        Red of a processed image lies where u + du and v + dv are even: a sensor that is read out mirrored has 1 for 0.
    """

    name: str
    mosaic: Literal["bayer", "mono"]
    exposure_s: float
    shot_noise: bool
    full_well_e: float
    read_noise_e: float
    row_noise_e: float
    prnu: float
    dsnu_e: float
    dark_e_per_s: float
    dn_per_e: float
    black_level_dn: float
    top_dn: int
    output: Literal["electrons", "raw", "srgb8", "yuyv", "mjpeg"]
    white_balance: tuple[float, float, float]
    colour_matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    sharpen_amount: float
    jpeg_quality: int
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"]
    jpeg_qtables: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    transfer_function: Literal["srgb", "rec709", "table"] = "srgb"
    transfer_points: tuple[tuple[float, float], ...] | None = None
    denoise_luma: float = 0.0
    denoise_chroma: float = 0.0
    denoise_reach_px: int = 1
    denoise_vertical: float = 1.0
    denoise_threshold_codes: float | None = None
    ycbcr_range: Literal["full", "limited"] = "full"
    chroma_taps: tuple[float, float, float] = (0.25, 0.5, 0.25)
    mosaic_phase: tuple[int, int] = (0, 0)

    @property
    def saturation_e(self) -> float:
        """Electrons at which a pixel carries no more information: full well or last code, whichever comes first."""
        return min(self.full_well_e, (self.top_dn - 0.5 - self.black_level_dn) / self.dn_per_e)

    @property
    def full_from_e(self) -> float:
        """Reading, electrons, from which on a pixel may be full, though noise that is added later hides it.

        5 deviations of read noise and DSNU, and half a code, below the full well; and as far below the last code. The
        well may lie there, too, when frames have not shown where it is, and a full pixel then reads a code less.
        """
        return min(self.full_well_e - 0.5 / self.dn_per_e, self.saturation_e) - 5.0 * math.hypot(
            self.read_noise_e, self.dsnu_e
        )


def sensor_card(preset: str = "bayer-raw", **changes: Any) -> SensorCard:
    """Card of a preset, with changes: ``sensor_card("mono-raw", analogue_gain=4.0)``.

    Raises
    ------
    SensorError
        If there is no such preset, or a change is not allowed.
    """
    return card_of(sensor(preset, **changes))


def card_of(s: Sensor) -> SensorCard:
    """Card of a sensor."""
    return SensorCard(**{name: getattr(s, name) for name in SensorCard.__dataclass_fields__ if name != "mosaic_phase"})


# Sensor file: numbers of one camera in TOML, as `phibench sensor fit` writes them and people may write them by hand.
#
# preset = "bayer-raw"          # the preset that all other numbers are taken from
# gain_dn_per_e = 0.0812        # any number of the sensor, by its name in `render.sensor.settings.Sensor`
# read_noise_e = 3.7
#
# [sigma]                       # standard deviation of a number above
# gain_dn_per_e = 0.0002
#
# [findings]                    # what of the frames does not agree with this kind of sensor
# photon_transfer = "a straight line does not fit: ..."
#
# [assumed]                     # numbers above that the frames do not tell, and what stands for them
# full_well_e = "no level of flat/ is saturated; set beyond the last code, where it changes nothing"
#
# [not_determined]              # numbers that keep the preset's value, and why
# dark_e_per_s = "no dark-exposure/SECONDS"
#
# [measured.edge_sigma_px]      # what is no number of the sensor's chain
# value = 0.71
# sigma = 0.01
# unit = "px"
#
# Tables are optional; the chain takes the numbers above them alone.


_OF_ONE_CAPTURE = ("name", "exposure_s", "output")  # of frames, not of the camera


class MeasuredQuantity(Document):
    """One measured quantity that is no number of the chain.

    `value` is a number or a list of numbers; `sigma` has its shape, or is one number for all.
    """

    value: float | list[float]
    sigma: float | list[float] | None = None
    unit: str = "1"


class FitTables(Document):
    """Tables of a sensor file beside the numbers."""

    findings: dict[str, str] = Field(default_factory=dict)
    sigma: dict[str, float | list[float]] = Field(default_factory=dict)
    assumed: dict[str, str] = Field(default_factory=dict)
    not_determined: dict[str, str] = Field(default_factory=dict)
    measured: dict[str, MeasuredQuantity] = Field(default_factory=dict)
    source: dict[str, str | float | int] = Field(default_factory=dict)


@dataclass(frozen=True)
class SensorFile:
    """Content of a sensor file.

    Attributes
    ----------
    preset : str
        Preset that all other numbers are taken from.
    numbers : mapping
        Numbers of the sensor that differ from the preset's; neither `exposure_s` nor `output`.
    tables : FitTables
        Sigmas, what was not determined, other measured quantities, and where the frames came from.
    """

    preset: str
    numbers: Mapping[str, Any]
    tables: FitTables = field(default_factory=FitTables)

    def sensor(self, preset: str | None = None, **changes: Any) -> Sensor:
        """Sensor of the file, its chain ending where `preset` ends; by default the file's own preset.

        Raises
        ------
        SensorError
            If the numbers contradict each other, or a change is not allowed.
        """
        return sensor(preset or self.preset, **{**self.numbers, **changes})

    def text(self) -> str:
        """TOML of the file."""
        lines = [f"preset = {json.dumps(self.preset)}", *_lines(self.numbers)]
        tables = self.tables.model_dump(exclude_none=True)
        measured = tables.pop("measured")
        for name, table in tables.items():
            if table:
                lines += ["", f"[{name}]", *_lines(table)]
        for name, table in measured.items():
            lines += ["", f"[measured.{name}]", *_lines(table)]
        return "\n".join(lines) + "\n"


def read_sensor_file(path: str | Path) -> SensorFile:
    """Sensor file, checked.

    Raises
    ------
    DatasetError
        If it cannot be read, or its numbers are none of a sensor; in one sentence.
    """
    file = InputFile(Path(path), "docs/capture.md has an example", limit_bytes=SETTINGS_BYTES)
    document = file.toml()
    if "rig" in document:
        raise file.fault("is a rig file: give it with --rig")
    if document.keys() & {"format", "bits", "width_px", "height_px"}:
        raise file.fault("describes frames, not a sensor: `phibench sensor fit` makes a sensor file of their folder")
    if isinstance(document.get("sensor"), dict):
        raise file.fault("has a table [sensor]: write its keys above all tables, without that line")
    tables = file.validated(FitTables, {key: document.pop(key) for key in FitTables.model_fields if key in document})
    preset = document.pop("preset", "mjpeg")
    if not isinstance(preset, str):
        raise file.fault("has a preset that is no text")
    if wrong := [key for key in _OF_ONE_CAPTURE if key in document]:
        raise file.fault(f"has the key {wrong[0]}, which belongs to a frame and not to a camera; leave it out")
    try:
        content = SensorFile(preset, document, tables)
        content.sensor()
    except SensorError as error:
        raise file.fault(f"is no sensor: {error}") from error
    return content


def write_sensor_file(path: Path, content: SensorFile) -> Path:
    """Write a sensor file, atomically, after checking that it can be read.

    Raises
    ------
    DatasetError
        If a number is out of the range of the sensor; the message says which.
    """
    try:
        content.sensor()
    except SensorError as error:
        raise DatasetError(f"the numbers found make no sensor: {error}") from error
    return write_text(path, content.text())


def allowed_numbers(preset: str, numbers: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Numbers that a sensor may have, and for each of the others the reason why not."""
    kept: dict[str, Any] = {}
    refused: dict[str, str] = {}
    base = sensor(preset).model_dump(exclude_none=True)
    for key, value in numbers.items():
        faults = structural_faults(Sensor, {**base, key: value})
        if faults:
            refused[key] = str(faults[0])
        else:
            kept[key] = value
    return kept, refused


def with_numbers(content: SensorFile, **numbers: Any) -> SensorFile:
    """The file with other numbers besides its own."""
    return replace(content, numbers={**content.numbers, **numbers})


def _lines(table: Mapping[str, Any]) -> list[str]:
    # JSON's texts, numbers and lists are TOML's
    return [f"{key} = {json.dumps(value)}" for key, value in table.items()]
