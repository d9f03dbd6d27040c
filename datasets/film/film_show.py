"""Pictures of a film: every frame with the exact place of its spot, the way it takes, and the numbers below.

Whole images are shown at half size, with an enlarged square around the spot in the corner; windows are enlarged.
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
_ZOOM, _INSET_PX = 5, 36  # the spot's surroundings of 36 px, five times as large
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
        whole = Image.fromarray(colours).resize((colours.shape[1] // 2, colours.shape[0] // 2), Image.Resampling.BOX)
        _marks(whole, film, frame, frame.region, 0.5)
        whole.paste(_inset(film, frame, colours), (0, 0))
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


def _inset(film: Film, frame: FilmFrame, colours: Picture) -> Image.Image:
    row = film.table.row(frame.frame, named=True)
    box = Region.around(row["row_u_px"], row["row_v_px"], film.plan.size, min(_INSET_PX, *film.plan.size))
    cutout = Image.fromarray(colours[box.slices(frame.region)])
    enlarged = cutout.resize((box.shape[1] * _ZOOM, box.shape[0] * _ZOOM), Image.Resampling.NEAREST)
    _marks(enlarged, film, frame, box, _ZOOM)
    ImageDraw.Draw(enlarged).rectangle((0, 0, enlarged.width - 1, enlarged.height - 1), outline=_YELLOW)
    return enlarged


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
