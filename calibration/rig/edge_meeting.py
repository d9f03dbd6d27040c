"""Point through which the room's vertical edges pass, the paper's check of the alignment; camera's tilt from edges.

With the lens on the vertical through the mirror's centre, every vertical edge lies in a plane with that vertical. Its
image is then a straight line through the middle of the mirror's outline. No number of camera or mirror is needed, so
that the check serves a picture of an unknown camera, and a mirror of any round shape. A straight line is fitted to each
edge of `vertical_edges`; what most of them agree on is the point.

Where the rig is known, `find_vertical` tells the camera's tilt. Edges show the vertical as the nominal camera sees it:
m = up + t + A c, with the tilt t, the principal point's error c, and A of `bundle.vertical_by_principal_point`. A
mirror at s then lies beside the vertical through the lens by s - s_z c / f - s_z (up + t), across the camera's axis.
A is 0.83 / f: an error of the principal point moves mirror and vertical in the image nearly alike, so that it hardly
matters once the edges are used. It is a Gaussian update of four numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from phibench.calibration.outline.edge_ring import Circle
from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.calibration.rig.bundle import vertical_by_principal_point
from phibench.calibration.rig.vertical_edges import agreeing_edges, require_edges, shift_regression
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

MOST_OFF = 0.15
"""Distance of the point from the outline's middle, over the radius: other lines of the room meet farther off."""
_TOGETHER = 6.0  # points of an edge that are wrong together, as in `vertical_edges`
_LEAST_SIGMA = 5e-4  # of a line's place at the middle, over the radius: edges are bent where a rig is not aligned
_LEAST_SPREAD = 0.1  # of the lines' directions: parallel lines do not meet


@dataclass(frozen=True)
class EdgeMeeting:
    """Point through which vertical edges pass.

    Attributes
    ----------
    uv_px : shape (2,)
    covariance_px2 : shape (2, 2)
    centre_px : shape (2,)
        Middle of the mirror's outline.
    edges : tuple of arrays, shape (k, 2), pixels
        Edges that agree.
    """

    uv_px: Array
    covariance_px2: Array
    centre_px: Array
    edges: tuple[Array, ...] = field(repr=False)

    @property
    def off_px(self) -> float:
        """Distance from the middle of the outline."""
        return float(np.linalg.norm(self.uv_px - self.centre_px))

    @property
    def sigma_px(self) -> float:
        """Standard deviation along each axis of the image, the two axes' mean."""
        return float(np.sqrt(0.5 * np.trace(self.covariance_px2)))


def edge_meeting(edges: Sequence[Array], circle: Circle) -> EdgeMeeting:
    """Point through which edges pass.

    Parameters
    ----------
    edges : arrays of shape (k, 2), pixels; of `vertical_edges.edges_about`
    circle
        Middle and radius of the mirror's outline, pixels.

    Raises
    ------
    ImageError
        If fewer than three edges agree on a point within 0.15 radii of the centre.
    """
    centre_px, radius_px = np.array(circle[:2]), circle[2]
    require_edges(len(edges))
    lines = np.array([_line(edge - centre_px, _LEAST_SIGMA * radius_px) for edge in edges])
    azimuth, place, weight = lines.T
    chosen = agreeing_edges(azimuth, place, weight, MOST_OFF * radius_px)
    require_edges(len(chosen))
    azimuth, place, weight = lines[chosen].T
    along = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if np.linalg.eigvalsh(along.T @ along / len(along))[0] < _LEAST_SPREAD:
        require_edges(1)  # they are one edge, seen on both sides of a post
    fit = shift_regression(azimuth, place, weight)
    return EdgeMeeting(centre_px + fit.shift, fit.covariance, centre_px, tuple(edges[k] for k in chosen))


def _line(points_px: Array, least_px: float) -> tuple[float, float, float]:
    """Azimuth of an edge's straight line, its place across the azimuth at the origin, and one over its variance."""
    middle = points_px.mean(axis=0)
    along = np.linalg.svd(points_px - middle, full_matrices=False)[2][0]
    along = along * (1.0 if along @ middle > 0.0 else -1.0)
    across = np.array([-along[1], along[0]])
    distance, left = (points_px - middle) @ along, (points_px - middle) @ across
    variance = float(left @ left) / max(left.size - 2, 1)
    reach2 = float(middle @ along) ** 2 / float(distance @ distance)
    place = _TOGETHER * variance * (1.0 / left.size + reach2)
    return float(np.arctan2(along[1], along[0])), float(middle @ across), 1.0 / (place + least_px**2)


# -- tilt of the camera ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraTilt:
    """Deviation of a camera from its nominal numbers.

    Attributes
    ----------
    up : shape (3,)
        Nominal vertical in the camera frame.
    tilt_rad, principal_point_px : shape (2,)
        By which the vertical's x and y, and cx and cy, differ from it.
    covariance : shape (4, 4), of both
    chi2 : float or None
        Of the edges against the stated standard deviations, two degrees of freedom; None without edges.
    """

    up: Array
    tilt_rad: Array
    principal_point_px: Array
    covariance: Array
    chi2: float | None = None

    def beside_m(self, sphere_in_camera_m: Array, focal_px: Array) -> tuple[Array, Array]:
        """By how much a mirror lies beside the vertical through the lens, camera frame, shape (3,), and its covariance.

        The covariance, shape (2, 2), is of x and y, by tilt and principal point alone; `focal_px` has fx and fy.
        """
        depth = float(sphere_in_camera_m[2])
        true = sphere_in_camera_m - depth * np.append(self.principal_point_px / focal_px, 0.0)
        up = self.up + np.append(self.tilt_rad, 0.0)
        up = up / np.linalg.norm(up)
        by_both = -depth * np.hstack([np.eye(2), np.diag(1.0 / focal_px)])
        return true - float(true @ up) * up, by_both @ self.covariance @ by_both.T


def stated_tilt(rig: Rig, tilt_sigma_rad: float, principal_point_sigma_px: float) -> CameraTilt:
    """The nominal camera, with the user's standard deviations of each axis."""
    covariance = np.diag(np.repeat([tilt_sigma_rad**2, principal_point_sigma_px**2], 2))
    return CameraTilt(rig.T_world_camera.R.T[:, 2], np.zeros(2), np.zeros(2), covariance)


def with_vertical(stated: CameraTilt, rig: Rig, vertical: PoseMeasurement) -> CameraTilt:
    """The same with a vertical from edges, of `vertical_edges.find_vertical`.

    Edges that contradict the statement widen the covariance of what comes out.
    """
    H = np.hstack([np.eye(2), vertical_by_principal_point(rig)])
    off = vertical.value - stated.up[:2]
    seen = H @ stated.covariance @ H.T + vertical.covariance
    gain = np.linalg.solve(seen, H @ stated.covariance).T
    change = gain @ off
    chi2 = float(off @ np.linalg.solve(seen, off))
    covariance = (stated.covariance - gain @ H @ stated.covariance) * max(1.0, chi2 / len(off))
    return CameraTilt(stated.up, change[:2], change[2:], covariance, chi2)
