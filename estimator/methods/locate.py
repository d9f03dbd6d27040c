"""Where to look: a box around the spot in each image of a pair."""

from __future__ import annotations

from phibench.estimator.detect import Detection, detect
from phibench.estimator.seat.pair import Box, Image, Pair

_SIDE_PX = 21  # room for a fit's surroundings


def locate(pair: Pair) -> tuple[Box | None, Box | None]:
    """Boxes around the spots that `detect` sees; where it sees none, the pair's own hint, or None.

    Raises
    ------
    ValueError
        If an image does not fit the card's output.
    """
    found = detect(pair)
    return box_around(found.down, pair.down) or pair.box_down, box_around(found.up, pair.up) or pair.box_up


def box_around(found: Detection | None, image: Image) -> Box | None:
    """Square of 21 pixels around a detection, moved inside the image where it would leave it."""
    if found is None:
        return None
    height, width = image.shape[:2]
    side = (min(_SIDE_PX, width), min(_SIDE_PX, height))
    u0, v0 = (
        min(max(round(x) - s // 2, 0), size - s) for x, s, size in zip(found.uv_px, side, (width, height), strict=True)
    )
    return Box(u0, v0, side[0], side[1])
