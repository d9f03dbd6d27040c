"""Settings of a sensor: one strict, frozen table per preset, from `settings_presets.toml`.

Terms of EMVA 1288. The layers are photo-electrons: the quantum efficiency comes before them (`scenes/camera.py`), and a
photon count cannot be told from here. K = `gain_dn_per_e` x `analogue_gain` is the overall system gain in DN/e-. The
dark signal is `black_level_dn` + K x (dark electrons + DSNU). PRNU is a spread of the responsivity from pixel to pixel:
it multiplies the mean of the photo-electrons, before the Poisson draw.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from phibench.scenes.validation import nearest, structural_faults

PRESETS_FILE = Path(__file__).with_name("settings_presets.toml")


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


class Sensor(BaseModel):
    """One sensor with its processing; every key that has a unit says it in its name.

    Use `sensor(name)` for a preset and `Sensor.replace` for a changed one.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    name: str = Field(description="name of the preset")
    output: Literal["electrons", "raw", "srgb8", "mjpeg"] = Field(description="stage after which the chain ends")
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
    sharpen_amount: float = Field(ge=0.0, le=4.0, description="gain of the unsharp mask")
    jpeg_quality: int = Field(ge=1, le=100, description="libjpeg's quality")
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = Field(description="chroma of the JPEG")
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


def preset_names() -> tuple[str, ...]:
    """Names of the shipped presets."""
    return tuple(_tables()["presets"])


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


def _tables() -> dict[str, Any]:
    return tomllib.loads(PRESETS_FILE.read_text(encoding="utf-8"))


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
    if s.exposure_min_s > s.exposure_max_s:
        faults.append(f"exposure_min_s = {s.exposure_min_s:g}: must not be above exposure_max_s = {s.exposure_max_s:g}")
    return faults
