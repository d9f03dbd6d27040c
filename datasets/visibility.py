"""How many pairs of a data set can be used, and why the others cannot, in one line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from phibench.datasets.schema import ManifestRow
from phibench.scenes.rig import POSITIONS


def visibility_line(rows: Sequence[ManifestRow]) -> str:
    """Say how many pairs are visible in both images, and the causes for the others with their numbers."""
    hidden = [row for row in rows if not (row.down.visible and row.up.visible)]
    text = f"{len(rows) - len(hidden)} of {len(rows)} pairs are visible in both images"
    if not hidden:
        return text
    spots = ((position, row.position(position)) for row in hidden for position in POSITIONS)
    causes = Counter(f"{position} {spot.cause}" for position, spot in spots if not spot.visible)
    return f"{text}; not visible: " + ", ".join(f"{cause} ({count})" for cause, count in causes.items())
