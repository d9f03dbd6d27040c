"""Interface of a dense method: images with the laser off in, depth or match of each down pixel out; checks of answers.

>>> import numpy as np
>>> from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
>>> def depth(pair: DensePair) -> DenseAnswer:
...     return DenseAnswer(depth_m=np.full(pair.shape, np.nan))

Pixels: integer (u, v) are pixel centres of the whole image, u to the right, v downwards. Planes are indexed [v, u]. NaN
means "do not know", everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import FramedImages, Image
from phibench.scenes.rig import Rig

Plane = NDArray[np.floating[Any]]
_FARTHEST_M = 1e6
_FAR_PX = 1e6


@dataclass(frozen=True, repr=False)
class DensePair(FramedImages):
    """Pair of images (down, up) of a room with the laser off, as a camera and a user deliver it.

    Attributes
    ----------
    number : int
        Of the pair in its set; says nothing about the scene.
    down, up : array
        Images at stroke position 1 and 2, read-only; by `card.output` as those of `estimator.interface.Pair`.
    rig : Rig
        Nominal or calibrated camera, mirror and stroke axis, at the down position.
    stroke_m : float
        Nominal h.
    card : SensorCard
        Numbers of the sensor and of its processing.
    frames : mapping of image name to array, or None
        Where images are of several frames: the single ones, as `Pair.frames`.
    between : array, shape (n, H, W, ...), or None
        Images at heights between both, if the pair has them, as `up`: methods of a whole stroke take them.
    between_m : tuple of float
        Their nominal heights above the down position, from low to high.
    between_row_m : tuple of float
        What the carriage rises by from the exposure of a row to that of the next one, in each of these images; empty
        for stills. `between_m` is then the height of the row (H - 1) / 2.
    """

    IMAGE_NAMES = ("down", "up", "between")

    number: int
    down: Image = field(repr=False)
    up: Image = field(repr=False)
    rig: Rig
    stroke_m: float
    card: SensorCard
    frames: Mapping[str, Image] | None = field(default=None, repr=False)
    between: Image | None = field(default=None, repr=False)
    between_m: tuple[float, ...] = ()
    between_row_m: tuple[float, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W): the shape of an answer's planes."""
        return self.rig.camera.height_px, self.rig.camera.width_px

    def _title(self) -> str:
        return f"Dense pair {self.number}"


@dataclass(frozen=True)
class DenseAnswer(ShortForm):
    """Answer for a pair: a depth, or a place in the other image, for every pixel of the down image.

    Parameters
    ----------
    depth_m : array, shape (H, W), float32 or float64, or None
        D of the room point that each pixel of the down image shows: its horizontal distance from the vertical line
        through the sphere centre at the down position, which is D of the paper's eq. (4). It is neither the range
        along the ray nor the height.
    target_uv_px : array, shape (H, W, 2), or None
        Place (u, v) of the same room point in the up image; the score makes D of it with the pair's rig. Exactly one
        of the two is given.
    sigma_depth_m : array, shape (H, W), or None
        Standard deviation of D, above 0 where D is known. With places, the method states it for the D that follows.

    Raises
    ------
    ValueError
        If the planes are no such answer; in one sentence.
    """

    depth_m: Plane | None = None
    target_uv_px: Plane | None = None
    sigma_depth_m: Plane | None = None

    def __post_init__(self) -> None:
        if (self.depth_m is None) == (self.target_uv_px is None):
            number = "neither" if self.depth_m is None else "both"
            raise ValueError(f"depth_m and target_uv_px: {number} given; give exactly one of them")
        for name in ("depth_m", "target_uv_px", "sigma_depth_m"):
            if (plane := getattr(self, name)) is not None:
                _require_floats(name, plane)
        if self.target_uv_px is not None:
            _require_places(self.target_uv_px)
        else:
            _require_positive("depth_m", self.depth_m)
        if self.sigma_depth_m is not None:
            self._require_sigma(self.sigma_depth_m)

    def _require_sigma(self, sigma_m: Plane) -> None:
        if sigma_m.shape != self.shape:
            raise ValueError(f"sigma_depth_m has shape {sigma_m.shape}: the answer's planes have {self.shape}")
        _require_positive("sigma_depth_m", sigma_m)
        if (number := int((self.answered & np.isnan(sigma_m)).sum())) > 0:
            raise ValueError(
                f"sigma_depth_m is NaN at {number} pixels that have an answer: give a standard deviation for each of "
                "them, or none at all"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        plane = self.target_uv_px if self.depth_m is None else self.depth_m
        assert plane is not None
        return plane.shape[0], plane.shape[1]

    @property
    def answered(self) -> NDArray[np.bool_]:
        """Mask of the pixels that have an answer, shape (H, W)."""
        if self.target_uv_px is not None:
            return np.asarray(np.isfinite(self.target_uv_px).all(axis=2))
        assert self.depth_m is not None
        return np.asarray(np.isfinite(self.depth_m))


DenseMethod = Callable[[DensePair], DenseAnswer]


def require_shape(answer: DenseAnswer, shape: tuple[int, int]) -> None:
    """Refuse an answer whose planes are not those of the down image.

    Raises
    ------
    ValueError
        In one sentence.
    """
    if answer.shape == shape:
        return
    turned = " Rows come first: [v, u]." if answer.shape == shape[::-1] else ""
    raise ValueError(f"the answer has {answer.shape} pixels, the down image {shape}: give a value for each.{turned}")


def _require_floats(name: str, plane: Any) -> None:
    """A real array of floats with the right number of axes, without infinities."""
    if not isinstance(plane, np.ndarray):
        raise ValueError(f"{name} is a {type(plane).__name__}: a NumPy array is needed")
    wanted = "(H, W, 2)" if name == "target_uv_px" else "(H, W)"
    if plane.ndim != wanted.count(",") + 1 or (plane.ndim == 3 and plane.shape[2] != 2):
        raise ValueError(f"{name} has shape {plane.shape}: {wanted} is needed")
    if plane.dtype not in (np.float32, np.float64):
        raise ValueError(f"{name} is of {plane.dtype}: float32 or float64 is needed, NaN for 'do not know'")
    if (number := int(np.isinf(plane).sum())) > 0:
        raise ValueError(f"{name} is infinite at {number} values: write NaN for 'do not know'")


_SIGN = "a negative D comes from a disparity of the wrong sign, or from exchanged images"


def _require_positive(name: str, plane: Any) -> None:
    turned = name == "depth_m" and 2 * np.count_nonzero(plane < 0.0) > np.count_nonzero(np.isfinite(plane))
    hint = f". Most are negative: {_SIGN}" if turned else ""
    for number, what in ((int((plane <= 0.0).sum()), "0 or below"), (int((plane > _FARTHEST_M).sum()), "above 1e6 m")):
        if number:
            needed = f"metres above 0 are needed, NaN for 'do not know'{hint}"
            raise ValueError(f"{name} is {what} at {number} pixels: {needed}")


def _require_places(places: Plane) -> None:
    half = np.isnan(places[..., 0]) != np.isnan(places[..., 1])
    if half.any():
        raise ValueError(f"target_uv_px has only one of u and v at {int(half.sum())} pixels: give both or NaN for both")
    if (np.abs(places) > _FAR_PX).any():
        raise ValueError(f"target_uv_px goes beyond {_FAR_PX:g} px: give places in the up image, NaN for 'do not know'")
