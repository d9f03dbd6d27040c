"""Video (MP4) of a film for a person: each frame with the exact place of its spot, its path so far, and numbers below.

Whole images are shown some 640 px wide. An enlarged square around the spot stands in the corner that hides least of the
mirror and of the spot's way. Windows are enlarged.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from phibench.datasets.film.film_read import Film, FilmFrame
from phibench.datasets.film.film_video import write_mp4
from phibench.render.sensor.light import Region

Picture = NDArray[np.uint8]
_LINE_PX = 16
_WIDTH_PX = 640
_INSET_SHARE = 0.4  # of the height; beside a mirror's image that fills the height, a corner has room for as much
_INSET_PX = 36  # the spot's surroundings, enlarged
_GREEN, _YELLOW = (80, 255, 80), (255, 210, 60)


def show_film(film: Film, out: Path, preset: str = "mjpeg", draw: int = 0) -> Path:
    """Write a film as an MP4 with overlays."""
    return write_mp4(out, pictures(film, preset, draw), film.plan.scene.times.rate_hz)


def pictures(film: Film, preset: str = "mjpeg", draw: int = 0) -> Iterator[Picture]:
    """Pictures of all frames, shape (h, w, 3)."""
    for number in range(len(film)):
        yield picture(film, film.frame(number, preset, draw))


def picture(film: Film, frame: FilmFrame) -> Picture:
    """One frame with its overlay."""
    colours = _colours(frame)
    if film.info.window_px is None:
        scale = _WIDTH_PX / colours.shape[1]
        size = _WIDTH_PX, round(scale * colours.shape[0])
        whole = Image.fromarray(colours).resize(size, Image.Resampling.BOX)
        _marks(whole, film, frame, frame.region, scale)
        inset = _inset(film, frame, colours, int(_INSET_SHARE * size[1]))
        whole.paste(inset, _emptiest_corner(film, scale, size, inset.size))
        return _with_numbers(whole, film, frame)
    zoom = max(1, 480 // colours.shape[1])  # a window is shown as large as a small video
    size = colours.shape[1] * zoom, colours.shape[0] * zoom
    enlarged = Image.fromarray(colours).resize(size, Image.Resampling.NEAREST)
    _marks(enlarged, film, frame, frame.region, zoom)
    return _with_numbers(enlarged, film, frame)


def _colours(frame: FilmFrame) -> Picture:
    """Image of a frame as sRGB colours; raw pixels as grey, YUYV by its luma."""
    image = frame.image
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(image, np.uint8)
    if image.ndim == 3:  # YUYV
        return np.repeat(image[..., :1], 3, axis=2).astype(np.uint8)
    low, top = frame.sensor.black_level_dn, frame.sensor.top_dn
    # raw pixels are linear in the light
    grey = np.clip((image.astype(float) - low) / (top - low), 0.0, 1.0) ** (1 / 2.2)
    return np.repeat(np.rint(255.0 * grey).astype(np.uint8)[..., None], 3, axis=2)


def _inset(film: Film, frame: FilmFrame, colours: Picture, side_px: int) -> Image.Image:
    """Surroundings of the spot, enlarged to at most `side_px`."""
    row = film.table.row(frame.frame, named=True)
    box = Region.around(row["row_u_px"], row["row_v_px"], film.plan.size, min(_INSET_PX, *film.plan.size))
    zoom = max(1, side_px // max(box.shape))
    cutout = Image.fromarray(colours[box.slices(frame.region)])
    enlarged = cutout.resize((box.shape[1] * zoom, box.shape[0] * zoom), Image.Resampling.NEAREST)
    _marks(enlarged, film, frame, box, zoom)
    ImageDraw.Draw(enlarged).rectangle((0, 0, enlarged.width - 1, enlarged.height - 1), outline=_YELLOW)
    return enlarged


def _emptiest_corner(film: Film, scale: float, size: tuple[int, int], inset: tuple[int, int]) -> tuple[int, int]:
    """Upper left corner of an inset where it hides least of the mirror's image and none of the spot's way, if it can.

    The same in every frame of a film.
    """
    way = film.table.select("row_u_px", "row_v_px").to_numpy()
    outline, track = ((places + 0.5) * scale for places in (film.plan.scene.rig.outline_px(), way))
    mirror = Image.new("1", size)
    ImageDraw.Draw(mirror).polygon([tuple(map(float, point)) for point in outline], fill=1)
    filled, (width, height) = np.asarray(mirror), inset
    corners = [(u, v) for v in (0, size[1] - height) for u in (0, size[0] - width)]

    def hidden(corner: tuple[int, int]) -> tuple[bool, int]:
        u, v = corner
        inside = (track >= (u, v)) & (track <= (u + width, v + height))
        return bool(inside.all(axis=1).any()), int(filled[v : v + height, u : u + width].sum())

    return min(corners, key=hidden)


def _marks(image: Image.Image, film: Film, frame: FilmFrame, region: Region, zoom: float) -> None:
    """Way of the spot so far, and a cross around its exact place now."""
    draw = ImageDraw.Draw(image)
    track = film.table.select("row_u_px", "row_v_px").to_numpy()[: frame.frame + 1]
    # pixel centres are integers: the picture's corner is at -0.5
    points = (track - (region.u0_px, region.v0_px) + 0.5) * zoom
    if len(points) > 1:
        draw.line([tuple(map(float, point)) for point in points], fill=_YELLOW)
    u, v = points[-1]
    far, near = (12.0, 5.0) if zoom >= 1 else (9.0, 4.0)
    for sign in (-1.0, 1.0):
        draw.line((u + sign * near, v, u + sign * far, v), fill=_GREEN)
        draw.line((u, v + sign * near, u, v + sign * far), fill=_GREEN)


def _with_numbers(image: Image.Image, film: Film, frame: FilmFrame) -> Picture:
    """Picture with lines of numbers below."""
    row = film.table.row(frame.frame, named=True)
    lines: tuple[str, ...] = (
        f"frame {frame.frame:3d}  t {row['time_s']:6.3f} s  carriage {1e3 * row['offset_m']:7.1f} mm  "
        f"{1e3 * row['offset_m_per_s']:6.1f} mm/s",
        f"spot ({row['row_u_px']:.2f}, {row['row_v_px']:.2f}) px  {row['row_u_px_per_s']:6.1f} "
        f"{row['row_v_px_per_s']:6.1f} px/s  D {row['depth_m']:.3f} m  laser {row['row_laser_level']:.2f}",
    )
    if film.plan.scene.drive is not None:
        x, y, z = row["rig_world_m"]
        _, pitch, yaw = np.degrees(row["rig_angles_rad"])
        speed, turning = np.linalg.norm(row["rig_m_per_s"]), np.degrees(row["rig_rad_per_s"][2])
        lines += (
            f"robot ({x:6.3f}, {y:6.3f}, {z:6.3f}) m  yaw {yaw:6.1f}  nose up {-pitch:5.1f} deg  "
            f"{speed:5.3f} m/s  {turning:6.1f} deg/s",
        )
    canvas = Image.new("RGB", (max(image.width, 480), image.height + _LINE_PX * len(lines)))
    canvas.paste(image, (0, 0))
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(11)
    for number, text in enumerate(lines):
        draw.text((4, image.height + 1 + _LINE_PX * number), text, fill=(230, 230, 230), font=font)
    return np.asarray(canvas, np.uint8)
