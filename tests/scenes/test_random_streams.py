"""Sobol's points against SciPy's, bit by bit."""

import subprocess
import sys

import numpy as np
import pytest
import scipy

from phibench.scenes.random_streams import sobol


@pytest.mark.parametrize("dimensions", range(1, 8))
def test_points_of_sobol_are_those_of_scipy(dimensions: int) -> None:
    for power in (0, 1, 5, 12):
        expected = scipy.stats.qmc.Sobol(dimensions, scramble=True, rng=0).random_base2(power)
        assert np.array_equal(sobol(dimensions, 2**power), expected)
        assert np.array_equal(sobol(dimensions, 2**power - 1), expected[:-1])


def test_dimensions_beyond_the_table_are_refused() -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - of zip
        sobol(8, 16)


def test_nodes_of_spots_do_not_import_the_statistics_of_scipy() -> None:
    """They take longer to import than a spot to render."""
    code = (
        "import sys, phibench.datasets.build.view_task, phibench.datasets.build.spot_task, "
        "phibench.render.room.ambient_layer, phibench.render.optics.spot_layer, phibench.render.optics.traced_spot\n"
        "from phibench.scenes.random_streams import sobol\n"
        "sobol(6, 64)\n"
        "assert 'scipy.stats' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
