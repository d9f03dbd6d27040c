"""Alignment of mirror and lens: rig from command options, move that centres the mirror, sharpness; pictures, sentences.

The mirror is aligned when its centre lies on the vertical through the lens. The outline gives the centre. The nominal
tilt and principal point of the camera give the vertical; their errors usually dominate. The paper's check, that all
vertical edges pass through the image's centre, tells both where the room has such edges (`edge_meeting`), and serves a
camera of which nothing is known, too. Of a mirror of revolution it is the vertex that counts. The outline
gives it for an upright axis: a tilt of the mirror moves its rim aside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw
from skimage.measure import blur_effect

from phibench.calibration.outline.ball_circle import BallCircle, find_circle
from phibench.calibration.outline.contour import aside_by_tilt_m
from phibench.calibration.outline.edge_ring import Circle
from phibench.calibration.outline.first_circle import grey, rig_circle
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline import find_outline
from phibench.calibration.outline.outline_result import Outline
from phibench.calibration.rig.edge_meeting import CameraTilt, EdgeMeeting, edge_meeting, stated_tilt, with_vertical
from phibench.calibration.rig.outline_picture import overlay, shown_picture, write_picture
from phibench.calibration.rig.sphere_options import SphereOptions
from phibench.calibration.rig.vertical_edges import MIN_EDGES, edges_about, measured_vertical
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import light_of, rgb_picture
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.rig import Rig

_SIGNIFICANT = 2.5  # of a distance in two axes: 4 % of aligned mirrors are further off
_CENTRE, _MOVE = (0, 255, 0), (255, 60, 60)
_EDGE, _TO_MEETING = (0, 200, 255), (0, 110, 160)
_EDGES_LEGEND = "blue: vertical edges, and their lines"
_CONTRADICTED = 13.8  # chi^2 of two degrees of freedom: 0.1 % of true statements give more
_SQUARE = 0.65  # of the outline's radius: half a square whose corners stay inside the mirror
_RADIUS_MM, _DISTANCE_MM = 60.0, 260.0  # the paper's mirror, and the default rig's distance
_NEAREST, _FARTHEST_MM = 1.02, 1e4  # in radii; nearer, the lens is at the mirror
_STRETCHED = 0.04  # of a diameter over the other: a sphere 16 degrees off the axis
_ARROW_TIMES = 20.0  # the move is a few pixels: the picture draws it larger


@dataclass(frozen=True)
class Alignment:
    """Move of the mirror.

    Attributes
    ----------
    move_world_m : shape (3,), horizontal
    move_camera_m : shape (3,), the same in the camera's axes: x to the right in the image, y down
    move_px : shape (2,), by which the outline's centre will move
    sigma_outline_m, sigma_m : float
        Standard deviation along each horizontal axis: from the image alone, and with tilt and principal point.
    outline : Outline
    camera : CameraTilt
    meeting : EdgeMeeting or None
        Where the room's vertical edges pass; None where they were not used, or there are too few.
    """

    move_world_m: Array
    move_camera_m: Array
    move_px: Array
    sigma_outline_m: float
    sigma_m: float
    outline: Outline = field(repr=False)
    camera: CameraTilt = field(repr=False)
    meeting: EdgeMeeting | None = field(default=None, repr=False)


def rig_of_numbers(image: NDArray[Any], card: SensorCard, numbers: SphereOptions) -> Rig | None:
    """Rig of a picture by numbers, those of the default rig where they are not given.

    None for a picture of another size than the default camera's, if no focal length is given.

    Raises
    ------
    DatasetError
        If a number needs the focal length, or the mirror is nearer than it can be.
    ImageError
        If a principal point is missing, or the outline that would tell the distance is not found.
    """
    rig, (height, width) = Rig(), image.shape[:2]
    radius_mm = _RADIUS_MM if numbers.radius_mm is None else numbers.radius_mm
    whole = (height, width) == (rig.camera.height_px, rig.camera.width_px)
    if numbers.focal_px is None and not whole:
        for option in ("--cx-px", "--cy-px", "--distance-mm"):
            if option in numbers.given():
                value = numbers.given()[option]
                raise DatasetError(f"{option} {value:g}: needs --focal-px, the focal length in pixels of this picture")
        return None
    focal_px = rig.camera.fx_px if numbers.focal_px is None else numbers.focal_px
    centre = nominal_centre(image, rig.camera, numbers.cx_px, numbers.cy_px)
    distance_mm = numbers.distance_mm
    if distance_mm is None:
        distance_mm = _DISTANCE_MM if whole else 1e3 * distance_of(circle_of(image, card), focal_px, 1e-3 * radius_mm)
    if not _NEAREST * radius_mm < distance_mm <= _FARTHEST_MM:
        raise DatasetError(
            f"--radius-mm {radius_mm:g}, --distance-mm {distance_mm:g}: the mirror's centre must be {_NEAREST} radii "
            f"to {1e-3 * _FARTHEST_MM:g} m from the lens"
        )
    focus_mm = distance_mm - 0.5 * radius_mm if numbers.focus_mm is None else numbers.focus_mm
    camera = replace(
        rig.camera,
        width_px=width,
        height_px=height,
        pixel_pitch_um=rig.camera.pixel_pitch_um * rig.camera.width_px / width,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=centre[0],
        cy_px=centre[1],
        focus_distance_m=1e-3 * focus_mm,
    )
    pose = replace(rig.T_camera_sphere, translation_m=(0.0, 0.0, 1e-3 * distance_mm))
    return Rig(camera=camera, mirror=SphereMirror(radius_m=1e-3 * radius_mm), T_camera_sphere=pose)


def nominal_centre(
    image: NDArray[Any], whole: Camera, cx_px: float | None = None, cy_px: float | None = None
) -> tuple[float, float]:
    """Nominal principal point (u, v), pixels: as given, or that of the whole camera.

    Raises
    ------
    ImageError
        If it is not given and the image is no whole frame: a cropped or shrunk one has its principal point elsewhere.
    """
    height, width = image.shape[:2]
    if (cx_px is None or cy_px is None) and (width, height) != (whole.width_px, whole.height_px):
        raise ImageError(
            f"the picture has {width} x {height} pixels: a whole frame has {whole.width_px} x {whole.height_px}, and "
            "one that was cut or shrunk has its principal point elsewhere; give a whole frame, or --cx-px, --cy-px and "
            "--focal-px"
        )
    return (whole.cx_px if cx_px is None else cx_px, whole.cy_px if cy_px is None else cy_px)


def alignment(
    image: NDArray[Any],
    rig: Rig,
    card: SensorCard | None = None,
    tilt_sigma_rad: float = math.radians(0.1),
    principal_point_sigma_px: float = 5.0,
    outline_sigma_factor: float = 1.0,
    mirror_tilt_sigma_rad: float = math.radians(0.5),
    vertical: bool = True,
) -> Alignment:
    """Move that centres the mirror, with its standard deviation.

    Parameters
    ----------
    image, rig, card : see `outline.outline.find_outline`
    tilt_sigma_rad : float
        How well the camera is known to be vertical, each axis.
    principal_point_sigma_px : float
        How well its principal point is known, each axis.
    outline_sigma_factor : float
        Widens the outline's standard deviation, which was checked in the room `lab` and in rooms like it.
    mirror_tilt_sigma_rad : float
        How well the axis of a mirror of revolution is known to be upright, each axis; of no effect for a sphere.
    vertical : bool
        Use the room's vertical edges, where three or more agree.

    Raises
    ------
    ImageError
        If the image shows no whole mirror, or a standard deviation is below 0.
    """
    if not (tilt_sigma_rad >= 0.0 and principal_point_sigma_px >= 0.0 and mirror_tilt_sigma_rad >= 0.0):
        raise ImageError("the standard deviations of tilts and principal point must be 0 or above")
    outline = find_outline(image, rig, card).widened(outline_sigma_factor)
    s, R, camera = outline.sphere_in_camera_m, rig.T_world_camera.R, rig.camera
    known, meeting = stated_tilt(rig, tilt_sigma_rad, principal_point_sigma_px), None
    if vertical:
        known, meeting = _by_edges(known, image, outline, rig, card)
    beside, doubt_m2 = known.beside_m(s, np.array([camera.fx_px, camera.fy_px]))
    move = -(R @ beside) * (1.0, 1.0, 0.0)
    in_camera = R.T @ move
    own = R @ outline.covariance_m2 @ R.T
    sigma_outline = float(np.sqrt(0.5 * (own[0, 0] + own[1, 1])))
    doubt = float(np.sqrt(0.5 * np.trace(doubt_m2)))
    if rig.mirror.has_rim:
        doubt = math.hypot(doubt, mirror_tilt_sigma_rad * aside_by_tilt_m(rig))
    move_px = camera.project(s + in_camera) - camera.project(s)
    return Alignment(move, in_camera, move_px, sigma_outline, math.hypot(sigma_outline, doubt), outline, known, meeting)


def _by_edges(
    stated: CameraTilt, image: NDArray[Any], outline: Outline, nominal: Rig, card: SensorCard | None
) -> tuple[CameraTilt, EdgeMeeting | None]:
    """The camera's tilt by the vertical edges of a picture, and where they pass; as stated without any."""
    rig = outline.rig(nominal)
    circle = rig_circle(rig)
    try:
        edges = edges_about(grey(planes_of(image, card)), circle)
        meeting = edge_meeting(edges, circle)
        return with_vertical(stated, nominal, measured_vertical(edges, rig, outline.covariance_m2)), meeting
    except ImageError:
        return stated, None


