"""Calibration of a rig from images of its data set (`calibrate_dataset`): outlines, edges, known spots; its verdict.

Its verdict has three marks. "bad": the data contradict each other or the priors beyond chance. "doubtful": something
unusual that a person should look at. "good": neither. Parameters that only the prior knows are named under every mark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from phibench.calibration.outline.outline import find_outline
from phibench.calibration.outline.outline_result import Outline, PoseMeasurement, mean_measured, mean_outline
from phibench.calibration.rig.bundle import Bundle, KnownSpot, calibrate
from phibench.calibration.rig.calibration_file import write_calibration
from phibench.calibration.rig.known_spots import Ruler, known_spot, measured_spot, one_per_pose
from phibench.calibration.rig.outline_picture import write_overlay
from phibench.calibration.rig.vertical_edges import find_vertical
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.datasets.store.files import require_writable
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.geometry.rig_parameters import PARAMETERS, prior_sigmas
from phibench.estimator.geometry.status import Status, describe
from phibench.estimator.methods.registry import method_for
from phibench.estimator.spots.simple_spots import find_spot
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, Rig

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
_P = (0.01, 1e-4)  # probability of a larger chi2: below the first doubtful, below the second bad
_FAR_SIGMAS = (3.0, 5.0)  # largest correction over its prior sigma, of 13: by chance in 3 % and in 1e-5 of all rigs
_ARC = 0.75  # an outline is refused below 0.6
_RIM_ARC = 0.3  # a rim below 0.2: in rooms full of things a third of it lies before a plain part of them
_SHIFT_PX = 0.4  # rms over sectors; in `lab` MJPEG frames have 0.18 px, raw ones 0.12 px, layers 0.05 px
_ONLY_PRIOR = 0.9  # of the prior's sigma is left: the data say next to nothing


@dataclass(frozen=True)
class Verdict:
    """Mark of a calibration.

    Attributes
    ----------
    mark : str
        "good", "doubtful" or "bad".
    reasons : tuple of str
        What speaks against it, the worst first; nothing for a good one.
    numbers : str
        chi2 and residuals.
    only_prior : tuple of str
        Parameters of which the data say next to nothing.
    """

    mark: str
    reasons: tuple[str, ...]
    numbers: str
    only_prior: tuple[str, ...]

    def __str__(self) -> str:
        why = f" ({'; '.join(self.reasons)})" if self.reasons else ""
        prior = f"; known from the prior only: {', '.join(self.only_prior)}" if self.only_prior else ""
        return f"calibration {self.mark}{why}: {self.numbers}{prior}"


def verdict_of(bundle: Bundle, prior: Array, outlines: list[Outline]) -> Verdict:
    """Judge a calibration.

    Parameters
    ----------
    bundle
    prior : shape (p,)
        Standard deviations that the fit began with.
    outlines : of the images that it used
    """
    p = float(chdtrc(bundle.degrees, bundle.chi2)) if bundle.degrees > 0 else 1.0
    with np.errstate(all="ignore"):
        far = np.nan_to_num(np.abs(bundle.values) / prior)
        left = np.sqrt(np.diag(bundle.covariance)) / prior
    worst, arc = int(np.argmax(far)), min(outline.arc for outline in outlines)
    least = _ARC if outlines[0].ellipse_px is None else _RIM_ARC
    shift_px = max(outline.shift_rms_px for outline in outlines)
    faults = [
        # an underflow of p is a bad fit
        (_level(-np.log(max(p, 1e-300)), *(-np.log(_P))), f"chi2 is too large, p = {p:.1e}"),
        (_level(far[worst], *_FAR_SIGMAS), f"{PARAMETERS[worst]} is corrected by {far[worst]:.1f} prior sigmas"),
        (_level(-arc, -least), f"only {100.0 * arc:.0f} % of an outline could be used"),
        (_level(shift_px, _SHIFT_PX), f"an outline is off by {shift_px:.2f} px rms: another mirror, or a bad frame"),
    ]
    faults = sorted((fault for fault in faults if fault[0]), key=lambda fault: -fault[0])
    numbers = (
        f"chi2 {bundle.chi2:.1f} for {bundle.degrees} degrees of freedom (p = {p:.2g}), "
        f"outline residual {shift_px:.3f} px rms over {100.0 * arc:.0f} % of it"
    )
    only = tuple(n for n, x, s in zip(PARAMETERS, left, prior, strict=True) if s > 0.0 and x > _ONLY_PRIOR)
    mark = (GOOD, DOUBTFUL, BAD)[max((level for level, _ in faults), default=0)]
    return Verdict(mark, tuple(text for _, text in faults), numbers, only)


def _level(value: float, *limits: float) -> int:
    """Number of limits that a value is above."""
    return sum(bool(value > limit) for limit in limits)


# -- verdict -----------------------------------------------------------------------------------------------------------

LAYERS = "layers"
SPOT_SIGMA_PX = 0.02
"""Of the centroid in noise-free layers."""
MOST_FOCAL_SIGMA = 0.2  # parts of the focal length: beyond it the nominal rig is no start


@dataclass(frozen=True)
class Photograph:
    """An image to calibrate with: pixels as `limb_image.planes_of` takes them, and the card of its preset."""

    pixels: NDArray[Any]
    card: SensorCard | None = None


@dataclass(frozen=True)
class DatasetCalibration:
    """A calibration and the images that it was made from.

    Attributes
    ----------
    bundle : Bundle
    nominal : Rig
    images, outlines : tuples that belong together
    names : of the images
    verdict : Verdict
    prior_sigmas : shape (p,), of the nominal numbers
    """

    bundle: Bundle
    nominal: Rig
    images: tuple[Photograph, ...]
    outlines: tuple[Outline, ...]
    names: tuple[str, ...]
    verdict: Verdict
    prior_sigmas: Array

    def write_picture(self, path: Path) -> Path:
        """Overlay of the image whose outline fits worst, see `outline_picture.write_overlay`."""
        worst = int(np.argmax([outline.shift_rms_px for outline in self.outlines]))
        image, title = self.images[worst], self.names[worst]
        return write_overlay(path, image.pixels, image.card, self.nominal, self.outlines[worst], title)


@dataclass(frozen=True)
class CalibrationSources:
    """Sources of a calibration, and how well the rest is known.

    Attributes
    ----------
    spots : bool
        Also use the samples' laser spots, at places that the ruler or a tape measures.
    vertical : bool
        Also use the room's vertical edges, see `find_vertical`; the room is to have some.
    outline_sigma_factor : float
        Widens the outlines' standard deviations, which were checked in the room `lab` and in rooms like it.
    focal_sigma : float, optional
        How well the nominal focal length is known, relative: `sigmas`.
    """

    spots: bool = False
    vertical: bool = False
    outline_sigma_factor: float = 1.0
    focal_sigma: float | None = None

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the nominal numbers, shape (p,); that of the focal length as stated, or 0.003.

        A lens that was turned since its focal length was measured is known to 0.018 only: see docs/capture.md.

        Raises
        ------
        DatasetError
            If it is not above 0, or not below 0.2.
        """
        if self.focal_sigma is None:
            return prior_sigmas()
        if not 0.0 < self.focal_sigma < MOST_FOCAL_SIGMA:
            raise DatasetError(
                f"--focal-sigma {self.focal_sigma:g}: must be above 0 and below {MOST_FOCAL_SIGMA:g}, parts of the "
                "focal length"
            )
        return prior_sigmas({"focal_relative": self.focal_sigma})


