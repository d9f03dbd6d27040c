"""Interface of a method: the pair of images (down, up) that it gets, boxes of spots, its answer, and the outcome.

>>> from phibench.estimator.interface import Answer, Pair, Spot
>>> def extract(pair: Pair) -> Answer:
...     return Answer(Spot((640.0, 120.0)), Spot.missing("not looked for"))

Nothing of the truth is in a pair. Where a pair has several frames of an image, the image is their mean: a method for
one frame works unchanged, and one that knows better finds the single frames in `Pair.stack`. Pixels: integer (u, v) are
pixel centres of the whole image, u to the right, v downwards, so that the image spans [-0.5, W - 0.5].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig

OK = "ok"
Image = NDArray[Any]
Matrix2 = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Box:
    """Pixels [u0, u0 + width) x [v0, v0 + height) of the image that hold the spot; the spot is anywhere in them."""

    u0_px: int
    v0_px: int
    width_px: int
    height_px: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image, shape (H, W, ...)."""
        return slice(self.v0_px, self.v0_px + self.height_px), slice(self.u0_px, self.u0_px + self.width_px)


class FramedImages(ShortForm):
    """Images by name, each of one frame or of several: what every kind of pair is made of.

    A pair is a frozen dataclass with a field for each of `IMAGE_NAMES`, and these: number, rig, stroke_m, card, frames.
    """

    IMAGE_NAMES: ClassVar[tuple[str, ...]]
    card: SensorCard
    frames: Mapping[str, Image] | None
    rig: Rig
    stroke_m: float

    def _shown(self) -> dict[str, Any]:
        image, camera = self.images["down"], self.rig.camera
        return {
            "images": f"{', '.join(self.images)}: {' x '.join(map(str, image.shape))} {image.dtype}",
            "frames": ", ".join(f"{self.count(name)} of {name}" for name in self.images),
            "output": f"{self.card.output} of '{self.card.name}', exposure {1e3 * self.card.exposure_s:.4g} ms",
            "camera": f"{camera.width_px} x {camera.height_px} px, fx {camera.fx_px:g} px",
            "stroke h": f"{self.stroke_m:g} m",
        }

    @classmethod
    def of_frames(cls, number: int, frames: Mapping[str, Sequence[Image]], **others: Any) -> Self:
        """Pair of the frames of each image; of one frame each, images are these very frames."""
        if all(len(group) == 1 for group in frames.values()):
            return cls(**{"number": number, **{name: group[0] for name, group in frames.items()}, **others})
        stacks = {name: _read_only(np.stack(group)) for name, group in frames.items()}
        means = {name: _read_only(stack.mean(axis=0, dtype=np.float32)) for name, stack in stacks.items()}
        return cls(**{"number": number, **means, **others, "frames": MappingProxyType(stacks)})

    def stack(self, name: str) -> Image:
        """Frames of an image that is there, shape (n, H, W, ...)."""
        return np.asarray(self.images[name])[None] if self.frames is None else self.frames[name]

    def count(self, name: str) -> int:
        """Number of frames of an image; 0 where it is not there."""
        return len(self.stack(name)) if name in self.images else 0

    @property
    def images(self) -> Mapping[str, Image]:
        """Images by name, those that are there, in the order of `IMAGE_NAMES`."""
        named = {name: getattr(self, name) for name in self.IMAGE_NAMES}
        return MappingProxyType({name: image for name, image in named.items() if image is not None})


