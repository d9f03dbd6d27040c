"""Limbs of a grazing reflection, in pictures whose light is drawn from the angle by which a ball turns a ray."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from phibench.calibration.outline.ball_circle import limb_beside_circle
from phibench.calibration.outline.edge_ring import TURNS, EdgeRing, LimbRing, log_colours

ROWS, COLUMNS, FINE = 300, 320, 4
CIRCLE = (161.3, 148.8, 101.6)
BLUR_PX = 0.9
PICTURE_BLUR_PX = float(np.sqrt(BLUR_PX**2 + (1.0 + 1.0 / FINE**2) / 12.0 + 1.0 / 6.0))
"""With the pixel's own width, and the mean blur of linear interpolation between pixels."""


def ball(inner_edge_px: float = 0.0) -> np.ndarray:
    """Light in which the ball turns rays from a bright wall up to a darker ceiling.

    Asin of the miss, as `reflection` has it, gives the turn. With an inner edge, the reflected room is twice as
    bright from that many pixels inside the limb on.
    """
    v, u = (np.mgrid[: FINE * ROWS, : FINE * COLUMNS] + 0.5) / FINE - 0.5
    off, azimuth = np.hypot(u - CIRCLE[0], v - CIRCLE[1]), np.arctan2(v - CIRCLE[1], u - CIRCLE[0])
    miss = np.minimum(off / CIRCLE[2], 1.0)
    turn = np.pi - 2.0 * np.arcsin(miss)
    outside = 1.0 + 0.2 * np.cos(azimuth) + 0.1 * np.sin(3.0 * azimuth)
    light = outside * (1.0 - 0.9 * turn + 0.4 * turn**2)
    if inner_edge_px:
        light = np.where(off < CIRCLE[2] - inner_edge_px, 2.0 * light, light)
    light = light.reshape(ROWS, FINE, COLUMNS, FINE).mean(axis=(1, 3))
    return ndimage.gaussian_filter(light, BLUR_PX)


def test_accuracy_of_the_limbs_place() -> None:
    """T, T^2 and the interpolation describe this light to some 1e-3; a tenth of a pixel would be 2 % of it."""
    ring = LimbRing(ball()[None], CIRCLE, 8.0, blur_px=PICTURE_BLUR_PX)
    place, strength = ring.peaks
    assert strength.shape == (TURNS, 4)
    assert np.median(strength[:, 0]) > 0.7
    assert abs(place[:, 0].mean()) < 0.03
    assert np.abs(place[:, 0]).max() < 0.15


def test_another_blur_moves_the_limb() -> None:
    """The place depends on the blur that is stated: half a pixel more moves it by more than the test above allows."""
    ring = LimbRing(ball()[None], CIRCLE, 8.0, blur_px=PICTURE_BLUR_PX + 0.5)
    assert abs(ring.peaks[0][:, 0].mean()) > 0.05


def test_a_stronger_edge_inside_is_not_the_limb() -> None:
    """Edges alone prefer the reflected step 6 px inside; the limb is where the reflection begins."""
    light = ball(inner_edge_px=6.0)
    by_edges = EdgeRing(log_colours(light), CIRCLE)
    wrong = np.array([-6.0, 0.0, 0.0, 0.0, 0.0])
    assert by_edges.contrast(wrong) > by_edges.contrast(np.zeros(5))
    found = limb_beside_circle(light, (CIRCLE[0], CIRCLE[1], CIRCLE[2] - 6.0), PICTURE_BLUR_PX)
    assert found
    # the step reaches into the windows of 5 px; by edges the radius is 6 px too small
    np.testing.assert_allclose(found.circle_px, CIRCLE, atol=0.3)


def test_a_start_many_pixels_off_is_enough() -> None:
    u, v, radius = CIRCLE
    found = limb_beside_circle(ball(), (u + 6.0, v - 5.0, radius + 7.0), PICTURE_BLUR_PX)
    assert found
    np.testing.assert_allclose(found.circle_px, CIRCLE, atol=0.05)
    assert found.edges > 0.95


def test_light_without_a_reflection_has_no_limb() -> None:
    """A smooth wall has none anywhere; a grey disc's edge is a weak one, about which nothing turns."""
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    assert limb_beside_circle(1.0 + 1e-3 * rows + 2e-3 * columns, CIRCLE, PICTURE_BLUR_PX) is None