OUTLINES = CalibrationSources()
"""Outlines alone."""


def calibrate_dataset(
    folder: Path,
    out: Path,
    samples: Sequence[str] = (),
    preset: str = LAYERS,
    sources: CalibrationSources = OUTLINES,
    ruler: Ruler | None = None,
) -> DatasetCalibration:
    """Calibrate the rig of some samples and write the file.

    Parameters
    ----------
    folder : Path
        Data set; its nominal rig is corrected.
    out : Path
    samples : ids or numbers; the first of the data set by default
    preset : str
        "layers" for the noise-free layers, or a preset of the sensor whose frames are drawn, with the laser on and off.
    sources : CalibrationSources
        Spots in frames are found by the built-in method that comes closest to the bound there, which gives their
        covariance, too.
    ruler : Ruler, optional
        By default D is measured to 1 mm, height and azimuth not at all.

    Raises
    ------
    DatasetError
        If the samples have different rigs, an image has no whole mirror or too few upright edges, or a spot is lacking.
    """
    require_writable(out)
    dataset, ruler = open_dataset(folder), ruler or Ruler()
    chosen = dataset.chosen(samples or ["0"])
    rig = _one_rig(chosen)
    if preset == LAYERS:
        images = [Photograph(s.ambient(p)) for s, p in one_per_pose(chosen)]
        known = [_known_in_layers(sample, ruler) for sample in chosen] if sources.spots else []
    else:
        images = [photograph(dataset, sample, position, preset) for sample, position in one_per_pose(chosen)]
        known = frame_spots(dataset, chosen, preset, ruler) if sources.spots else []
    measured = [find_outline(image.pixels, rig, image.card) for image in images]
    outlines = [outline.widened(sources.outline_sigma_factor) for outline in measured]
    upright = _vertical(images, outlines, rig) if sources.vertical else None
    sigmas = sources.sigmas
    bundle = calibrate(rig, mean_outline(outlines), known, upright, sigmas)
    made_from = _made_from(dataset, chosen, preset, outlines, known, upright)
    # in the order of the images, one per pose
    names = [f"{sample.row.sample_id} {position}" for sample, position in one_per_pose(chosen)]
    return write_bundle(out, bundle, rig, images, outlines, names, made_from, sigmas)