def write_alignment_picture(path: Path, image: NDArray[np.uint8], rig: Rig, found: Alignment) -> Path:
    """Draw the outline with its residuals, its centre and the move, both enlarged, into a copy of the image; PNG."""
    drawn = overlay(image, rig, found.outline)
    draw = ImageDraw.Draw(drawn.picture)
    u, v = drawn.rig.camera.project(found.outline.sphere_in_camera_m)
    du, dv = _ARROW_TIMES * drawn.times * found.move_px
    draw.ellipse((u - 3, v - 3, u + 3, v + 3), outline=_CENTRE)
    draw.line((u, v, u + du, v + dv), fill=_MOVE, width=2)
    turn, head = math.atan2(dv, du), min(10.0, 0.5 * math.hypot(du, dv))
    for side in (-0.4, 0.4):
        back = (u + du - head * math.cos(turn + side), v + dv - head * math.sin(turn + side))
        draw.line((u + du, v + dv, *back), fill=_MOVE, width=2)
    if found.meeting is None:
        return drawn.write(path, f"red: move x {_ARROW_TIMES:g}")
    _draw_edges(draw, found.meeting, round(1.0 / drawn.times))
    return drawn.write(path, f"red: move x {_ARROW_TIMES:g}", _EDGES_LEGEND)


