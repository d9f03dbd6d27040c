"""Calibration files, written and read: corrections of a rig with covariance and source, as strict, versioned JSON.

Version 2 is written. Version 1 is read: it says `believed_rig` for `nominal_rig`, has four other names of parameters
(`rig_parameters.RENAMED`), and gives the focal length in pixels.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from phibench.calibration.rig.bundle import Bundle
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import MIB, InputFile
from phibench.datasets.store.files import write_text
from phibench.datasets.store.json_forms import from_json, same_document, to_json
from phibench.estimator.geometry.rig_parameters import PARAMETERS, RENAMED, changed_rig
from phibench.scenes.frames import IDENTITY, Array
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError, printable_line

VERSION = 2
_OF_SPHERES = tuple(name for name in PARAMETERS if name not in OF_REVOLVED)
"""Parameters of files from before mirrors of other shapes were calibrated; the others meant nothing then."""


class CalibrationError(DatasetError):
    """A calibration that cannot be read or does not belong here; one sentence for the person at the terminal."""


class CalibrationDocument(BaseModel):
    """The file. `sha256` is that of all other fields, as compact JSON with sorted keys."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["phibench calibration"]
    version: int
    parameters: list[str]
    values: list[float]
    covariance: list[list[float]]
    rig: dict[str, Any]
    nominal_rig: dict[str, Any]
    made_from: dict[str, Any]
    chi2: float
    degrees: int
    sha256: str


@dataclass(frozen=True)
class Calibration:
    """A calibrated rig.

    Attributes
    ----------
    rig : Rig
        Corrected; strokes are corrected by `rig_parameters.stroke_of(stroke_m, values)`.
    nominal : Rig
        What it was before.
    parameters : tuple of str
        Names of `values` and `covariance`: `PARAMETERS`.
    values : shape (p,), deviations from the nominal rig
    covariance : shape (p, p)
    made_from : what the file says of its images
    sha256 : of the file's content
    """

    rig: Rig
    nominal: Rig
    parameters: tuple[str, ...]
    values: Array = field(repr=False)
    covariance: Array = field(repr=False)
    made_from: dict[str, Any] = field(repr=False)
    sha256: str = ""


def write_calibration(path: Path, bundle: Bundle, nominal: Rig, made_from: dict[str, Any]) -> Path:
    """Write a calibration, atomically; `made_from` says in JSON what it was made from."""
    content = {
        "kind": "phibench calibration",
        "version": VERSION,
        "parameters": list(PARAMETERS),
        "values": bundle.values.tolist(),
        "covariance": bundle.covariance.tolist(),
        "rig": to_json(bundle.rig),
        "nominal_rig": to_json(nominal),
        "made_from": made_from,
        "chi2": bundle.chi2,
        "degrees": bundle.degrees,
    }
    return write_text(path, json.dumps({**content, "sha256": _digest(content)}, indent=1, allow_nan=False) + "\n")


def read_calibration(path: str | Path, nominal: Rig | None = None) -> Calibration:
    """Read a calibration.

    Parameters
    ----------
    path : path of the file
    nominal : Rig, optional
        The rig that is to be corrected: the calibration must have started from it.

    Raises
    ------
    CalibrationError
        If the file is missing, of another version, damaged, or of another rig.
    """
    path = Path(path)
    data = _file(path).read()
    if data.lstrip()[:1] != b"{":
        raise CalibrationError(
            f"{path} is no calibration, which is JSON that `phibench calibrate` writes; give a rig file with --rig, "
            "and a sensor file with --sensor"
        )
    raw = _file(path).json(data)
    if raw.get("kind") != "phibench calibration":
        raise CalibrationError(f"{path} is not a calibration: make one with `phibench calibrate`")
    if raw.get("version") not in (1, VERSION):
        version = printable_line(str(raw.get("version")), 60)
        raise CalibrationError(
            f"{path} is a calibration of version {version}; this program reads versions 1 and {VERSION}: "
            "make it again with `phibench calibrate`"
        )
    # of what the file says, before any translation of names, and before any of it is looked at
    if raw.get("sha256") != _digest({k: v for k, v in raw.items() if k != "sha256"}):
        raise CalibrationError(f"{path} was changed after it was written: its hash does not fit; make it again")
    document = _file(path).validated(CalibrationDocument, _of_version_2(raw) if raw["version"] == 1 else raw)
    names, p = tuple(document.parameters), len(document.parameters)
    sizes = {len(document.values), len(document.covariance), *map(len, document.covariance)}
    if names not in (PARAMETERS, _OF_SPHERES) or sizes != {p}:
        raise CalibrationError(f"{path} has other parameters than this program's {len(PARAMETERS)}: make it again")
    rows = [PARAMETERS.index(name) for name in names]
    values, covariance = np.zeros(len(PARAMETERS)), np.zeros((len(PARAMETERS),) * 2)
    values[rows], covariance[np.ix_(rows, rows)] = document.values, document.covariance
    try:
        return _calibration(path, document, values, covariance, nominal)
    except CalibrationError:
        raise
    except DatasetError as error:  # of a rig in it
        raise CalibrationError(f"{path}: {error}; make it again") from error


