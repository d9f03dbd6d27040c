"""Outlines in generated rooms, one sample each: errors over sigmas, refusals. Of many minutes: the rooms are rendered.

`python tests/helpers/outlines_in_rooms.py FOLDER` gives the same figures for a data set that is there already.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.outlines_in_rooms import FAR_SIGMAS, PRESETS, outlines, report
from helpers.processes import quiet

from phibench.datasets.make import make

ROOMS = 24


@pytest.mark.study
@pytest.mark.slow
def test_accuracy_of_outlines_in_generated_rooms(shared: Any) -> None:
    """No error above 5 sigma, and no more than one frame in three refused.

    The pull is printed; 0.9 to 1.1 is asked for and not reached, see docs/measurements/calibration.md.
    """
    folder = shared.made("worlds", lambda out: make("worlds", out, workers=1, console=quiet(), samples=ROOMS))
    found = list(outlines(folder))
    for preset in PRESETS:
        print(report([one for one in found if one.name.endswith(f" {preset}")], preset))
    assert len(found) == ROOMS * len(PRESETS)
    good = [one for one in found if not one.fault]
    assert len(good) > 2 * len(found) / 3
    assert max(float(np.abs(one.z).max()) for one in good) < FAR_SIGMAS
