"""Frames of takes: a sample's layers and distractors, read and computed once, and the camera of each take."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.distractors import Distractor, distractors
from phibench.datasets.frame_request import FrameRequest
from phibench.datasets.frame_source import FrameSource
from phibench.datasets.layers import SpotWindow
from phibench.datasets.read import Sample
from phibench.datasets.schema import ManifestRow
from phibench.datasets.takes import Take
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, View


@dataclass(frozen=True)
class TakenSample:
    """A sample that keeps its layers; it is what `FrameSource` needs of one."""

    sample: Sample = field(repr=False)

    @property
    def row(self) -> ManifestRow:
        """Exact numbers."""
        return self.sample.row

    @property
    def rig(self) -> Rig:
        """The sample's rig."""
        return self.sample.rig

    @property
    def nominal_rig(self) -> Rig:
        """The rig that the user believes in."""
        return self.sample.nominal_rig

    @property
    def laser_spot(self) -> LaserSpot:
        """The laser spot."""
        return self.sample.laser_spot

    @property
    def stream_names(self) -> tuple[str, int, str]:
        """Data set, its seed, sample id."""
        return self.sample.stream_names

    @cached_property
    def distractors(self) -> tuple[Distractor, ...]:
        """Other lights of the sample."""
        return distractors(self.sample)

    def view(self, position: str) -> View:
        """Rig at a position."""
        return self.sample.view(position)

    def ambient(self, position: str) -> NDArray[np.float32]:
        """Ambient layer, shape (3, H, W)."""
        return self._layers[position][0]

    def spot(self, position: str) -> SpotWindow:
        """Spot layer."""
        return self._layers[position][1]

    @cached_property
    def _layers(self) -> dict[str, tuple[NDArray[np.float32], SpotWindow]]:
        return {position: (self.sample.ambient(position), self.sample.spot(position)) for position in POSITIONS}

    def source(self, take: Take) -> FrameSource:
        """Return what draws the frames of a take, distractors included.

        Raises
        ------
        DatasetError
            If a layer cannot be read; in one sentence.
        """
        request = self._locked(take.request)
        lights = {p: tuple(one.other(p, request.laser_level) for one in self.distractors) for p in POSITIONS}
        return FrameSource.from_request(self, request, lights)

    def _locked(self, request: FrameRequest) -> FrameRequest:
        """Request with the exposure and gain that auto exposure chooses for the down image, for all images."""
        if request.exposure != "auto":
            return request
        sensor = FrameSource.from_request(self, request).sides["down"].chain.sensor
        overrides = {**request.overrides, "analogue_gain": sensor.analogue_gain}
        return replace(request, exposure=sensor.exposure_s, overrides=overrides)