def _draw_edges(draw: ImageDraw.ImageDraw, meeting: EdgeMeeting, block: int) -> None:
    """Draw vertical edges, and thinly their lines to where they meet, with `block` pixels of the frame in one."""
    u, v = (meeting.uv_px + 0.5) / block - 0.5
    for edge in meeting.edges:
        points = [tuple(point) for point in (edge + 0.5) / block - 0.5]
        draw.line([points[0], (u, v)], fill=_TO_MEETING, width=1)
        draw.line(points, fill=_EDGE, width=3)


def circle_of(image: NDArray[Any], card: SensorCard) -> BallCircle:
    """Outline of the mirror as a circle, from a picture alone: no number of camera or rig is used.

    Raises
    ------
    ImageError
        If no outline is found.
    """
    table = light_of(np.arange(256) / 255.0, card).astype(np.float32)
    return find_circle(table[rgb_picture(image, card)])


def distance_of(circle: BallCircle, focal_px: float, radius_m: float) -> float:
    """Distance of a mirror's centre from the lens, metres: |s| = R / sin(a0), tan(a0) = radius / focal length."""
    return radius_m / math.sin(math.atan(circle.circle_px[2] / focal_px))


def meeting_of(image: NDArray[Any], card: SensorCard, circle: BallCircle) -> EdgeMeeting | None:
    """Point through which vertical edges pass, of an unknown camera; None where fewer than three agree."""
    try:
        return edge_meeting(edges_about(grey(planes_of(image, card)), circle.circle_px), circle.circle_px)
    except ImageError:
        return None


def sharpness(image: NDArray[Any], card: SensorCard | None, circle: Circle) -> float:
    """Sharpness of what the mirror shows, 0 to 1: one less the blur of F. Crete et al., Proc. SPIE 6492, 64920I (2007).

    It compares neighbouring pixels before and after a blur, in the square inside the outline. Noise hardly changes
    where it is largest, as it does that of gradients. Pictures of one scene and exposure can be compared.
    """
    u, v, half = round(circle[0]), round(circle[1]), max(int(_SQUARE * circle[2]), 1)
    inside = grey(planes_of(image, card))[max(v - half, 0) : v + half, max(u - half, 0) : u + half]
    return 1.0 - float(blur_effect(inside)) if min(inside.shape) > 0 else math.nan  # type: ignore[no-untyped-call]


def circle_in_words(circle: BallCircle) -> str:
    """Centre and radius with their standard deviations, and what is missing for a move in millimetres."""
    (u, v, radius), (su, sv, sr) = circle.circle_px, circle.sigma_px
    return (
        f"outline: centre ({u:.1f} +- {su:.1f}, {v:.1f} +- {sv:.1f}) px, radius {radius:.1f} +- {sr:.1f} px, with "
        f"edges on {100.0 * circle.edges:.0f} % of it{_stretch_in_words(circle)}; for a move in mm give --focal-px, "
        "--cx-px and --cy-px"
    )


