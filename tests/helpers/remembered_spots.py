"""Spots of a film's frames that a test process has computed before; most of the time of a small film goes there.

They are a pure function of what they are asked for, which `test_a_killed_run_goes_on_and_gives_the_same_bytes` shows by
computing them again. Tests of damage and of repairs need not.
"""

import pickle
from collections.abc import Sequence
from typing import Any

from phibench.datasets.film import film_task


class RememberedSpots:
    """`film_task.frame_spots` that is computed once for each film, room and times."""

    def __init__(self) -> None:
        self._function, self._kept = film_task.frame_spots, dict[bytes, Any]()

    def __call__(self, film: Any, room: Any, times_s: Sequence[float]) -> Any:
        asked = pickle.dumps((film, room, list(times_s)))
        if asked not in self._kept:
            self._kept[asked] = self._function(film, room, times_s)
        images, centres = self._kept[asked]
        return list(images), list(centres)


SPOTS = RememberedSpots()
"""Of this process."""
