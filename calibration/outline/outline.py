"""Outline of the rig's mirror in an image, whatever its shape."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from phibench.calibration.outline.outline_result import Outline
from phibench.calibration.outline.rim_outline import find_rim_outline
from phibench.calibration.outline.sphere_outline import find_sphere_outline
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.scenes.rig import Rig


def find_outline(image: NDArray[Any], rig: Rig, card: SensorCard | None = None) -> Outline:
    """Place of the mirror from an image of it, from scratch: of a sphere its centre, else the vertex.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Nominal: its camera, mirror and blur are used; the outline is looked for with 0.7 to 1.4 times the radius that
        the rig gives it, anywhere in the image.
    card : SensorCard, optional
        Of the image's preset; none for a layer.

    Raises
    ------
    ImageError
        For an image without a mirror, or with less than half of its outline.
    """
    find = find_rim_outline if rig.mirror.has_rim else find_sphere_outline
    return find(image, rig, card)
