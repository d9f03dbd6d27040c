"""Interactive page of a sample: frames, truth of pixels, epipolar lines, 3-D room; and parts that other pages share.

One HTML file with one script of its own. It opens from disk and fetches nothing. Truth planes travel as 16-bit numbers
with a stated step, the same number of pixels as the image: what the page shows at a pixel is the truth plane's value
there, rounded to that step. `sample_page.js` draws images, `sample_room.js` the room.
Frame (`page_frame.html`), style and tools are shared with the page of a dense answer.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.frame_source import Frame
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.store.files import write_text
from phibench.render.optics.faces import IntArray
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points, onward_ways
from phibench.render.sensor.processing import eight_bit
from phibench.render.sensor.srgb import srgb_encoded
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.shapes import Bitmap, Cuboid, Mesh, Prism, Rectangle, Shape, faces

STEPS = {
    "x_m": 1e-3,
    "y_m": 1e-3,
    "z_m": 1e-3,
    "depth_m": 1e-3,
    "path_m": 1e-3,
    "phi_ray_rad": 2.5e-5,  # half a step is 0.003 px of the default rig
    "azimuth_rad": 1e-4,
}
"""Step of each truth plane in the page. Lengths take twice, four times, ... of it in rooms that need more than 65 m."""
MOST_CODE = 65_534
"""Largest 16-bit code of a value; the next one says that there is none."""
_SHARED = ("page_tools.js", "sample_room.js")
_GRID_PX = 16  # between the reflection points that the 3-D view interpolates
_LINE_POINTS = 400  # of an epipolar line: no corner is seen
_NEAREST_M, _FARTHEST_M = 0.01, 1000.0  # along the ray of an epipolar line
_MARKS_M = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0)  # distances D marked on it
_MOST_TRIANGLES = 1500  # of one mesh; a larger one is drawn as the box around it
_LAMP = (255, 250, 215)


def sample_of(dataset: Dataset, name: str | None) -> Sample:
    """Sample of a number, counted from 0, or an id; the first one for None.

    Raises
    ------
    DatasetError
        If there is none.
    """
    return dataset.chosen(["0" if name is None else name])[0]


def write_sample_page(sample: Sample, path: str | Path) -> Path:
    """Write the page of a sample; return the file's path.

    Raises
    ------
    DatasetError
        If a layer cannot be read or the file cannot be written.
    """
    try:
        return write_text(Path(path), sample_page(sample))
    except OSError as error:
        raise DatasetError(f"the page was not written: {error}, for example `--html sample.html`") from error


def sample_page(sample: Sample) -> str:
    """HTML text of the page of a sample."""
    return filled_page(Path(__file__).with_suffix(".html"), "phibench sample", page_data(sample))


def filled_page(body: Path, title: str, data: dict[str, Any]) -> str:
    """Page with a body from a file, in the frame, style and scripts of all pages; its own style and script lie beside.

    Parameters
    ----------
    body : HTML; the script has the same name with .js, the style, if there is one, with .css
    data : what the script finds as JSON
    """
    here = Path(__file__)
    own_style = body.with_suffix(".css")
    styles = [here.with_name("page_style.css"), *([own_style] if own_style.is_file() else [])]
    scripts = [*(here.with_name(name) for name in _SHARED), body.with_suffix(".js")]
    parts = {
        "@TITLE@": title,
        "@STYLE@\n": "".join(file.read_text(encoding="utf-8") for file in styles),
        "@BODY@\n": body.read_text(encoding="utf-8"),
        # "<" would end the script where a name holds "</script>"
        "@DATA@": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "@SCRIPT@\n": "\n".join(file.read_text(encoding="utf-8") for file in scripts),
    }
    page = here.with_name("page_frame.html").read_text(encoding="utf-8")
    for mark, text in parts.items():
        page = page.replace(mark, text)
    return page


def page_data(sample: Sample) -> dict[str, Any]:
    """All that the page shows, as JSON holds it; angles in radians, lengths in metres, images as base64."""
    row = sample.row
    frames = sample.camera_frames("mjpeg", laser_off=True).by_name
    return {
        "id": row.sample_id,
        "dataset": sample.dataset.info.name,
        "depth_m": row.centre_depth_m,
        "stroke_m": row.stroke_m,
        "objects": list(sample.object_names),
        "views": {p: _view(sample, p, frames[p], frames[f"{p}_off"]) for p in POSITIONS},
        "scene": scene_of(sample),
    }


def _view(sample: Sample, position: str, on: Frame, off: Frame) -> dict[str, Any]:
    row, camera = sample.truth_row(position), sample.rig.camera
    light = row.centre  # what scores refer to
    assert on.jpeg is not None
    assert off.jpeg is not None
    other = next(p for p in POSITIONS if p != position)
    return {
        "width": camera.width_px,
        "height": camera.height_px,
        "on": base64_text(on.jpeg),
        "off": base64_text(off.jpeg),
        "exposure_s": on.sensor.exposure_s,
        "visible": row.visible,
        "cause": row.cause,
        "mark": [light.u_px, light.v_px] if np.isfinite(light.u_px) else None,
        "axis": [row.u_px, row.v_px] if np.isfinite(row.u_px) else None,
        "phi_ray_rad": light.phi_ray_rad if np.isfinite(light.phi_ray_rad) else None,
        "outline": _pixels(sample.rig.outline_px(180)),  # camera and mirror move as one
        "line": epipolar_line(sample, other),
        "spot": _spot(sample, position),
        "planes": _planes(sample.truth(position)),
        "reflection": reflection_grid(sample.view(position)),
    }


def epipolar_line(sample: Sample, position: str) -> dict[str, Any] | None:
    """Curve, in the other image, of the ray that the mirror sends towards the spot's light at `position`.

    The ray is the last straight part of the way to the light, prolonged to 1000 m. None without a reflection.

    Returns
    -------
    line : {"points": list of (u, v) in pixels or None, "marks": list of (D in metres, u, v)}
    """
    view = sample.view(position)
    other = sample.view(next(p for p in POSITIONS if p != position))
    light = np.array([sample.truth_row(position).centre.place_world_m])
    spot = light if np.isfinite(light).all() else np.array([sample.row.spot_world_m])
    points = mirror_points(view, spot, view.camera_centre_m[None])
    if not np.isfinite(points.points_m).all():
        return None  # the mirror does not show it
    start, end = (leg[0] for leg in onward_ways(view, points, spot).legs[-1])
    reach = float(np.linalg.norm(end - start))
    along = np.sort(np.append(np.geomspace(_NEAREST_M, _FARTHEST_M, _LINE_POINTS), reach))
    direction = (end - start) / reach
    centre = sample.rig.at(0.0).sphere_centre_m
    marks = [(d, t) for d in _MARKS_M if (t := _length_at(start, direction, centre, d)) is not None]
    uv = _seen_at(other, start + np.array([*along, *(t for _, t in marks)])[:, None] * direction)
    return {
        "points": _pixels(uv[: len(along)]),
        "marks": [[d, *place] for (d, _), place in zip(marks, _pixels(uv[len(along) :]), strict=True) if place],
    }


def _length_at(start: Array, direction: Array, centre: Array, depth_m: float) -> float | None:
    """Length along a ray at which its horizontal distance from the vertical through the centre is D, on its way out."""
    a = float(direction[:2] @ direction[:2])
    b = float((start - centre)[:2] @ direction[:2])
    c = float((start - centre)[:2] @ (start - centre)[:2]) - depth_m**2
    if a == 0.0 or b * b - a * c < 0.0:
        return None  # the ray never comes so near to the axis
    t = (-b + (b * b - a * c) ** 0.5) / a
    return t if t > 0.0 else None


def _seen_at(view: View, points_m: Array) -> Array:
    """Images of world points through the mirror, shape (N, 2); NaN where there is none."""
    points = mirror_points(view, points_m, np.broadcast_to(view.camera_centre_m, points_m.shape))
    mirror = np.where(points.lit[:, None], points.points_m, np.nan)
    return np.asarray(view.rig.camera.project(view.T_world_camera.inverse().points(mirror)))


def _pixels(uv: Array) -> list[list[float] | None]:
    """Pixels to a thousandth, None for what is not there."""
    return [[round(float(u), 3), round(float(v), 3)] if np.isfinite(u + v) else None for u, v in uv]


def _spot(sample: Sample, position: str) -> dict[str, Any] | None:
    """Spot layer: red plane, electrons per second and pixel, in 65 534ths of its peak."""
    window = sample.spot(position)
    planes = window.electrons_per_s
    peak = float(planes.max(initial=0.0))
    if peak <= 0.0:
        return None  # no light of the spot falls on this image
    codes = np.rint(planes[0] / peak * MOST_CODE).astype(np.uint16)
    return {
        "u0": window.u0_px,
        "v0": window.v0_px,
        "width": planes.shape[2],
        "height": planes.shape[1],
        "step": peak / MOST_CODE,
        "data": packed(codes),
    }


def _planes(truth: dict[str, NDArray[Any]]) -> dict[str, dict[str, Any]]:
    """Truth planes as 16-bit codes; `object_id` is the code itself, 65535 where there is nothing."""
    seen = truth["object_id"] >= 0
    result = {"object_id": {"step": 1, "offset": 0, "data": packed(np.where(seen, truth["object_id"], MOST_CODE + 1))}}
    for name, step in STEPS.items():
        values = np.where(seen, truth[name], 0.0).astype(float)
        span = float(values.max() - values.min())
        while span > step * MOST_CODE:
            step *= 2.0
        offset = step * np.floor(values.min() / step)  # a multiple of the step: values end in few decimals
        codes = np.where(seen, np.rint((values - offset) / step), 0.0)
        result[name] = {"step": step, "offset": float(offset), "data": packed(codes)}
    return result


def packed(codes: Array | NDArray[np.uint16]) -> str:
    """16-bit codes, shape (H, W), as base64: differences along rows, low bytes before high bytes, deflated."""
    rows = np.asarray(codes).astype(np.int64)
    steps = np.diff(rows, axis=1, prepend=0).astype(np.uint16)
    halves = np.stack([steps & 255, steps >> 8]).astype(np.uint8)
    return base64_text(zlib.compress(halves.tobytes(), 9))


def base64_text(data: bytes) -> str:
    """Bytes as text."""
    return base64.b64encode(data).decode("ascii")


def reflection_grid(view: View) -> dict[str, Any]:
    """Reflection points of every 16th pixel, world, metres: rows of (x, y, z) or None. For drawing rays only."""
    camera = view.rig.camera
    v, u = np.mgrid[0 : camera.height_px : _GRID_PX, 0 : camera.width_px : _GRID_PX]
    points = trace_pixels(view, np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).points_m
    return {"columns": u.shape[1], "every_px": _GRID_PX, "points": [_rounded(p, 4) for p in points]}


def _rounded(point: Any, digits: int = 3) -> list[float] | None:
    return [round(float(x), digits) for x in point] if np.isfinite(point).all() else None


# Rig and room in 3-D.


def scene_of(sample: Sample) -> dict[str, Any]:
    """Faces of the room, both places of the rig, and the spot: what the 3-D view draws."""
    down, up = (sample.view(p) for p in POSITIONS)
    shapes = sample.room.shapes(down)
    first, brought = len(shapes) - len(sample.room.brought(down)), sample.room.brought(up)
    moved = [(first + n, shape) for n, shape in enumerate(brought) if shape != shapes[first + n]]
    return {
        "polygons": [*_polygons(list(enumerate(shapes))), *_polygons(moved)],
        "rigs": [_rig_lines(sample, p) for p in POSITIONS],
        "spot": _rounded(sample.row.spot_world_m, 4),
    }


def _rig_lines(sample: Sample, position: str) -> dict[str, Any]:
    """Lens centre, mirror and chief ray of the spot at one position, world, metres."""
    view, row = sample.view(position), sample.truth_row(position)
    way = []
    if np.isfinite(row.reflection_point_world_m).all():
        spot = np.array([sample.row.spot_world_m])
        points = mirror_points(view, spot, view.camera_centre_m[None])
        way = [view.camera_centre_m, *(leg[0][0] for leg in onward_ways(view, points, spot).legs), spot[0]]
    return {
        "position": position,
        "lens": _rounded(view.camera_centre_m, 4),
        "centre": _rounded(view.sphere_centre_m, 4),
        "radius_m": view.rig.mirror.radius_m,
        "mirror": [
            [_rounded(p, 4) for p in view.T_world_sphere.points(line)] for line in view.rig.mirror.drawn_lines()
        ],
        "chief_ray": [_rounded(p, 4) for p in way],
        "visible": row.visible,
    }


def _polygons(shapes: list[tuple[int, Shape]]) -> list[dict[str, Any]]:
    """Plane faces with object id, colour (sRGB) and corners; surfaces of the room first, large ones before small."""
    surfaces = [(number, shape) for number, shape in shapes if isinstance(shape, Rectangle)]
    surfaces.sort(key=lambda entry: -float(np.prod(entry[1].size_m)))
    ordered: list[tuple[int, Shape]] = [*surfaces]
    ordered += [entry for entry in shapes if not isinstance(entry[1], Rectangle)]
    result = []
    for number, shape in ordered:
        colour, two_sided = _colour(shape), isinstance(shape, Mesh) and shape.two_sided
        first = isinstance(shape, Rectangle)
        for corners in _faces(shape):
            face = {"id": number, "rgb": colour, "p": [_rounded(p) for p in corners]}
            result.append(face | ({"front": 1} if first else {}) | ({"both": 1} if two_sided else {}))
    return result


def _faces(shape: Shape) -> Iterator[Array]:
    """Corners of the plane faces, against the clock seen from outside, world."""
    if isinstance(shape, Mesh):
        if len(shape.triangles) > _MOST_TRIANGLES:
            yield from _box_faces(shape.vertices_m.min(axis=0), shape.vertices_m.max(axis=0))
            return
        yield from shape.vertices_m[shape.triangles]
        return
    if isinstance(shape, Prism):
        yield from _prism_faces(shape)
        return
    for side in faces(shape):
        half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(side.size_m)
        yield np.asarray(side.T_world_shape.points(np.column_stack([half, np.zeros(4)])))


def _prism_faces(shape: Prism) -> Iterator[Array]:
    corners, half = shape.corners_m(), 0.5 * shape.height_m
    low, high = (np.column_stack([corners, np.full(len(corners), z)]) for z in (-half, half))
    place = shape.T_world_shape.points
    yield np.asarray(place(high))
    yield np.asarray(place(low[::-1]))
    for k in range(len(corners)):
        n = (k + 1) % len(corners)
        yield np.asarray(place(np.array([low[k], low[n], high[n], high[k]])))


_BOX: IntArray = np.array(
    [[0, 2, 6, 4], [1, 5, 7, 3], [0, 4, 5, 1], [2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5]]
)  # corners by bits z, y, x


def _box_faces(low: Array, high: Array) -> Iterator[Array]:
    corners = np.array([[(low, high)[n >> axis & 1][axis] for axis in range(3)] for n in range(8)])
    yield from corners[_BOX]


def _colour(shape: Shape) -> list[int]:
    """Mean albedo as 8-bit sRGB; lamps are bright, and what shines by its texture has the colour of its light."""
    if isinstance(shape, Rectangle) and shape.emits:
        return list(_LAMP)
    if isinstance(shape.texture, Bitmap):
        albedo = shape.texture.values[..., :3].reshape(-1, 3).mean(axis=0)
        # a picture's light has no albedo: its hue is shown
        albedo = 0.6 * albedo / max(float(albedo.max()), 1e-12) if shape.texture.is_radiance else albedo
    else:
        size = np.array(shape.size_m[:2]) if isinstance(shape, Rectangle | Cuboid | Prism) else np.ones(2)
        # 256 places, even over the shape's face
        places = (np.stack(np.meshgrid(np.arange(16), np.arange(16)), axis=-1).reshape(-1, 2) + 0.5) / 16 - 0.5
        albedo = shape.texture.evaluate(places * size).mean(axis=0)
    return [int(c) for c in eight_bit(srgb_encoded(np.asarray(albedo, float)[:, None, None]))[0, 0]]
