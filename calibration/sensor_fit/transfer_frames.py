"""Frames of a photon transfer, read group by group: sums, codes and images of dark, flat and timed ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.sensor_fit.block_sums import BlockSums, block_sums, common_noise, outliers
from phibench.calibration.sensor_fit.capture_folder import Capture, CaptureError, FrameGroup, Kind
from phibench.calibration.sensor_fit.code_widths import CodeWidths, code_fault
from phibench.calibration.sensor_fit.dark_frames import dark_image
from phibench.calibration.sensor_fit.noise_likeness import NoiseLikeness, noise_likeness
from phibench.scenes.frames import Array

_SHAPE = "16 pixels or more of each filter along both sides are needed"


@dataclass(frozen=True)
class FilterLevel:
    """One filter of one level: its sums, the shares of its codes, light, and what all filters of it have in common."""

    name: str
    site: str
    sums: BlockSums
    codes: Array  # shares
    light: tuple[float, str] | None = None  # photons or seconds
    seconds: float | None = None
    likeness: NoiseLikeness | None = None
    image: Array | None = None  # of all filters


class TransferFrames:
    """Sums of all frames, read group by group."""

    def __init__(self, capture: Capture, capped: FrameGroup) -> None:
        self.capture, self.top = capture, (1 << capture.notes.bits) - 1
        self.filters = 1 if capture.kind == "mono-raw" else 2
        self.widths = CodeWidths(self.top)
        frames = raw_frames(capture, capped)
        self.dark_image, self.common = dark_image(frames), common_noise(frames)
        self.defects = outliers(self.dark_image.mean, float(np.median(self.dark_image.variance)) / len(frames))[0]
        self.dark = block_sums(frames, self.top, self.defects).jackknife()
        self.dark_codes = self.widths.add(frames, float(self.dark.temporal_dn2[0]))
        self.levels = [level for group in capture.flats for level in self._levels(group)]
        exposures = [group for group in capture.exposures if len(group.files) > 1]
        self.exposures = [level for group in exposures for level in self._levels(group)]
        self.timed = [
            (float(group.seconds or 0.0), block_sums(raw_frames(capture, group), self.top, self.defects).jackknife())
            for group in capture.dark_exposures
        ]

    def _levels(self, group: FrameGroup) -> list[FilterLevel]:
        """One level for each filter."""
        light = (group.photons, "photons") if group.photons is not None else None
        if group.name.startswith("exposure/"):
            light = (group.seconds or 0.0, "seconds")
        frames = raw_frames(self.capture, group)
        likeness, levels = noise_likeness(frames, self.filters), []
        image = frames.mean(axis=0, dtype=np.float32)
        defects = of_filters(self.defects[None], self.capture.kind)
        for (site, pixels), (_, bad) in zip(of_filters(frames, self.capture.kind), defects, strict=True):
            sums = block_sums(pixels, self.top, bad[0]).jackknife()
            codes = self.widths.add(pixels, float(sums.temporal_dn2[0]))
            levels.append(FilterLevel(group.name, site, sums, codes, light, group.seconds, likeness, image))
        return levels


def raw_frames(capture: Capture, group: FrameGroup) -> NDArray[Any]:
    """Raw frames of one level, shape (n, h, w).

    Raises
    ------
    CaptureError
        If they are not codes of the stated bits as a converter writes them, or too small.
    """
    frames = capture.stack(group)
    if fault := code_fault(frames, capture.notes.bits):
        raise CaptureError(f"{capture.folder / group.name} {fault}")
    if min(frames.shape[1:]) < 32:
        raise CaptureError(f"{capture.folder / group.name}: {frames.shape[2]} x {frames.shape[1]} pixels; {_SHAPE}")
    return frames


def of_filters(frames: NDArray[Any], kind: Kind) -> list[tuple[str, NDArray[Any]]]:
    """Pixels of each filter of an RGGB mosaic, or all of them."""
    if kind == "mono-raw":
        return [("mono", frames)]
    names = (("R", 0, 0), ("G1", 0, 1), ("G2", 1, 0), ("B", 1, 1))
    return [(name, frames[:, row::2, column::2]) for name, row, column in names]
