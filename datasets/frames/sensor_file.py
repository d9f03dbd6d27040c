"""Sensor files, written and read: the numbers of one camera in TOML, with their sigmas.

`phibench sensor fit` writes them, and people may write them by hand::

    preset = "bayer-raw"          # the preset that all other numbers are taken from
    gain_dn_per_e = 0.0812        # any number of the sensor, by its name in `render.sensor.settings.Sensor`
    read_noise_e = 3.7

    [sigma]                       # standard deviation of a number above
    gain_dn_per_e = 0.0002

    [findings]                    # what of the frames does not agree with this kind of sensor
    photon_transfer = "a straight line does not fit: ..."

    [assumed]                     # numbers above that the frames do not tell, and what stands for them
    full_well_e = "no level of flat/ is saturated; set beyond the last code, where it changes nothing"

    [not_determined]              # numbers that keep the preset's value, and why
    dark_e_per_s = "no dark-exposure/SECONDS"

    [measured.edge_sigma_px]      # what is no number of the sensor's chain
    value = 0.71
    sigma = 0.01
    unit = "px"

Tables are optional; the chain takes the numbers above them alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import Field

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES, InputFile
from phibench.datasets.store.files import write_text
from phibench.datasets.store.schema import Document
from phibench.render.sensor.settings import Sensor, SensorError, sensor
from phibench.scenes.validation import structural_faults

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