@dataclass(frozen=True, repr=False)
class Pair(FramedImages):
    """Pair of images (down, up) of one spot in one noise realisation, as a camera and a user deliver it.

    Attributes
    ----------
    number : int
        Of the pair in its set; says nothing about the scene.
    down, up : array
        Images at stroke position 1 and 2, laser on, read-only. By `card.output`: "raw" (H, W) uint16, DN of the mosaic
        (RGGB, red at even row and column) or of a sensor without filters; "srgb8" and "mjpeg" (H, W, 3) uint8, R, G, B;
        "yuyv" (H, W, 2) uint8, the camera's bytes: Y', and in turns Cb (even columns) and Cr (`camera_codes`).
    down_off, up_off : array or None
        The same with the laser off, from another exposure.
    frames : mapping of image name to array, or None
        Where images are of several frames: the single ones, shape (n, H, W, ...), as the camera delivers them,
        read-only. The images above are then their means, float32, in the same unit.
    rig : Rig
        Nominal camera, mirror and stroke axis, at the down position.
    stroke_m : float
        Nominal h.
    card : SensorCard
        Numbers of the sensor and of its processing.
    box_down, box_up : Box or None
        Region hints; both or none.
    calibration_covariance : array, shape (p, p), or None
        Of the rig's parameters, `estimator.geometry.rig_parameters.PARAMETERS`, where rig and stroke come from a
        calibration file; read-only.
    beam : Beam or None
        What the user knows of the laser's spot: its diameter by the distance.
    """

    IMAGE_NAMES = ("down", "up", "down_off", "up_off")

    number: int
    down: Image = field(repr=False)
    up: Image = field(repr=False)
    rig: Rig
    stroke_m: float
    card: SensorCard
    down_off: Image | None = field(default=None, repr=False)
    up_off: Image | None = field(default=None, repr=False)
    box_down: Box | None = None
    box_up: Box | None = None
    calibration_covariance: NDArray[Any] | None = field(default=None, repr=False)
    beam: Beam | None = None
    frames: Mapping[str, Image] | None = field(default=None, repr=False)

    def _title(self) -> str:
        return f"Pair {self.number}"

    def _shown(self) -> dict[str, Any]:
        boxes = [f"{box.width_px} x {box.height_px} px" for box in (self.box_down, self.box_up) if box is not None]
        return {
            **super()._shown(),
            "boxes": ", ".join(boxes) or "none",
            "calibration": "none" if self.calibration_covariance is None else "with its covariance",
        }


def _read_only(image: Image) -> Image:
    image.flags.writeable = False
    return image


@dataclass(frozen=True)
class Spot(ShortForm):
    """Answer for one image.

    Parameters
    ----------
    uv_px : (u, v) or None
        Position of the spot's centre; None where `status` is not "ok".
    covariance_px2 : 2 x 2 or None
        Covariance of (u, v), if the method claims one.
    phi_rad : float or None
        Angle in the sense `phi_convention`; None leaves it to `estimator.geometry.phi`.
    phi_convention : "ray", "normal", "incidence" or "outline"
        Sense of `phi_rad`.
    status : str
        "ok", or in a few words why there is no position.
    """

    uv_px: tuple[float, float] | None = None
    covariance_px2: Matrix2 | None = None
    phi_rad: float | None = None
    phi_convention: str = "ray"
    status: str = OK

    @classmethod
    def missing(cls, why: str) -> Spot:
        """No position, and why."""
        return cls(status=why)


@dataclass(frozen=True)
class Answer(ShortForm):
    """Answer for a pair; the depth is computed from the positions unless the method gives one itself.

    Parameters
    ----------
    down, up : Spot
        Answers for the two images.
    depth_m, sigma_depth_m : float or None
        The standard deviation is that of the pixels' noise: what a calibration adds, the score adds.
    interval_depth_m : (low, high) or None
        Between which D lies with 95 %, 2.5 % on either side, where that is not D -+ 1.96 sigma; likewise of the
        pixels' noise.
    """

    down: Spot
    up: Spot
    depth_m: float | None = None
    sigma_depth_m: float | None = None
    interval_depth_m: tuple[float, float] | None = None


Method = Callable[[Pair], Answer]


FAILURES = ("error", "timeout", "crash", "memory", "invalid", "mutated")
"""Exception; time limit; the process died; memory limit; an answer that is none; the method wrote into its input."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of asking a method for one pair.

    Attributes
    ----------
    number : int
        `Pair.number`.
    answer : Answer or None
        None where `failure` says why.
    seconds : float
        Wall-clock time inside the method; NaN where it did not come back.
    failure : "" or one of `FAILURES`
        Reason why there is no answer; empty if there is one.
    message : str
        One sentence about the failure, with the method's own line where there is one.
    output : str
        Last lines of what the method printed for this pair.
    dense : DenseAnswer or None
        Answer for a dense pair, which has no `answer`.
    """

    number: int
    answer: Answer | None
    seconds: float
    failure: str = ""
    message: str = ""
    output: str = ""
    dense: Any = None
