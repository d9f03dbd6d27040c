"""Errors of rooms from files; `datasets.errors` itself must not load what checks scenes, for a quick `--help`."""

from __future__ import annotations

from phibench.datasets.errors import DatasetError
from phibench.scenes.validation import SceneError


class RoomError(DatasetError, SceneError):
    """A mesh, a panorama or settings of which no room can be made."""
