"""The three kinds of layers as EXR files: which planes they have and what their headers say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.exr import Exr, read_exr, write_exr
from phibench.scenes.detector import FILTERS

Array = NDArray[np.float64]
TRUTH_PLANES = (
    *("x_m", "y_m", "z_m", "depth_m", "path_m"),
    *("phi_ray_rad", "phi_normal_rad", "phi_incidence_rad", "azimuth_rad", "object_id"),
)
AMBIENT_PLANES = (*FILTERS, *(f"var.{name}" for name in FILTERS))
SPOT_STACKS = {"electrons_per_s": "", "du_electrons_per_s_px": "du.", "dv_electrons_per_s_px": "dv."}
"""Arrays of a spot layer, shape (3, h, w), and the prefix of their planes: R, G, B, du.R, ..."""
SPOT_PLANES = tuple(prefix + name for prefix in SPOT_STACKS.values() for name in FILTERS)


@dataclass(frozen=True)
class SpotWindow:
    """A spot layer: images of one spot on a small window.

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the window's first column and row; the window may reach beyond the image.
    electrons_per_s : array, shape (3, h, w), float64
        Expected photo-electrons per second per pixel behind R, G, B. h = w = 0 where no light reaches the image.
    du_electrons_per_s_px, dv_electrons_per_s_px : arrays, shape (3, h, w)
        Derivatives with respect to a shift of the spot's image by +u, +v.
    """

    u0_px: int
    v0_px: int
    electrons_per_s: Array
    du_electrons_per_s_px: Array
    dv_electrons_per_s_px: Array

    @classmethod
    def empty(cls) -> SpotWindow:
        """Return the window of a spot that sends no light to the image."""
        none = np.zeros((3, 0, 0))
        return cls(0, 0, none, none, none)

    def add_to(self, image: Array, gain: float = 1.0) -> None:
        """Add `gain` times the window to an image, shape (3, H, W), in place; what lies outside is lost."""
        height, width = image.shape[1:]
        rows, columns = self.electrons_per_s.shape[1:]
        v0, v1 = max(self.v0_px, 0), min(self.v0_px + rows, height)
        u0, u1 = max(self.u0_px, 0), min(self.u0_px + columns, width)
        if v0 < v1 and u0 < u1:
            part = self.electrons_per_s[:, v0 - self.v0_px : v1 - self.v0_px, u0 - self.u0_px : u1 - self.u0_px]
            image[:, v0:v1, u0:u1] += gain * part


def write_ambient(path: Path, planes: NDArray[Any], variance: NDArray[Any], header: Mapping[str, Any]) -> Path:
    """Write an ambient layer and its variance, shape (3, H, W) each: planes R, G, B, var.R, var.G, var.B."""
    header = {"kind": "ambient", "unit": "electrons/s", **header}
    return write_exr(path, dict(zip(AMBIENT_PLANES, (*planes, *variance), strict=True)), header)


def read_ambient(path: Path, **owner: str) -> NDArray[np.float32]:
    """Read an ambient layer, shape (3, H, W), electrons per second; `owner` as in `read_layer`."""
    file = read_layer(path, "ambient", AMBIENT_PLANES, **owner)
    return np.stack([file.planes[name] for name in FILTERS])


def read_ambient_variance(path: Path, **owner: str) -> NDArray[np.float32]:
    """Read the variance of an ambient layer, shape (3, H, W), (electrons per second) squared; `owner` likewise."""
    file = read_layer(path, "ambient", AMBIENT_PLANES, **owner)
    return np.stack([file.planes["var." + name] for name in FILTERS])


def write_truth(path: Path, planes: Mapping[str, Array], header: Mapping[str, Any]) -> Path:
    """Write a truth layer: the planes `TRUTH_PLANES`."""
    return write_exr(path, {name: planes[name] for name in TRUTH_PLANES}, {"kind": "truth", **header})


def read_truth(path: Path, **owner: str) -> dict[str, NDArray[Any]]:
    """Read a truth layer: float64 planes (H, W) with NaN where there is nothing; `object_id` int32, -1 there."""
    file = read_layer(path, "truth", TRUTH_PLANES, **owner)
    planes: dict[str, NDArray[Any]] = {name: file.planes[name].astype(float) for name in TRUTH_PLANES}
    planes["object_id"] = planes["object_id"].astype(np.int32)
    return planes


def write_spot(path: Path, layer: SpotWindow, header: Mapping[str, Any]) -> Path:
    """Write a spot layer: planes R, G, B and their derivatives, in a data window."""
    stacks = ((prefix, getattr(layer, name)) for name, prefix in SPOT_STACKS.items())
    planes = {prefix + name: plane for prefix, stack in stacks for name, plane in zip(FILTERS, stack, strict=True)}
    header = {"kind": "spot", "unit": "electrons/s", **header}
    return write_exr(path, planes, header, (layer.u0_px, layer.v0_px))


def read_spot(path: Path, **owner: str) -> SpotWindow:
    """Read a spot layer; `owner` as in `read_layer`."""
    file = read_layer(path, "spot", SPOT_PLANES, **owner)
    stacks = [
        np.stack([file.planes[prefix + name] for name in FILTERS]).astype(float) for prefix in SPOT_STACKS.values()
    ]
    return SpotWindow(*file.origin_px, *stacks)


def read_layer(path: Path, kind: str, planes: tuple[str, ...], **owner: str) -> Exr:
    """Read a layer and check what it is.

    Parameters
    ----------
    path : Path
    kind : "ambient", "truth" or "spot"
    planes : names of the planes that must be there
    **owner : str
        What the header must say: `dataset`, and `pose` or `sample_id` and `position`. A file of another pose or
        sample under the right name is refused.

    Raises
    ------
    DatasetError
        If the file cannot be read or is not that layer.
    """
    try:
        file = read_exr(path)
    except DatasetError as error:
        raise DatasetError(f"{error}; `phibench dataset repair` renders it again") from error
    if file.header.get("kind") != kind:
        raise DatasetError(f"{path} holds a layer of kind '{file.header.get('kind')}', not '{kind}'")
    if missing := [name for name in planes if name not in file.planes]:
        raise DatasetError(f"{path} lacks the planes {', '.join(missing)}")
    if wrong := [key for key, value in owner.items() if file.header.get(key) != value]:
        held, meant = (", ".join(f"{key} {table.get(key)}" for key in wrong) for table in (file.header, owner))
        raise DatasetError(f"{path} is the {kind} layer of {held}, not of {meant}; run `phibench dataset verify`")
    return file
