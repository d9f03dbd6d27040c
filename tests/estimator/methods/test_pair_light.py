"""Masks and light that a method of one's own begins with: against plain loops, and in rooms that are dark."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.benchmark.isolation.example_method import extract
from phibench.estimator.interface import Pair
from phibench.estimator.methods.pair_light import lamp_mask, laser_light, mirror_mask, noise_of
from phibench.scenes.frames import BoolArray


def with_off(pair: Pair, change: np.ndarray) -> Pair:
    """The pair with other laser-off frames."""
    return replace(pair, down_off=change, up_off=change)


@pytest.fixture(scope="module")
def raw() -> Pair:
    return EasyPairs("mono-raw").pair(0)


def test_a_box_narrows_the_mask_of_its_own_image(raw: Pair) -> None:
    assert raw.box_down is not None
    assert raw.box_up is not None
    whole = mirror_mask(raw)
    for position, box in (("down", raw.box_down), ("up", raw.box_up)):
        expected = {
            (v, u)
            for v in range(box.v0_px, box.v0_px + box.height_px)
            for u in range(box.u0_px, box.u0_px + box.width_px)
            if whole[v, u]
        }
        assert expected
        assert set(zip(*(i.tolist() for i in np.nonzero(mirror_mask(raw, position))), strict=True)) == expected
    without = replace(raw, box_down=None, box_up=None)
    assert (mirror_mask(without, "down") == whole).all()


def lit(pair: Pair, level: float) -> tuple[Pair, BoolArray]:
    """A laser-off frame of a tenth of full scale with a lamp of 40 x 40 pixels, and where that lamp is."""
    card = pair.card
    span = card.top_dn - card.black_level_dn
    off = np.full(pair.down.shape, round(card.black_level_dn + 0.1 * span), np.uint16)
    lamp = np.zeros(off.shape, bool)
    lamp[340:380, 620:660] = True
    off[lamp] = round(card.black_level_dn + level * span)
    return with_off(pair, off), lamp


@pytest.mark.parametrize(("level", "seen"), [(0.8, True), (0.2, False)])
def test_a_lamp_and_its_margin_are_masked_and_a_wall_is_not(raw: Pair, level: float, seen: bool) -> None:
    """A lamp of 8 times the light of the room, a wall of twice its light."""
    pair, lamp = lit(raw, level)
    mask = lamp_mask(pair, "down")
    assert mask.any() == seen
    if seen:
        assert mask[lamp].all()
        # 12 px of margin, and the blur of 4 px moves an edge of this height by less than 3 of its sigma
        assert mask[360, 660:671].all()
        assert not mask[360, 660 + 12 + 12 :].any()
        assert mask.sum() < (40 + 2 * 24) ** 2


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mono-raw", "bayer-raw", "srgb8"])
def test_in_a_dark_room_nothing_is_a_lamp_and_the_spot_is_found(preset: str) -> None:
    """A room without light, noise alone: three times its median is no light either."""
    pairs = EasyPairs(preset, hinted=False)
    pair, truth = pairs.pair(0), pairs.truth(0)
    assert pair.down_off is not None
    assert pair.up_off is not None
    black = pair.card.black_level_dn if pair.card.output == "raw" else 0
    dark = {
        name: np.clip(on.astype(int) - np.median(off, axis=(0, 1)) + black, 0, None).astype(on.dtype)
        for name, on, off in (
            ("down", pair.down, pair.down_off),
            ("up", pair.up, pair.up_off),
            ("down_off", pair.down_off, pair.down_off),
            ("up_off", pair.up_off, pair.up_off),
        )
    }
    images = replace(pair, **dark)
    for one in (images, replace(images, down_off=None, up_off=None)):
        assert not (lamp_mask(one, "down") & mirror_mask(one)).any()
        found = extract(one).down.uv_px
        assert found is not None
        # a centroid of 7 x 7 pixels on these bright spots is good to a third of a pixel
        assert np.hypot(*np.subtract(found, truth.down.uv_px)) < 1.0


def test_laser_light_without_a_laser_off_frame_is_the_redness() -> None:
    pair = EasyPairs("srgb8", laser_off=False).pair(0)
    light = laser_light(pair, "down")
    for v, u in ((100, 200), (360, 640), (600, 1000)):
        codes = pair.down[v, u] / 255.0
        linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
        assert light[v, u] == pytest.approx(linear[0] - max(linear[1], linear[2]), abs=2e-4)


def test_noise_is_that_of_the_pixels_asked_for() -> None:
    """10 000 draws of a normal law: the median absolute deviation is good to 1.2 % (rms), 6 % are 5 of it: 6e-7."""
    light = 3.0 + 0.2 * np.random.default_rng(1).standard_normal((100, 200))
    inside = np.zeros(light.shape, bool)
    inside[:, :100] = True
    light[:, 100:] += 50.0
    light[5, 5] = 1e6
    assert noise_of(light, inside) == pytest.approx(0.2, rel=0.06)
    assert np.isnan(noise_of(light, np.zeros_like(inside)))


def test_it_needs_neither_the_renderer_nor_the_rest_of_the_methods() -> None:
    code = (
        "import sys; sys.modules.update(mitsuba=None, drjit=None)\n"
        "import phibench.estimator.methods.pair_light\n"
        "print([n for n in sys.modules if n.startswith('phibench.estimator.methods.') and 'pair_light' not in n])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
