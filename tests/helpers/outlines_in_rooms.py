"""Errors of outlines and of `align` over their stated sigmas, on frames of a data set in many rooms. Not a test file.

`python tests/helpers/outlines_in_rooms.py FOLDER [PRESET ...]` prints them for a data set with a room for each sample:
one position of each sample, down and up in turn, or both with `--both`.
The outline is asked with the true camera and radius, which its sigma takes as exact, and a mirror straight above the
lens; `align` with the nominal rig, as a user has it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from phibench.calibration.outline.outline import find_outline
from phibench.calibration.rig.align import alignment
from phibench.calibration.rig.from_dataset import photograph
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.rig import POSITIONS

PRESETS = ("bayer-raw", "mjpeg")
FAR_SIGMAS = 5.0


@dataclass(frozen=True)
class RoomOutline:
    """One frame: errors over sigmas, or why there are none.

    Attributes
    ----------
    name : str
        Sample, position and preset.
    error_m, sigma_m : shape (3,), of the sphere centre in the camera frame
    radius_z : float
        Error of the outline's angular radius over its sigma.
    align_z : shape (2,), of the move along world x and y
    fault : str
        Empty if an outline was found.
    arc, shift_rms_px : float
    """

    name: str
    error_m: np.ndarray
    sigma_m: np.ndarray
    radius_z: float
    align_z: np.ndarray
    fault: str = ""
    arc: float = np.nan
    shift_rms_px: float = np.nan

    @property
    def z(self) -> np.ndarray:
        """Errors of the centre over their sigmas, shape (3,)."""
        return self.error_m / self.sigma_m


_NONE = np.full(3, np.nan)


def outline_of(dataset: Dataset, sample: Sample, position: str, preset: str) -> RoomOutline:
    """Outline and alignment in one frame of a sample, laser off."""
    name = f"{sample.row.sample_id} {position} {preset}"
    image, true, nominal = photograph(dataset, sample, position, preset), sample.rig, sample.nominal_rig
    s = true.sphere_in_camera_m
    above = replace(true.T_camera_sphere, translation_m=(0.0, 0.0, nominal.sphere_in_camera_m[2]))
    try:
        found = find_outline(image.pixels, replace(true, T_camera_sphere=above), image.card)
        moved = alignment(image.pixels, nominal, image.card)
    except ImageError as error:
        return RoomOutline(name, _NONE, _NONE, np.nan, _NONE[:2], str(error))
    error = found.sphere_in_camera_m - s
    # the angular radius is asin(R / |s|): its error is that of |s|
    along = s / np.linalg.norm(s)
    radius = float(along @ error / np.sqrt(along @ found.covariance_m2 @ along))
    needed = -(true.T_world_camera.R @ s)[:2]
    aligned = (moved.move_world_m[:2] - needed) / moved.sigma_m
    return RoomOutline(name, error, found.sigma_m, radius, aligned, "", found.arc, found.shift_rms_px)


def outlines(folder: Path, presets: Sequence[str] = PRESETS, both: bool = False) -> Iterator[RoomOutline]:
    """All frames of a data set: one position of each sample, down and up in turn, or both."""
    dataset = open_dataset(folder)
    for number, sample in enumerate(dataset):
        for position in POSITIONS if both else (POSITIONS[number % 2],):
            for preset in presets:
                yield outline_of(dataset, sample, position, preset)


def pull(z: np.ndarray) -> np.ndarray:
    """Root mean square over the frames."""
    return np.asarray(np.sqrt(np.mean(np.square(z), axis=0)))


def report(found: Sequence[RoomOutline], preset: str) -> str:
    """One line of figures."""
    good = [one for one in found if not one.fault]
    z, align = np.array([one.z for one in good]), np.array([one.align_z for one in good])
    radius = np.array([one.radius_z for one in good])
    rms = 1e6 * pull(np.array([one.error_m for one in good]))
    far = np.abs(z).max(axis=1) >= FAR_SIGMAS
    parts = (
        f"{preset}: {len(found)} frames, {len(found) - len(good)} refused, error rms {np.round(rms, 1)} um",
        f"pull of x, y, z {np.round(pull(z), 2)}, of the radius {pull(radius):.2f}",
        f"pull of align {np.round(pull(align), 2)}",
        f"largest |z| {np.abs(z).max():.1f}, of align {np.abs(align).max():.1f}",
        f"{np.count_nonzero(far)} beyond {FAR_SIGMAS:g} sigma, pull of the others {np.round(pull(z[~far]), 2)}",
    )
    return "; ".join(parts)


if __name__ == "__main__":
    names = [name for name in sys.argv[2:] if name != "--both"] or PRESETS
    everything: list[RoomOutline] = []
    for one in outlines(Path(sys.argv[1]), names, "--both" in sys.argv):
        text = one.fault or f"z {np.round(one.z, 2)} sigma {np.round(1e6 * one.sigma_m, 1)} um, align {one.align_z}"
        print(f"{one.name}: {text} arc {one.arc:.2f} shift {one.shift_rms_px:.3f} px", flush=True)
        everything.append(one)
    for preset in names:
        print(report([one for one in everything if one.name.endswith(f" {preset}")], preset))