def _calibration(
    path: Path, document: CalibrationDocument, values: Array, covariance: Array, nominal: Rig | None
) -> Calibration:
    """Calibration of a document with the right hash and sizes."""
    start = from_json(Rig, document.nominal_rig)
    if document.version == 1:
        values, covariance = _relative_focal(path, start, values, covariance)
    if nominal is not None and to_json(nominal) != to_json(start):
        raise CalibrationError(f"{path} is the calibration of another rig than the one that it shall correct")
    rig = from_json(Rig, document.rig)
    _require_sound(path, start, rig, values, covariance)
    return Calibration(rig, start, PARAMETERS, values, covariance, document.made_from, document.sha256)


def _require_sound(path: Path, nominal: Rig, rig: Rig, values: Array, covariance: Array) -> None:
    """Refuse numbers that no calibration gives, whoever has put them into the file."""
    for name, value in zip(PARAMETERS, values.tolist(), strict=True):
        if not abs(value) <= (limit := MISALIGNMENT[name].limit):
            raise CalibrationError(
                f"{path} corrects {name} by {value:g}: allowed is -{limit:g} to {limit:g}; make it again"
            )
    # in units of its own sigmas: metres and pixels differ by 1e4, and eigenvalues would only see the pixels
    scale = np.sqrt(np.abs(np.diag(covariance)))
    whole = np.where(scale > 0.0, scale, 1.0)
    unit = covariance / np.outer(whole, whole)
    # of a correlation: digits of the file
    if not np.allclose(unit, unit.T, atol=1e-9) or np.linalg.eigvalsh((unit + unit.T) / 2.0).min() < -1e-9:
        raise CalibrationError(
            f"{path} has no covariance: its matrix is not symmetric with eigenvalues of 0 or above; make it again"
        )
    try:
        # another machine rounds the last bits otherwise, another Python or program may print fewer digits
        same = same_document(_document(changed_rig(nominal, values)), _document(rig), relative=1e-9)
    except SceneError as error:
        raise CalibrationError(f"{path} corrects the rig to one that cannot be: {error}; make it again") from error
    if not same:
        raise CalibrationError(f"{path} has a rig that is not the nominal one with its corrections; make it again")


def _of_version_2(raw: dict[str, Any]) -> dict[str, Any]:
    """Version 1 with the keys and names of version 2; anything else is left for the checks."""
    new = dict(raw)
    if "believed_rig" in new:
        new["nominal_rig"] = new.pop("believed_rig")
    if isinstance(names := new.get("parameters"), list):
        new["parameters"] = [RENAMED.get(name, name) if isinstance(name, str) else name for name in names]
    return new


def _relative_focal(path: Path, nominal: Rig, values: Array, covariance: Array) -> tuple[Array, Array]:
    """Values and covariance with the focal length relative to the nominal one instead of in pixels."""
    camera = nominal.camera
    if camera.fx_px != camera.fy_px:
        raise CalibrationError(f"{path} is of version 1 and of a camera with fx_px other than fy_px: make it again")
    scale = np.ones(len(PARAMETERS))
    scale[PARAMETERS.index("focal_relative")] = 1.0 / camera.fx_px
    return values * scale, covariance * np.outer(scale, scale)


def _document(rig: Rig) -> dict[str, Any]:
    """Rig as JSON; the rotation of a perfect sphere means nothing, and version 1 left it out."""
    if not rig.mirror.has_axes:
        rig = replace(rig, T_camera_sphere=replace(rig.T_camera_sphere, rotation=IDENTITY))
    return dict(to_json(rig))


def _file(path: Path) -> InputFile:
    return InputFile(path, "make it again with `phibench calibrate`", CalibrationError, 16 * MIB)


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
