"""Spots of a film's frames that a test run has computed before; most of the time of a small film goes there.

They are a pure function of what they are asked for, which `test_a_killed_run_goes_on_and_gives_the_same_bytes` shows by
computing them again. Tests of damage and of repairs need not.
"""

import os
import pickle
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from phibench.datasets.film import film_task


class RememberedSpots:
    """`film_task.frame_spots` that is computed once for each scene, room and times, of which alone it is a function.

    Attributes
    ----------
    folder : Path or None
        Of the test run, where its other processes find what this one has computed.
    """

    def __init__(self) -> None:
        self._function, self._kept = film_task.frame_spots, dict[bytes, Any]()
        self.folder: Path | None = None

    def __call__(self, film: Any, room: Any, times_s: Sequence[float]) -> Any:
        asked = pickle.dumps((film.scene, room, list(times_s)))
        if asked not in self._kept:
            self._kept[asked] = self._computed(asked, film, room, times_s)
        images, centres = self._kept[asked]
        return list(images), list(centres)

    def _computed(self, asked: bytes, film: Any, room: Any, times_s: Sequence[float]) -> Any:
        if self.folder is None:
            return self._function(film, room, times_s)
        file = self.folder / sha256(asked).hexdigest()
        if file.exists():
            return pickle.loads(file.read_bytes())
        answer = self._function(film, room, times_s)
        self.folder.mkdir(exist_ok=True)
        part = file.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(answer))
        part.rename(file)
        return answer


SPOTS = RememberedSpots()
"""Of this test run."""