def _stretch_in_words(circle: BallCircle) -> str:
    """Clause on an outline that is no circle; "" where it is one."""
    e1, e2 = circle.ellipse_px
    longer = 2.0 * math.hypot(e1, e2) / circle.circle_px[2]
    if longer < _STRETCHED:
        return ""
    angle = math.degrees(0.5 * math.atan2(e2, e1))
    return (
        f"; doubtful: it is an ellipse, {100.0 * longer:.0f} % longer along {angle:.0f} deg from the image's x towards "
        "y: the picture was stretched, its pixels are not square, or the ball is far from the middle of a wide lens"
    )


def write_circle_picture(
    path: Path, image: NDArray[np.uint8], card: SensorCard, circle: BallCircle, meeting: EdgeMeeting | None = None
) -> Path:
    """Draw an outline, and vertical edges with their lines, into a copy of the image of at most 1600 px; PNG."""
    picture, block = shown_picture(rgb_picture(image, card))
    points = [tuple(point) for point in (circle.points_px + 0.5) / block - 0.5]
    draw = ImageDraw.Draw(picture)
    draw.line([*points, points[0]], fill=_CENTRE, width=2)
    if meeting is not None:
        _draw_edges(draw, meeting, block)
    return write_picture(path, picture)


def edges_in_words(meeting: EdgeMeeting | None, outline_sigma_px: float = 0.0) -> str:
    """The paper's check in one sentence: where vertical edges pass the middle of the outline."""
    if meeting is None:
        return (
            f"vertical edges (the paper's check): fewer than {MIN_EDGES} agree, so that the check says nothing; show "
            "the mirror a room with door frames, corners or shelves"
        )
    sigma = math.hypot(meeting.sigma_px, outline_sigma_px)
    off = meeting.off_px / sigma
    right, down = meeting.uv_px - meeting.centre_px
    return (
        f"vertical edges (the paper's check): {len(meeting.edges)} meet {meeting.off_px:.1f} +- {sigma:.1f} px from "
        f"the middle of the mirror's outline ({_aside(right, down)}): "
        + ("they pass through it" if off < _SIGNIFICANT else "they miss it: mirror and lens are not on one vertical")
    )


def camera_in_words(found: Alignment) -> str:
    """Words of the camera's tilt by the edges."""
    camera = found.camera
    if camera.chi2 is None:
        return "camera: as stated; no vertical edges were used"
    x, y = np.degrees(camera.tilt_rad)
    sigma = math.degrees(float(np.sqrt(0.5 * np.trace(camera.covariance[:2, :2]))))
    doubt = "" if camera.chi2 < _CONTRADICTED else "; doubtful: the edges contradict the stated standard deviations"
    return (
        f"camera: with the edges its vertical is ({x:+.2f}, {y:+.2f}) +- {sigma:.2f} deg from the nominal one, along x "
        f"and y of the image{doubt}"
    )


def sharpness_in_words(value: float) -> str:
    """Sharpness, and what to do with it."""
    return f"sharpness in the mirror: {value:.3f}; turn the lens until it is largest, in pictures of the same scene"


def alignment_verdict(found: Alignment) -> str:
    """Judgement in one sentence: centred or not, and how well the outline fits."""
    off = _off_sigmas(found)
    mark = (
        "mirror centred, as far as the camera is known: no move is needed"
        if off < _SIGNIFICANT
        else "mirror off centre: move it"
    )
    outline = found.outline
    by_edge = "; by the edge in the picture alone: the light beside it did not fit" if outline.by_edge else ""
    return (
        f"{mark} ({off:.1f} standard deviations); outline residual {outline.shift_rms_px:.2f} px rms over "
        f"{100.0 * outline.arc:.0f} % of it{by_edge}"
    )


def in_words(found: Alignment) -> str:
    """Return the instruction for the person at the rig."""
    size = float(np.linalg.norm(found.move_world_m))
    x, y = (1e3 * float(v) for v in found.move_world_m[:2])
    right, down = (float(v) for v in found.move_px)
    lead = "move the mirror by" if _off_sigmas(found) >= _SIGNIFICANT else "measured, and perhaps chance: a move by"
    return (
        f"{lead} {1e3 * size:.2f} mm (world x {x:+.2f} mm, y {y:+.2f} mm); in the image its outline moves "
        f"{_aside(right, down)}; standard deviation {1e3 * found.sigma_m:.2f} mm per axis, of which "
        f"{1e3 * found.sigma_outline_m:.3f} mm are the image's"
    )


def _off_sigmas(found: Alignment) -> float:
    """Length of the move over its standard deviation."""
    return float(np.linalg.norm(found.move_world_m)) / found.sigma_m if found.sigma_m > 0.0 else math.inf


def _aside(right_px: float, down_px: float) -> str:
    """A step in the image in words."""
    return (
        f"{abs(right_px):.1f} px {'right' if right_px >= 0 else 'left'} and {abs(down_px):.1f} px "
        f"{'down' if down_px >= 0 else 'up'}"
    )
