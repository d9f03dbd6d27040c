"""Panorama from a photograph of a mirror ball: the ball found and unwrapped; its file, and a recipe's table for it.

The ball is a sphere of a stated radius before a pinhole camera. Its outline in the photograph gives its direction and,
with the focal length, its distance; or the focal length, with the distance. A direction of the panorama stands for the
point at a stated distance from the ball's centre. Ball and camera are symmetric about the line through their centres:
so one table of angles, from the closed form of `reflection.image_of`, serves all directions.

The panorama's middle column looks from the ball back along the camera's axis, its upper edge upwards. Directions behind
the ball, and those that only the outermost rim shows, take the nearest direction that is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from phibench.calibration.outline.ball_circle import LONGEST_PX, BallCircle, find_circle, shrunk_picture
from phibench.calibration.outline.edge_ring import Circle
from phibench.calibration.outline.first_circle import sphere_from_circle, sphere_from_rays
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.datasets.store.layers import write_exr
from phibench.datasets.store.pictures import save_png
from phibench.estimator.geometry.panorama import PanoramaGrid, unrolled_values
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.spots.camera_codes import linear_to_srgb
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose, Vector, as_matrix, as_vector
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

SUFFIXES = (".exr", ".png")
MOST_COLUMNS = 8192
READABLE_COLUMNS = 2880  # four planes of float32 then have less than the 64 MiB that a recipe reads
_RIM = (0.005, 1.0)  # of the outline's radius, and pixels: inside it the background blurs into the ball
_NODES = 20_000  # 1.6e-4 rad: linear between them errs by less than 1e-8 rad
_ROWS_AT_ONCE = 128  # arrays of some tens of MB


@dataclass(frozen=True)
class BallPhoto:
    """Facts about a photograph of a mirror ball.

    Parameters
    ----------
    radius_m : float
    distance_m : float, or None
        From the lens to the ball's centre; this or the focal length must be stated.
    focal_px : float, or None
    centre_px : 2 floats, or None
        Principal point; by default the middle of the picture, which a cropped one may not have there.
    circle_px : 3 floats, or None
        Centre (u, v) and radius of the outline; by default it is looked for.
    elevation_deg : float
        Of the camera's axis above the horizon: 0 horizontal, 90 looking up at the ball.
    """

    radius_m: float
    distance_m: float | None = None
    focal_px: float | None = None
    centre_px: tuple[float, float] | None = None
    circle_px: Circle | None = None
    elevation_deg: float = 0.0

    def __post_init__(self) -> None:
        if (self.distance_m is None) == (self.focal_px is None):
            raise DatasetError(
                "the ball's distance or the focal length is needed, one of them: the outline in the photograph gives "
                "the other; give --distance-m or --focal-px"
            )
        stated = [("--radius-m", self.radius_m), ("--distance-m", self.distance_m), ("--focal-px", self.focal_px)]
        for name, value in stated:
            if value is not None and not 0.0 < value < math.inf:
                raise DatasetError(f"{name} {value:g}: must be above 0")
        # nearer, the lens touches the ball
        if self.distance_m is not None and not self.distance_m > 1.02 * self.radius_m:
            raise DatasetError(
                f"--distance-m {self.distance_m:g}: must be above 1.02 radii, {1.02 * self.radius_m:g} m"
            )
        if not -90.0 <= self.elevation_deg <= 90.0:
            raise DatasetError(f"--camera-elevation-deg {self.elevation_deg:g}: allowed range is -90 to 90")


@dataclass(frozen=True)
class Ball:
    """A ball in a photograph.

    Attributes
    ----------
    view : View
        Camera and ball; the world's x looks from the ball back along the camera's axis, z is up.
    circle_px : centre (u, v) and radius of the outline
    edges : float
        Part of the outline at which the photograph has an edge; 1 for a stated circle.
    sigma_px : float
        Largest standard deviation of centre and radius; 0 for a stated circle.
    """

    view: View
    circle_px: Circle
    edges: float
    sigma_px: float = 0.0


@dataclass(frozen=True)
class BallPanorama:
    """An unwrapped photograph.

    Attributes
    ----------
    light : float32 array, shape (H, 2 H, 3), linear, in the unit of the photograph
    seen : bool array, shape (H, 2 H), False where the nearest direction was taken
    ball : Ball
    """

    light: NDArray[np.float32] = field(repr=False)
    seen: NDArray[np.bool_] = field(repr=False)
    ball: Ball


def find_ball(light: NDArray[np.float32], photo: BallPhoto) -> Ball:
    """Camera and ball of a photograph, shape (rows, columns, 3), linear.

    Raises
    ------
    DatasetError
        If no outline is found, or the stated one cannot be.
    """
    rows, columns = light.shape[:2]
    centre = photo.centre_px or (0.5 * (columns - 1), 0.5 * (rows - 1))
    if photo.circle_px is not None:
        circle, points, edges, sigma = photo.circle_px, None, 1.0, 0.0
    else:
        seen_circle = _outline(light)
        circle, points, edges, sigma = (
            seen_circle.circle_px,
            seen_circle.points_px,
            seen_circle.edges,
            float(seen_circle.sigma_px.max()),
        )
    u, v, radius = circle
    if not (radius >= 10.0 and -radius < u < columns + radius and -radius < v < rows + radius):
        raise DatasetError(
            f"--circle {u:g} {v:g} {radius:g}: the outline must have a radius of 10 px or more and meet the picture of "
            f"{columns} x {rows} px"
        )
    focal = photo.focal_px or radius / math.tan(math.asin(photo.radius_m / (photo.distance_m or math.inf)))
    options: dict[str, Any] = {"fx_px": focal, "fy_px": focal, "cx_px": centre[0], "cy_px": centre[1]}
    camera = Camera(width_px=columns, height_px=rows, focus_distance_m=1.0, **options)
    if points is None:
        s = sphere_from_circle(circle, camera, photo.radius_m)
    else:
        s = sphere_from_rays(camera.rays(points), photo.radius_m)
    if not s[2] > 1.01 * photo.radius_m:  # rays of a lens at the ball have no meaning
        raise DatasetError(
            f"a focal length of {focal:.0f} px puts the lens into the ball: check focal length and outline"
        )
    rig = Rig(
        camera=camera,
        mirror=SphereMirror(radius_m=photo.radius_m),
        T_world_camera=Pose("world", "camera", (0.0, 0.0, 0.0), as_matrix(_camera_axes(photo.elevation_deg))),
        T_camera_sphere=Pose("camera", "sphere", as_vector(s)),
    )
    return Ball(rig.at(0.0), circle, edges, sigma)


def _camera_axes(elevation_deg: float) -> Array:
    """Camera's axes as columns, world, shape (3, 3): it looks against the world's x, upwards by the elevation."""
    e = math.radians(elevation_deg)
    forward, up = np.array([-math.cos(e), 0.0, math.sin(e)]), np.array([math.sin(e), 0.0, math.cos(e)])
    return np.stack([np.cross(-up, forward), -up, forward], axis=1)


# The outline.


def _outline(light: NDArray[np.float32]) -> BallCircle:
    try:
        return find_circle(light)
    except ImageError as error:
        raise DatasetError(f"{error}; give it by --circle U V RADIUS, in pixels") from None


# The panorama.


def unwrap(light: NDArray[np.float32], ball: Ball, surroundings_m: float, width_px: int | None = None) -> BallPanorama:
    """Panorama of what the ball shows.

    Parameters
    ----------
    light : array, shape (rows, columns, 3), linear
    ball : Ball
    surroundings_m : float
        Distance of the surroundings from the ball's centre.
    width_px : int, or None
        Columns, even; by default as fine as the photograph is in the ball's middle, at most 2880: then a recipe reads
        the file. Fewer are averaged.

    Raises
    ------
    DatasetError
        If a number is out of range.
    """
    if not surroundings_m > 1.5 * ball.view.rig.sphere.radius_m:
        raise DatasetError(f"--surroundings-m {surroundings_m:g}: must be above 1.5 radii of the ball")
    native = math.pi * ball.circle_px[2]  # in the middle a pixel turns the ray by 2 / r: pi r of them are a turn
    width = min(READABLE_COLUMNS, max(32, 2 * round(native / 2.0))) if width_px is None else width_px
    if not 32 <= width <= MOST_COLUMNS or width % 2:
        raise DatasetError(f"--width {width}: must be an even number from 32 to {MOST_COLUMNS}")
    parts = max(1, math.ceil(native / width - 0.01))
    grid = PanoramaGrid(width * parts, -math.pi / 2.0, math.pi / 2.0)
    table = _Angles(ball.view, surroundings_m, ball.circle_px[2])
    result, seen = np.empty((width // 2, width, 3), np.float32), np.empty((width // 2, width), bool)
    for first in range(0, width // 2, _ROWS_AT_ONCE):
        rows = slice(first, min(first + _ROWS_AT_ONCE, width // 2))
        fine = slice(rows.start * parts, rows.stop * parts)
        uv, shown = table.pixels(grid.directions(fine))
        values = unrolled_values(light, uv)
        cells = (rows.stop - rows.start, parts, width, parts)
        result[rows] = values.reshape(*cells, 3).mean(axis=(1, 3))
        seen[rows] = shown.reshape(cells).all(axis=(1, 3))
    return BallPanorama(result, seen, ball)


class _Angles:
    """Table from the angle of a point, seen from the ball's centre, to the angle of its image, seen from the lens.

    Both are from the line between the centres, the first from the camera's side.
    """

    def __init__(self, view: View, distance_m: float, radius_px: float) -> None:
        self.view = view
        s = view.rig.sphere_in_camera_m
        self.axis = s / np.linalg.norm(s)  # camera frame
        across = np.cross(self.axis, [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        angle = np.linspace(0.0, math.pi, _NODES)[1:-1]
        points = s + distance_m * (-np.cos(angle)[:, None] * self.axis + np.sin(angle)[:, None] * across)
        uv = image_of(view, view.T_world_camera.points(points)).uv_px
        ray = view.rig.camera.rays(uv)
        image = np.arctan2(ray @ across, ray @ self.axis)
        limb = math.asin(view.rig.sphere.radius_m / float(np.linalg.norm(s)))
        most = limb * (1.0 - _RIM[0] - _RIM[1] / radius_px)
        kept = np.isfinite(image) & (np.nan_to_num(image, nan=np.inf) <= most)
        kept &= np.cumsum(~kept) == 0  # what follows the first that is lost is behind the ball
        self.point_rad = np.concatenate([[0.0], angle[kept]])
        self.image_rad = np.concatenate([[0.0], image[kept]])

    def pixels(self, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels, shape (..., 2), that show directions from the ball's centre, or the nearest, and which are shown."""
        d = directions @ self.view.T_world_camera.R  # to the camera's frame
        along = d @ self.axis
        aside = d - along[..., None] * self.axis
        length = np.linalg.norm(aside, axis=-1)
        angle = np.arctan2(length, -along)
        image = np.interp(angle, self.point_rad, self.image_rad)
        side = aside / np.maximum(length, 1e-300)[..., None]  # along the axis no side is defined, and none is needed
        camera = self.view.rig.camera
        uv = camera.project(np.cos(image)[..., None] * self.axis + np.sin(image)[..., None] * side)
        shown = (angle <= self.point_rad[-1]) & camera.contains(uv)
        return np.clip(uv, 0.0, np.array([camera.width_px, camera.height_px]) - 1.0), shown


