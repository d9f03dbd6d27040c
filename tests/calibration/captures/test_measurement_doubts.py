"""Doubts of spots: their remedy is that of the cause which the pictures show."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from phibench.calibration.captures.measurement_doubts import SeenSpot, too_far_note, unlike_spot_notes
from phibench.calibration.captures.pair_mistakes import missing_spot_error
from phibench.scenes.rig import Rig


@pytest.mark.parametrize(
    ("off_codes", "words"), [(60, "turn the laser a little"), (57, r"off\.png has 0\.95 times the codes")]
)
def test_a_light_without_the_shape_of_a_spot_is_told_its_cause(off_codes: int, words: str) -> None:
    """With the laser off a room 5 % darker leaves edges beside the spot: no beam is to blame."""
    images = {"down": np.full((9, 9, 3), 60), "down_off": np.full((9, 9, 3), off_codes)}
    photos: Any = SimpleNamespace(down=SimpleNamespace(off=[SimpleNamespace(path="off.png")]))
    pair: Any = SimpleNamespace(images=images)
    spot = SeenSpot(np.array([4.0, 4.0]), np.eye(2), 0.9)
    (text,) = unlike_spot_notes(pair, photos, {"down": spot})
    assert text.startswith("doubtful: the spot down at (4, 4) px has not the shape of one")
    assert re.search(words, text)
    assert not list(unlike_spot_notes(pair, photos, {"down": SeenSpot(spot.uv_px, spot.covariance_px2)}))


def test_a_distance_beyond_all_spots_is_doubtful() -> None:
    """Two lights that are not one spot gave D = 1277 +- 1036 m."""
    far: Any = SimpleNamespace(depth_m=np.array(1277.0))
    near: Any = SimpleNamespace(depth_m=np.array(11.0))
    assert "beyond 12 m" in too_far_note(far)
    assert too_far_note(near) == ""


def test_a_mirror_that_moved_is_the_reason_why_no_spot_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a picture that was shifted by 12 px: not the laser and not the stroke."""
    monkeypatch.setattr("phibench.calibration.captures.pair_mistakes.known_mistake_error", lambda *_: None)
    lacking = SimpleNamespace(uv_px=None, status="no spot found")
    answer: Any = SimpleNamespace(down=SimpleNamespace(uv_px=np.zeros(2)), up=lacking)
    photos: Any = SimpleNamespace(up=SimpleNamespace(on=[SimpleNamespace(path="up.png")]))
    pair: Any = SimpleNamespace(down_off=None, rig=Rig())
    text = str(missing_spot_error(pair, photos, answer, "doubtful: the mirror has moved by 2 mm"))
    assert text.startswith("no laser spot in the picture up (up.png): no spot found")
    assert text.endswith("; the mirror has moved by 2 mm")
    assert "whether the laser is on" in str(missing_spot_error(pair, photos, answer))