def write_bundle(
    out: Path,
    bundle: Bundle,
    nominal: Rig,
    images: Sequence[Photograph],
    outlines: Sequence[Outline],
    names: Sequence[str],
    made_from: dict[str, Any],
    sigmas: Array,
) -> DatasetCalibration:
    """Write a calibration and judge it; images, their outlines and names belong together."""
    write_calibration(out, bundle, nominal, made_from)
    verdict = verdict_of(bundle, sigmas, list(outlines))
    return DatasetCalibration(bundle, nominal, tuple(images), tuple(outlines), tuple(names), verdict, sigmas)


def frame_outline(dataset: Dataset, sample: Sample, position: str, preset: str, laser_off: bool = True) -> Outline:
    """Outline in one simulated frame of a sample, with the nominal rig."""
    image = photograph(dataset, sample, position, preset, laser_off)
    return find_outline(image.pixels, sample.nominal_rig, image.card)


def photograph(dataset: Dataset, sample: Sample, position: str, preset: str, laser_off: bool = True) -> Photograph:
    """One simulated frame of a sample, in one noise realisation."""
    pairs = pairs_of(dataset, [sample], preset, laser_off=laser_off)
    return Photograph(pairs.image(0, position, not laser_off), pairs.card(0))


def frame_spots(
    dataset: Dataset,
    samples: Sequence[Sample],
    preset: str,
    ruler: Ruler,
    laser_off: bool = True,
    least: int | None = None,
) -> list[KnownSpot]:
    """Calibration spots of simulated frames.

    Parameters
    ----------
    dataset, samples, preset, ruler, laser_off
    least : int, optional
        So many spots are enough, and those that are not found are left out; by default all must be found.

    Raises
    ------
    DatasetError
        If too few spots were found; what it says is about the last one that was not.
    """
    pairs, spots = pairs_of(dataset, samples, preset, laser_off=laser_off), []
    fault: DatasetError | None = None  # the last one; raised if too few spots remain
    for number, sample in enumerate(samples):
        pair = pairs.pair(number)
        try:
            spots.append(known_spot(sample, pair, method_for(pair.card)(pair), ruler))
        except DatasetError as error:
            fault = error
    if fault is not None and len(spots) < (len(samples) if least is None else least):
        raise fault
    return spots


def _vertical(images: Sequence[Photograph], outlines: Sequence[Outline], nominal: Rig) -> PoseMeasurement:
    """Mean vertical of images whose outlines are known."""
    pairs = zip(images, outlines, strict=True)
    return mean_measured([find_vertical(i.pixels, o.rig(nominal), i.card, o.covariance_m2) for i, o in pairs])


def _one_rig(samples: Sequence[Sample]) -> Rig:
    """Nominal rig of the samples; all must have one true rig."""
    names = sorted({sample.row.rig for sample in samples})
    if len(names) != 1:
        raise DatasetError(f"the samples have {len(names)} rigs ({', '.join(names[:4])}, ...): calibrate one at a time")
    return samples[0].nominal_rig


def _known_in_layers(sample: Sample, ruler: Ruler) -> KnownSpot:
    centroids = {
        p: find_spot(sample.expected_image(p, laser=True), sample.expected_image(p, laser=False)) for p in POSITIONS
    }
    for position, spot in centroids.items():
        if spot.status is not Status.OK:
            raise DatasetError(f"{sample.row.sample_id} {position}: no spot to calibrate with: {describe(spot.status)}")
    places = {position: spot.uv_px for position, spot in centroids.items()}
    C = dict.fromkeys(POSITIONS, SPOT_SIGMA_PX**2 * np.eye(2))
    return measured_spot(sample, places, C, sample.row.nominal_stroke_m, ruler)


def _made_from(
    dataset: Dataset,
    samples: Sequence[Sample],
    preset: str,
    outlines: Sequence[Outline],
    spots: Sequence[KnownSpot],
    vertical: PoseMeasurement | None,
) -> dict[str, Any]:
    return {
        "dataset": dataset.info.name,
        "samples": [sample.row.sample_id for sample in samples],
        "preset": preset,
        "spots": bool(spots),
        "sphere_in_camera_m": [outline.sphere_in_camera_m.tolist() for outline in outlines],
        "sigma_m": [outline.sigma_m.tolist() for outline in outlines],
        "vertical_in_camera": None if vertical is None else vertical.value.tolist(),
        "spot_uv_px": [[spot.uv_down_px.tolist(), spot.uv_up_px.tolist()] for spot in spots],
        "spot_depth_m": [spot.depth_m for spot in spots],
    }
