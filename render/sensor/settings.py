"""Settings of a sensor (`Sensor`), checked (`SensorError`); named presets of `settings_presets.toml`, with changes.

Terms of EMVA 1288. The layers are photo-electrons: the quantum efficiency comes before them (`scenes/camera.py`), and a
photon count cannot be told from here. K = `gain_dn_per_e` x `analogue_gain` is the overall system gain in DN/e-. The
dark signal is `black_level_dn` + K x (dark electrons + DSNU). PRNU is a spread of the responsivity from pixel to pixel:
it multiplies the mean of the photo-electrons, before the Poisson draw. Y'CbCr is that of ITU-R BT.601; ranges and
transfer functions have the names that V4L2 gives them.
"""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from phibench.scenes.validation import nearest, shipped_tables, structural_faults

PRESETS_FILE = Path(__file__).with_name("settings_presets.toml")
_UNIT_SUM = 1e-6  # of weights that were written with six digits


class SensorError(ValueError):
    """A sensor, region or exposure that cannot be; the message is one sentence for the person at the terminal."""


def _tuples(value: object) -> object:
    """Tuples for the lists of a TOML file: a frozen table holds nothing that can be changed."""
    return tuple(_tuples(part) for part in value) if isinstance(value, list) else value


Weight = Annotated[float, Field(ge=0.0, le=100.0)]
Weights = Annotated[tuple[Weight, Weight, Weight], BeforeValidator(_tuples)]
Coefficient = Annotated[float, Field(ge=-100.0, le=100.0)]
Row = tuple[Coefficient, Coefficient, Coefficient]
Matrix = Annotated[tuple[Row, Row, Row], BeforeValidator(_tuples)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Taps = Annotated[tuple[Share, Share, Share], BeforeValidator(_tuples)]
Points = Annotated[
    tuple[tuple[Share, Share], ...], BeforeValidator(_tuples), Field(min_length=2, max_length=1024)
]  # rising in both columns
Table = Annotated[tuple[int, ...], Field(min_length=64, max_length=64)]
Tables = Annotated[tuple[Table, Table], BeforeValidator(_tuples)]


class Sensor(BaseModel):
    """One sensor with its processing; every key that has a unit says it in its name.

    Use `sensor(name)` for a preset and `Sensor.replace` for a changed one.
    """

    # its validator is built at first use: a method's process imports it, and takes a card that is made
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    name: str = Field(description="name of the preset")
    output: Literal["electrons", "raw", "srgb8", "yuyv", "mjpeg"] = Field(
        description="stage after which the chain ends"
    )
    mosaic: Literal["bayer", "mono"] = Field(description="RGGB colour filters, or none")
    mono_weights: Weights = Field(description="weight of the planes R, G, B in a pixel without filter")
    exposure_s: float = Field(gt=0.0, le=10.0, description="exposure time, seconds")
    f_number: float | None = Field(
        default=None, ge=0.5, le=256.0, description="lens stop; the layers' own if not given"
    )
    analogue_gain: float = Field(ge=1.0, le=16.0, description="gain before the converter")
    vignetting_exponent: float = Field(ge=0.0, le=8.0, description="n of an extra cos^n fall-off")
    speckle_m: float | None = Field(
        default=None, ge=1.0, le=6.0, description="speckles in the pupil; flicker variance 1/M"
    )
    shot_noise: bool = Field(description="Poisson statistics of photo-electrons and dark electrons")
    full_well_e: float = Field(gt=0.0, le=1e7, description="full well, electrons")
    read_noise_e: float = Field(ge=0.0, le=1e4, description="rms per pixel and read-out, electrons")
    row_noise_e: float = Field(ge=0.0, le=1e4, description="rms per row and read-out, electrons")
    prnu: float = Field(ge=0.0, le=0.2, description="relative spread of the responsivity")
    dsnu_e: float = Field(ge=0.0, le=1e4, description="spread of the dark offset, electrons")
    dark_e_per_s: float = Field(ge=0.0, le=1e6, description="dark current, electrons per second and pixel")
    gain_dn_per_e: float = Field(gt=0.0, le=1e4, description="system gain at analogue gain 1, DN per electron")
    adc_bits: int = Field(ge=4, le=16, description="bits of the converter")
    black_level_dn: float = Field(ge=0.0, le=65535.0, description="DN of a pixel without electrons")
    white_balance: Weights = Field(description="gains of R, G, B")
    colour_matrix: Matrix = Field(description="rows give linear sRGB from white-balanced R, G, B")
    transfer_function: Literal["srgb", "rec709", "table"] = Field(description="tone curve: linear to encoded R, G, B")
    transfer_points: Points | None = Field(
        default=None, description="with 'table': (linear, encoded) pairs that straight lines join"
    )
    sharpen_amount: float = Field(ge=0.0, le=4.0, description="gain of the unsharp mask")
    denoise_luma: float = Field(ge=0.0, le=1.0, description="share of a binomial blur in Y'")
    denoise_reach_px: int = Field(ge=1, le=2, description="reach of that blur: 1 is 3 x 3, 2 is 5 x 5")
    denoise_vertical: float = Field(ge=0.0, le=1.0, description="share of that blur from row to row; 0 is rows only")
    denoise_threshold_codes: float | None = Field(
        default=None,
        ge=1.0,
        le=1000.0,
        description="differences of Y' far above are edges, which that blur spares; none is spared if not given",
    )
    denoise_chroma: float = Field(ge=0.0, le=1.0, description="share of the 3 x 3 binomial blur in Cb and Cr")
    ycbcr_range: Literal["full", "limited"] = Field(description="quantisation range of the output 'yuyv'")
    chroma_taps: Taps = Field(description="weights of columns 2k - 1, 2k, 2k + 1 in chroma sample k of 'yuyv'")
    jpeg_quality: int = Field(ge=1, le=100, description="libjpeg's quality")
    jpeg_qtables: Tables | None = Field(
        default=None, description="luma's and chroma's 64 steps row by row, in place of jpeg_quality"
    )
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = Field(description="chroma of the JPEG")
    jpeg_restart_interval: int = Field(ge=0, le=65535, description="units between restart markers; 0 is none")
    readout_s: float = Field(ge=0.0, le=1.0, description="rolling shutter, first row to last; 0 is a global shutter")
    auto_exposure_level: float = Field(gt=0.0, lt=255.0, description="mean 8-bit luma that auto exposure aims at")
    exposure_min_s: float = Field(gt=0.0, le=10.0, description="shortest automatic exposure")
    exposure_max_s: float = Field(gt=0.0, le=10.0, description="longest automatic exposure")
    gain_max: float = Field(ge=1.0, le=16.0, description="largest automatic gain")

    @property
    def dn_per_e(self) -> float:
        """Overall system gain K, DN per electron, analogue gain included."""
        return self.gain_dn_per_e * self.analogue_gain

    @property
    def top_dn(self) -> int:
        """Largest code of the converter."""
        return (1 << self.adc_bits) - 1

    def replace(self, **changes: Any) -> Sensor:
        """Return a changed copy, checked like a new one.

        Raises
        ------
        SensorError
            If a key is unknown or a value is not allowed.
        """
        return _checked(self.name, {**self.model_dump(exclude_none=True), **changes})


def sensor(preset: str = "mjpeg", **changes: Any) -> Sensor:
    """A preset, with changes: ``sensor("mjpeg", exposure_s=0.01)``.

    Raises
    ------
    SensorError
        If there is no such preset, or a change is not allowed.
    """
    tables = _tables()
    if preset not in tables["presets"]:
        raise SensorError(f"no sensor preset '{preset}'; {nearest(preset, tables['presets'])}")
    # what comes later wins: the camera's numbers, the preset's, the caller's
    return _checked(preset, {"name": preset, **tables["webcam"], **tables["presets"][preset], **changes})


def preset_outputs() -> dict[str, str]:
    """Output of every preset, by name."""
    tables = _tables()
    return {name: str({**tables["webcam"], **table}["output"]) for name, table in tables["presets"].items()}


class PresetsFile(BaseModel):
    """Content of `settings_presets.toml`; the numbers of a preset are checked when it is asked for."""

    model_config = ConfigDict(strict=True, extra="forbid", defer_build=True)

    webcam: dict[str, Any] = Field(description="what all presets share")
    presets: dict[str, dict[str, Any]] = Field(description="what each preset changes")


def _tables() -> dict[str, Any]:
    return _read(PRESETS_FILE)


@cache
def _read(path: Path) -> dict[str, Any]:
    tables = shipped_tables(path)
    if faults := structural_faults(PresetsFile, tables):
        raise SensorError(f"{path}: " + "; ".join(map(str, faults)))
    return tables


def _checked(name: str, raw: dict[str, Any]) -> Sensor:
    faults = [str(fault) for fault in structural_faults(Sensor, raw)]
    faults = faults or _faults(Sensor.model_validate(raw))
    if faults:
        raise SensorError(f"sensor preset '{name}': " + "; ".join(faults))
    return Sensor.model_validate(raw)


def _faults(s: Sensor) -> list[str]:
    """Faults that no single key shows."""
    faults = []
    if s.black_level_dn >= s.top_dn:
        faults.append(
            f"black_level_dn = {s.black_level_dn:g}: must be below {s.top_dn}, the largest of {s.adc_bits} bits"
        )
    elif s.full_well_e * s.dn_per_e <= s.black_level_dn:
        faults.append(
            f"full_well_e = {s.full_well_e:g} gives {s.full_well_e * s.dn_per_e:.4g} DN, not above black_level_dn = "
            f"{s.black_level_dn:g}: raise full_well_e or gain_dn_per_e"
        )
    faults += _transfer_faults(s)
    if bad := [step for table in s.jpeg_qtables or () for step in table if not 1 <= step <= 255]:
        faults.append(f"jpeg_qtables hold {bad[0]}: steps must be whole numbers from 1 to 255")
    if abs(sum(s.chroma_taps) - 1.0) > _UNIT_SUM:
        faults.append(f"chroma_taps = {s.chroma_taps}: must add up to 1, not {sum(s.chroma_taps):g}")
    if s.exposure_min_s > s.exposure_max_s:
        faults.append(f"exposure_min_s = {s.exposure_min_s:g}: must not be above exposure_max_s = {s.exposure_max_s:g}")
    return faults


def _transfer_faults(s: Sensor) -> list[str]:
    """Faults of a measured transfer function."""
    points = s.transfer_points
    if points is None:
        missing = "transfer_function = 'table': give the measured curve, transfer_points = [[linear, encoded], ...]"
        return [missing] if s.transfer_function == "table" else []
    if s.transfer_function != "table":
        return [f"transfer_points: only for transfer_function = 'table', not '{s.transfer_function}'"]
    if (points[0][0], points[-1]) != (0.0, (1.0, 1.0)):
        return [f"transfer_points go from {points[0]} to {points[-1]}: must go from [0, y] to [1, 1]"]
    for k, (one, two) in enumerate(itertools.pairwise(points)):
        if not (two[0] > one[0] and two[1] > one[1]):
            return [f"transfer_points {k + 1} and {k + 2}, {one} and {two}: both columns must rise from point to point"]
    return []