def require_suffix(path: Path) -> None:
    """Raise `DatasetError` for a file that is none of the two kinds."""
    if path.suffix.lower() not in SUFFIXES:
        raise DatasetError(f"{path}: a panorama is written as {' or '.join(SUFFIXES)}")


def write_panorama(path: Path, panorama: BallPanorama) -> Path:
    """Write an unwrapped photograph: linear light as OpenEXR, with a plane `seen`, or sRGB of 8 bits as PNG.

    Raises
    ------
    DatasetError
        If the file's ending is neither, or a PNG cannot hold the light.
    """
    require_suffix(path)
    if path.suffix.lower() == ".png":
        if panorama.light.max() > 1.001:  # interpolation rounds
            raise DatasetError(f"{path}: the photograph has light above 1, which a PNG cannot hold; write an .exr file")
        codes = np.rint(255.0 * linear_to_srgb(panorama.light)).astype(np.uint8)
        return save_png(path, codes)
    view = panorama.ball.view
    planes = {name: panorama.light[..., k] for k, name in enumerate("RGB")}
    header = {
        "kind": "panorama",
        "circle_px": [float(x) for x in panorama.ball.circle_px],
        "focal_px": view.rig.camera.fx_px,
        "sphere_in_camera_m": [float(x) for x in view.rig.sphere_in_camera_m],
    }
    return write_exr(path, {**planes, "seen": panorama.seen.astype(np.float32)}, header)


