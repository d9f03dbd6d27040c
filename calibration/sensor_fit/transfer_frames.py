"""Frames of a photon transfer, read group by group: sums, codes and images of dark, flat and timed ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.calibration.sensor_fit.block_sums import BlockSums, block_sums, common_noise, outliers
from phibench.calibration.sensor_fit.capture_folder import Capture, FrameGroup, of_filters, raw_frames
from phibench.calibration.sensor_fit.code_widths import CodeWidths
from phibench.calibration.sensor_fit.dark_frames import dark_image
from phibench.calibration.sensor_fit.noise_likeness import NoiseLikeness, noise_likeness
from phibench.scenes.frames import Array


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
