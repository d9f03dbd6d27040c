"""Fit of a sensor from a folder of its frames: everything that these frames tell, and what they do not.

Raw frames give photon transfer. Every number comes with its sigma; numbers of the preset that the frames leave open
stand in `not_determined` with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from phibench.datasets.frames.sensor_file import FitTables, Measured, SensorFile, allowed_numbers
from phibench.estimator.sensor_fit.capture_folder import RAW, Capture, open_capture
from phibench.estimator.sensor_fit.photon_transfer import TransferFit, fit_transfer

_FRAMES_ONLY = "not determined from these frames"


@dataclass(frozen=True)
class SensorFit:
    """Result of a fit.

    Attributes
    ----------
    capture : Capture
    file : SensorFile
    transfer : TransferFit or None
        Of raw frames.
    """

    capture: Capture
    file: SensorFile
    transfer: TransferFit | None = None


@dataclass
class _Draft:
    """Sensor file in the making."""

    numbers: dict[str, object] = field(default_factory=dict)
    sigma: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    measured: dict[str, Measured] = field(default_factory=dict)

    def take(self, name: str, value: object, sigma: float | None) -> None:
        self.numbers[name] = value
        if sigma is not None:
            self.sigma[name] = sigma

    def file(self, capture: Capture) -> SensorFile:
        kept, refused = allowed_numbers(capture.kind, self.numbers)
        missing = dict(sorted(self.missing.items()))
        missing |= {name: f"{_FRAMES_ONLY}: {why}" for name, why in refused.items()}
        sigma = {name: value for name, value in self.sigma.items() if name in kept}
        source: dict[str, str | float | int] = {
            "frames": capture.frames,
            "format": capture.kind,
            "width_px": capture.size[1],
            "height_px": capture.size[0],
        }
        if capture.notes.camera:
            source["camera"] = capture.notes.camera
        tables = FitTables(sigma=sigma, not_determined=missing, measured=self.measured, source=source)
        return SensorFile(capture.kind, kept, tables)


def fit_sensor(folder: Path) -> SensorFit:
    """Fit the frames of a folder; see `capture_folder` for its layout.

    Raises
    ------
    CaptureError
        If the folder or its frames will not do; in one sentence.
    """
    capture = open_capture(folder)
    draft = _Draft()
    transfer = None
    if capture.kind in RAW:
        transfer = fit_transfer(capture)
        _take_transfer(draft, capture, transfer)
    return SensorFit(capture, draft.file(capture), transfer)


def _take_transfer(draft: _Draft, capture: Capture, found: TransferFit) -> None:
    top = (1 << capture.notes.bits) - 1
    draft.take("adc_bits", capture.notes.bits, None)
    for name, value in found.values.items():
        draft.take(name, value, found.sigmas[name])
    draft.missing |= found.reasons
    if "full_well_e" not in found.values:
        # the chain needs a number: one beyond the converter's end changes nothing
        end_e = (top - found.values["black_level_dn"]) / found.values["gain_dn_per_e"] / capture.notes.analogue_gain
        draft.take("full_well_e", round(1.05 * end_e), None)
    if "row_noise_e" not in found.values and "row_noise_e" not in found.reasons:
        draft.missing["row_noise_e"] = "not above the noise of these frames"
    if found.ratios:
        draft.measured["flat_red_green_blue"] = Measured(value=list(found.ratios))