_POINT_M = (0.0, 0.0, 1.2)  # where nothing is stated: above the robot, at the height of a hand
_WALL_M = (1.0, 45.0)  # distance of the example's walls: a room measures 2 to 100 m


def panorama_table(path: Path, point_m: Vector | None, box_m: Vector | None, surroundings_m: float) -> str:
    """Table of a recipe that reads a panorama; what a photograph does not tell is an example to change.

    Parameters
    ----------
    path : Path
    point_m : 3 floats, or None
        Place of the ball's centre, from the robot.
    box_m : 5 floats, or None
        Walls around the robot; the example's are at the distance of the surroundings.
    surroundings_m : float

    Raises
    ------
    DatasetError
        If no room can be made of the point and the box.
    """
    wall = min(max(surroundings_m, _WALL_M[0]), _WALL_M[1])
    point = _POINT_M if point_m is None else point_m
    box = (-wall, wall, -wall, wall, 2.5) if box_m is None else box_m
    try:
        PanoramaSettings(path, point, box_m=box, stroke_m=0.0)
    except SceneError as error:
        text = str(error).replace("PanoramaSettings.box_m", "--box-m").replace("PanoramaSettings.point_m", "--point-m")
        raise DatasetError(text) from error
    lines = (
        "[[rooms.panoramas]]",
        f'file = "{path.name}"',
        f"point_m = {[float(x) for x in point]}  # the ball's centre{_example(point_m)}",
        "heading_deg = 0.0  # of the direction from the ball to the camera; an example: put in yours",
        f"box_m = {[float(x) for x in box]}  # x_low, x_high, y_low, y_high, height{_example(box_m)}",
    )
    return "\n".join(lines)


def _example(given: Vector | None) -> str:
    return "; an example: put in yours" if given is None else ""


def write_outline(path: Path, light: NDArray[np.float32], ball: Ball) -> Path:
    """Write a small copy of the photograph with the outline that was taken; PNG."""
    block = max(1, math.ceil(max(light.shape[:2]) / LONGEST_PX))
    small = shrunk_picture(light, block)
    bright = max(1.0, float(np.percentile(small, 99.0)))  # lamps may be cut in the picture
    picture = Image.fromarray(np.rint(255.0 * linear_to_srgb(small / bright)).astype(np.uint8))
    points = (ball.view.rig.outline_px() + 0.5) / block - 0.5
    ImageDraw.Draw(picture).polygon([(float(u), float(v)) for u, v in points], outline=(255, 0, 0), width=2)
    return save_png(path, np.asarray(picture))
