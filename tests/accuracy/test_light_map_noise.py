"""Noise of the light map of `lab`, from two bakes that share no random number."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.oracles import TARGETS
from helpers.path_windows import independent_bake

from phibench.render.room.light_map import BakeSettings
from phibench.scenes.room import lab

PARTS = (50, 68, 90)


@pytest.mark.slow
@pytest.mark.parametrize("final_rays", [pytest.param(256, marks=pytest.mark.study), 128])
def test_accuracy_of_the_stated_noise_of_a_light_map(final_rays: int) -> None:
    """Half of the difference's square is the variance of one bake, and the mean over all texels is stated within 20 %.

    The difference also has what two halves of one bake share: lamps' rays and bounces. The map has some 30 000 texels,
    and smoothing makes about 50 of them alike: 600 independent ones give a variance to 6 %.
    """
    settings = BakeSettings(final_rays=final_rays)
    first, second = (independent_bake(lab(TARGETS), settings, number) for number in (0, 1))
    seen = ~first.covered & (first.irradiance_w_m2.min(axis=-1) > 0.0)
    level = 0.5 * (first.irradiance_w_m2 + second.irradiance_w_m2)[seen].astype(float)
    error = (first.irradiance_w_m2 - second.irradiance_w_m2)[seen].astype(float) / np.sqrt(2.0)
    stated = np.sqrt(0.5 * (first.sigma_w_m2[seen].astype(float) ** 2 + second.sigma_w_m2[seen].astype(float) ** 2))
    rms = [100.0 * float(np.sqrt(np.mean(x**2) / np.mean(level**2))) for x in (error, stated)]
    parts = np.percentile(np.abs(error) / level, PARTS) * 100.0
    told = np.median(stated / level) * 100.0
    print(f"{final_rays} rays, {np.count_nonzero(seen)} texels: rms {rms[0]:.2f} %, stated {rms[1]:.2f} %; relative, ")
    print(f"{PARTS} % of the texels: {np.round(parts, 2)} %, stated median {told:.2f} %")
    assert rms[0] < 1.2 * rms[1]
