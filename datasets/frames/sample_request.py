"""Request of a sample's frames: the recipe's `[frames]`, drawn per sample, and what a caller gives instead.

There is one meaning of the frames of a data set. Scores, `Sample.camera_frames`, training, exports and drawn files all
take them from here. Each number of `[frames]` is drawn once per sample, from a random stream of its own, and is the
same in all presets and draws.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from phibench.datasets.frames.request import AUTO, Exposure, FrameOptions, FrameRequest
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.tables import SENSOR_KEYS, FramesTable
from phibench.scenes.random_streams import LEAST_SECRET_SEED, Name, generator, philox_key

Names = tuple[str, int, str]
_CAMERAS = 2**31  # numbers of cameras; those of a secret seed have all 128 bits
_STREAM = "take"  # name of the random streams: another name would draw other numbers


def sample_request(names: Names, frames: FramesTable | None, options: FrameOptions) -> FrameRequest:
    """Request of a sample.

    Parameters
    ----------
    names : (data set, its seed, sample id)
    frames : FramesTable or None
        The recipe's `[frames]`; its defaults where there is none.
    options : FrameOptions
        What goes before it.

    Raises
    ------
    DatasetError
        If a number is out of its range; in one sentence.
    """
    table = frames or FramesTable()
    request = FrameRequest(
        options.preset,
        _exposure(names, table),
        laser_level=_value(names, "laser_level", table.laser_level),
        lamp_level=_value(names, "lamp_level", table.lamp_level),
        camera_seed=_camera_seed(names, table),
        overrides=_numbers(names, table),
    )
    return options.over(request)


def _numbers(names: Names, frames: FramesTable) -> dict[str, Any]:
    """Numbers of the preset that the recipe gives."""
    drawn = {key: _value(names, key, given) for key in SENSOR_KEYS if (given := getattr(frames, key)) is not None}
    return {key: round(value) if key == "jpeg_quality" else value for key, value in drawn.items()} | (
        frames.sensor or {}
    )


def _exposure(names: Names, frames: FramesTable) -> Exposure:
    given = frames.exposure_s
    return _value(names, "exposure_s", given) if isinstance(given, DistributionTable) else AUTO


def _camera_seed(names: Names, frames: FramesTable) -> int:
    """Name of the camera's fixed pattern. Of a secret root it has 128 bits of it: 31 bits are found by trying all."""
    name, seed, sample_id = names
    owner = (sample_id,) if frames.camera == "per_sample" else ()
    if seed >= LEAST_SECRET_SEED:
        low, high = philox_key(name, seed, _STREAM, "camera", *owner).tolist()
        return int(low) + (int(high) << 64)
    return int(generator(name, seed, _STREAM, "camera", *owner).integers(_CAMERAS))


def _value(names: Names, key: str, table: DistributionTable) -> float:
    return float(quantile(table, np.array([sample_stream(names, key).random()]))[0])


def sample_stream(names: Names, *key: Name) -> np.random.Generator:
    """Random stream of one number of a sample's frames."""
    return generator(*names, _STREAM, *key)
