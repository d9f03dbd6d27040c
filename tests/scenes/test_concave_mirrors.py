"""Figures of docs/mirror_optics.md on concave mirrors, which are refused: rays in the meridian of a lens on the axis.

The lens is z_c before the vertex. At the radius r the profile has the slope t and lies d behind the vertex's plane, or
d before it if it is concave. With a = atan(r / (z_c +- d)) a ray leaves at 2 atan(t) + a from straight down, outwards,
or at 2 atan(t) - a, across the axis.
"""

from __future__ import annotations

import numpy as np
import pytest

Z_C_M, RIM_M, F_PX = 0.22, 0.06, 1430.0


def meridian(kind: str, vertex_radius_m: float, sign: float, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle of the leaving ray, degrees, and place in the image, pixels from the axis."""
    R = vertex_radius_m
    rest = np.sqrt(R * R - r * r) if kind == "sphere" else np.full_like(r, R)
    depth = R - rest if kind == "sphere" else r * r / (2.0 * R)
    place = r / (Z_C_M + sign * depth)
    return np.degrees(2.0 * np.arctan(r / rest) + sign * np.arctan(place)), F_PX * place


def degrees_per_px(kind: str, sign: float, widest: float, at: float) -> tuple[float, float]:
    """Degrees per pixel at an angle, and vertex radius in mm, of the mirror whose rim sends a ray at `widest`."""
    radii = np.geomspace(0.0601 if kind == "sphere" else 0.012, 2.0, 100_000)
    rim = np.array([meridian(kind, R, sign, np.array([RIM_M]))[0][0] for R in radii[::100]])
    best = radii[::100][np.flatnonzero(rim >= widest)[-1]]
    near = radii[(radii >= 0.99 * best) & (radii <= 1.02 * best)]
    rim = np.array([meridian(kind, R, sign, np.array([RIM_M]))[0][0] for R in near])
    R = float(near[np.argmin(np.abs(rim - widest))])
    angle, place = meridian(kind, R, sign, np.linspace(0.003, RIM_M, 20_001))
    assert np.all(np.diff(angle) > 0.0)  # a far point is seen once
    return float(np.interp(at, angle, np.gradient(angle, place))), 1e3 * R


@pytest.mark.parametrize(
    ("kind", "convex", "concave"),
    [
        ("sphere", (0.306, 0.279, 104.7), (0.190, 0.188, 77.5)),
        ("paraboloid", (0.221, 0.225, 85.7), (0.052, 0.103, 48.4)),
    ],
)
def test_concave_mirrors_show_more_pixels_per_degree(
    kind: str, convex: tuple[float, ...], concave: tuple[float, ...]
) -> None:
    """As printed, to a unit of the last digit, for mirrors that see up to 84 degrees from straight down."""
    for sign, printed in ((1.0, convex), (-1.0, concave)):
        for at, expected in zip((83.5, 74.0), printed[:2], strict=True):
            found, R = degrees_per_px(kind, sign, 84.0, at)
            assert found == pytest.approx(expected, abs=1.5e-3)
        assert R == pytest.approx(printed[2], abs=0.2)


def test_a_concave_mirror_sees_nothing_level_with_its_rim() -> None:
    """A spot 0.50 m high under a rim at 0.64 m: its ray at 84 degrees comes from 1.3 m, at 88 degrees from 4.0 m."""
    below_m = 0.45 + Z_C_M - 0.028 - 0.50
    assert below_m * np.tan(np.radians([84.0, 88.0])) == pytest.approx([1.35, 4.07], abs=0.02)
