"""Export of a sample: XML scenes for an unmodified Mitsuba, glTF for Blender, our images as radiance, and a README.

One folder holds both stroke positions, each with all its light, the room's alone and the laser spot alone. Beside them
lie our own layers as radiance in the same pixels, and a README that says what a scene does not carry.

Numbers of the XML are written so that they read back exactly. Its meshes (PLY) and pictures (PFM) are named after the
shape and their contents: both stroke positions share what is the same.

The glTF is that of rooms (`gltf_export`) with the rig, one node each: the mirror is a mesh of a smooth metal, whose
colour is its reflectance in the three bands at normal incidence. glTF's camera has a pinhole in the image's middle,
without a principal point, distortion or focus. The spot is a disc of its diameter that shines red.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy import ndimage

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.datasets.rooms.gltf_export import GltfWriter, y_up
from phibench.datasets.store.files import require_writable, write_bytes, write_text
from phibench.datasets.store.layers import write_exr
from phibench.render.plugins.plugin_tree import BitmapPlugin, Plugin, Rgb, SceneSetting, Triangles, Value, mitsuba_dict
from phibench.render.plugins.room_plugins import grid_triangles
from phibench.render.plugins.standard_scene import LIGHTS, Light, etendue, exported_camera, standard_scene
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import MIRROR_NAME, Room

README = "README.md"


@dataclass(frozen=True)
class ExportedScene:
    """Files of an export, and what its scenes do not carry."""

    scenes: tuple[Path, ...]
    readme: Path
    losses: tuple[str, ...]


def mitsuba_scene(sample: Sample, position: str = "down", light: Light = "all") -> dict[str, Any]:
    """Scene of a sample as a dictionary for `mi.load_dict`: what `phibench scene export` writes as XML.

    Mitsuba is imported, with phibench's variant, unless the caller has set one; it must be one of the rgb variants.

    Parameters
    ----------
    sample : Sample
        Of `phibench.open_dataset`.
    position : "down" or "up"
    light : "all", "ambient" or "spot"

    Raises
    ------
    SceneError
        If no standard plugin reflects as the mirror does.
    """
    mi = sys.modules.get("mitsuba")
    return mitsuba_dict(mi if mi is not None and mi.variant() else activate(), sample_scene(sample, position, light))


def sample_scene(sample: Sample, position: str, light: Light = "all") -> Plugin:
    """Tree of a sample's scene."""
    if light not in LIGHTS:
        raise DatasetError(f"light '{light}': must be {', '.join(LIGHTS)}")
    return standard_scene(sample.view(position), sample.room, sample.laser_spot, light)


def export_scene(sample: Sample, out: Path, positions: Sequence[str] = POSITIONS) -> ExportedScene:
    """Write the scenes of a sample to a folder: XML, meshes, pictures, our own layers as radiance, and a README.

    Raises
    ------
    DatasetError
        If the folder holds something else, or cannot be written.
    SceneError
        If no standard plugin reflects as the mirror does.
    """
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / README).is_file())):
        raise DatasetError(f"{out} is there and is no exported scene: give a new folder")
    require_writable(out / README)
    trees = {(position, light): sample_scene(sample, position, light) for position in positions for light in LIGHTS}
    scenes = []
    for (position, light), tree in trees.items():
        scenes.append(write_scene(out / scene_file(position, light), tree))
        planes = dict(zip("RGB", expected_radiance(sample, position, light), strict=True))
        header = {"sample_id": sample.row.sample_id, "position": position, "light": light, "unit": "W/(m^2 sr)"}
        write_exr(out / expected_file(position, light), planes, header)
    for position in positions:
        view = sample.view(position)
        write_bytes(out / f"{position}.glb", scene_glb(view, sample.room, sample.laser_spot))
    losses = tuple(loss_sentences(sample.view(positions[0]), sample.room))
    return ExportedScene(tuple(scenes), write_text(out / README, _readme(sample, positions, losses)), losses)


def scene_file(position: str, light: Light) -> str:
    """Name of a scene's XML file."""
    return f"{position}.xml" if light == "all" else f"{position}-{light}.xml"


def expected_file(position: str, light: Light) -> str:
    """Name of the file of our own image of a scene."""
    return scene_file(position, light).replace(".xml", "-phibench.exr")


def expected_radiance(sample: Sample, position: str, light: Light) -> Array:
    """Our image, noise-free, in the pixels of the exported scene, shape (3, H, W), W/(m^2 sr).

    Where the exported camera has other pixels, ours are interpolated; NaN beyond our image.
    """
    camera = sample.rig.camera
    if light == "spot":
        electrons = np.zeros((3, camera.height_px, camera.width_px))
        sample.spot(position).add_to(electrons)
    else:
        electrons = sample.expected_image(position, laser=light == "all")
    return np.moveaxis(as_radiance(camera, np.moveaxis(electrons, 0, -1)), -1, 0)


def as_radiance(camera: Camera, electrons_per_s: Array) -> Array:
    """Radiance in the pixels of the exported camera, shape (H, W, 3), of electrons/s in those of the camera."""
    scene = exported_camera(camera)
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    pixels = np.stack([u, v], axis=-1)
    if scene == camera:
        return electrons_per_s / etendue(camera, pixels)
    xy = camera.normalised(pixels)
    cos2 = 1.0 / (1.0 + np.sum(xy * xy, axis=-1))
    area = np.pi * camera.aperture_radius_m**2 * camera.solid_angle_density(xy)
    ours = electrons_per_s / ((area * cos2**2)[..., None] * np.array(camera.detector.band_electrons_per_joule()))
    return np.stack([in_exported_pixels(camera, ours[..., k]) for k in range(3)], axis=-1)


def in_exported_pixels(camera: Camera, plane: Array, order: int = 1) -> Array:
    """Plane of an image, shape (H, W), in the pixels of the exported camera; NaN beyond the image.

    `order` 1 is bilinear, 0 takes the nearest pixel.
    """
    scene = exported_camera(camera)
    if scene == camera:
        return plane
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    places = camera.to_pixel(scene.normalised(np.stack([u, v], axis=-1)))
    at = [places[..., 1], places[..., 0]]
    return np.asarray(ndimage.map_coordinates(plane, at, order=order, cval=np.nan))


def loss_sentences(view: View, room: Room) -> list[str]:
    """Sentences on what the scene of a view does not carry."""
    camera, scene = view.rig.camera, exported_camera(view.rig.camera)
    lost = [f"The Gaussian blur of the lens, sigma {camera.blur_sigma_px:g} px: pixels are means over their square."]
    distortion = {name: getattr(camera, name) for name in ("k1", "k2", "k3", "p1", "p2")}
    if any(distortion.values()):
        numbers = ", ".join(f"{name} = {value:g}" for name, value in distortion.items() if value)
        lost.append(f"The distortion of the lens: {numbers}. Straight lines stay straight.")
    if scene.fy_px != camera.fy_px:
        lost.append(f"Unlike focal lengths: fy is {scene.fx_px:g} px, the rig's is {camera.fy_px:g} px.")
    if (scene.cx_px, scene.cy_px) != (camera.cx_px, camera.cy_px):
        lost.append(f"A fraction of the principal point: it lies at ({scene.cx_px:g}, {scene.cy_px:g}) px.")
    if room.sun is not None:
        lost.append("The sun, which shines through panes: standard plugins have no such light. The room is darker.")
    if view.tube is not None:
        lost.append("The tube's glass is there, and so are reflections between its faces, which our layers leave out.")
    if any(shape.coat > 0.0 for shape in room.shapes(view)):
        lost.append("Coats that mirror other coats: the scene follows every reflection, our layers one.")
    lost.append("Electrons, noise, colour mosaic and JPEG: they are the sensor's, and follow from the radiance.")
    return lost


def _readme(sample: Sample, positions: Sequence[str], losses: Sequence[str]) -> str:
    position = positions[0]
    camera = exported_camera(sample.rig.camera)
    middle = np.array([[camera.cx_px, camera.cy_px]])
    electrons = ", ".join(f"{value:.6g}" for value in etendue(camera, middle)[0])
    rows = "\n".join(
        f"| `{scene_file(place, light)}` | {place} | {_LIGHT_TEXT[light]} | `{expected_file(place, light)}` |"
        for place in positions
        for light in LIGHTS
    )
    return _README.format(
        sample=sample.row.sample_id,
        name=sample.dataset.info.name,
        rows=rows,
        position=position,
        ambient=scene_file(position, "ambient"),
        rendered=scene_file(position, "ambient").replace(".xml", ".exr"),
        ours=expected_file(position, "ambient"),
        losses="\n".join(f"* {loss}" for loss in losses),
        electrons=electrons,
        fx=camera.fx_px,
        cx=camera.cx_px,
        cy=camera.cy_px,
        depth=sample.row.depth_m,
    )


_LIGHT_TEXT: dict[Light, str] = {
    "all": "the room and the laser spot",
    "ambient": "the room",
    "spot": "the laser spot, in the dark",
}
_README = """# Sample {sample} of the data set {name} as Mitsuba scenes

| scene | stroke position | light | phibench's image |
|---|---|---|---|
{rows}

Mitsuba 3 opens them as they are (`pip install mitsuba`); phibench is not needed:

    mitsuba -m llvm_ad_rgb {ambient}             # or -m scalar_rgb, or -m cuda_ad_rgb; writes {rendered}
    mitsuba -m llvm_ad_rgb -Dspp=16 {ambient}    # a quick look; -Dspp=1024 has less noise

* Lengths are millimetres. The middle of the mirror is the origin, z points up.
* The three channels are the bands of the camera's filters, not colours of a screen: take an rgb variant.
* Pixels are mean radiances, W/(m^2 sr). The spot's radiance is scaled to give the laser's electrons behind each filter.
* The spot's distance D is {depth!r} m.
* `spp`, `max_depth`, `width`, `height` and the `crop_` settings may be changed with -D.
* Leave `-t` away. With `-t 1` or `-t 2`, Mitsuba 3.9.1 waits for ever where it writes OpenEXR.

`{position}.glb` is the same view as glTF, with mirror, camera and spot, for Blender. Its lengths are metres.

## Compare

phibench's images hold the same radiance, without noise. Their lens blurs, so that edges differ and means do not:

    python - <<'END'
    import drjit as dr
    import mitsuba as mi
    mi.set_variant("scalar_rgb")
    theirs, ours = (mi.TensorXf(mi.Bitmap(name))[..., :3] for name in ("{rendered}", "{ours}"))
    known = dr.isfinite(ours)  # beyond phibench's image there is no number
    theirs, ours = (dr.sum(dr.select(known, image, 0.0), axis=(0, 1)) for image in (theirs, ours))
    print("mean of theirs over ours, by band:", theirs / ours)
    END

Photo-electrons per second of a pixel are its radiance times E cos^4. E is {electrons} for the three bands.
The cosine is that of the angle to the optical axis, which meets pixel ({cx:g}, {cy:g}). The focal length is {fx:g} px.

## What the scenes do not carry

{losses}
"""


# -- Mitsuba XML and the files that it names ---------------------------------------------------------------------------

FOLDERS = {"ply": "meshes", "pfm": "pictures"}


def write_scene(path: Path, scene: Plugin) -> Path:
    """Write a scene as XML and its meshes and pictures beside it, each atomically; the XML comes last."""
    return write_text(path, _Writer(path.parent).text(scene))


class _Writer:
    """Lines of one XML file; equal contents are written once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, str] = {}

    def text(self, scene: Plugin) -> str:
        settings = {value.name: value.value for value in scene.all_values() if isinstance(value, SceneSetting)}
        lines = ['<?xml version="1.0" encoding="utf-8"?>', '<scene version="3.0.0">']
        lines += [f'    <default name="{name}" value="{value}"/>' for name, value in settings.items()]
        for name, value in scene.values.items():
            lines += self._lines(name, value, 1)
        return "\n".join([*lines, "</scene>", ""])

    def _lines(self, name: str, value: Value, depth: int) -> Iterator[str]:
        indent = "    " * depth
        if not isinstance(value, Plugin):
            yield f"{indent}{self._line(name, value)}"
            return
        if value.label:
            yield f"{indent}<!-- {value.label.replace('--', '- -')} -->"
        own = f" id={quoteattr(value.name)}" if value.name else "" if depth == 1 else f" name={quoteattr(name)}"
        head = f"{indent}<{value.kind} type={quoteattr(value.type)}{own}"
        if not value.values:
            yield f"{head}/>"
            return
        yield f"{head}>"
        for key, inner in value.values.items():
            yield from self._lines(key, inner, depth + 1)
        yield f"{indent}</{value.kind}>"

    def _line(self, name: str, value: Value) -> str:
        if isinstance(value, np.ndarray):
            if value.ndim == 2:
                return f'<transform name="{name}"><matrix value="{_numbers(value.ravel())}"/></transform>'
            x, y, z = (repr(float(number)) for number in value)
            return f'<point name="{name}" x="{x}" y="{y}" z="{z}"/>'
        if isinstance(value, Rgb):
            return f'<rgb name="{name}" value="{_numbers(np.array(value.values))}"/>'
        if isinstance(value, SceneSetting):
            return f'<integer name="{name}" value="${value.name}"/>'
        if isinstance(value, bool):
            return f'<boolean name="{name}" value="{str(value).lower()}"/>'
        if isinstance(value, int | float):
            return f'<float name="{name}" value="{float(value)!r}"/>'
        if isinstance(value, BitmapPlugin | Triangles):
            value = self._file(value)
        return f"<string name={quoteattr(name)} value={quoteattr(str(value))}/>"

    def _file(self, content: BitmapPlugin | Triangles) -> str:
        """Name of a file with this content; written now if it is not yet."""
        data = content.data()
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._names:
            name = f"{FOLDERS[content.suffix]}/{content.name}-{digest[:8]}.{content.suffix}"
            write_bytes(self._folder / name, data)
            self._names[digest] = name
        return self._names[digest]


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in values)


# -- glTF --------------------------------------------------------------------------------------------------------------

_RINGS, _SPOKES = 91, 180  # of the mirror's mesh, two degrees apart
_SPOT_SIDES = 32  # of the polygon that is shown for the spot
_SPOT_LIFT_M = 1e-4  # off the surface: two faces in one plane flicker


def scene_glb(view: View, room: Room, spot: LaserSpot | None = None) -> bytes:
    """Bytes of a `.glb` file of one view."""
    document = GltfWriter()
    for shape in room.shapes(view):
        document.add(shape)
    _add_mirror(document, view)
    if spot is not None:
        _add_spot(document, spot)
    _add_camera(document, view)
    return document.encoded(room.name)


def _add_mirror(document: GltfWriter, view: View) -> None:
    mirror = view.rig.mirror
    points, normals = mirror.grid(_RINGS, _SPOKES)
    pose = view.T_world_sphere
    bands = view.rig.camera.detector.band_wavelength_nm
    colour = [float(mirror.reflectance(np.array(1.0), nm)) for nm in bands]
    surface = {"metallicFactor": 1.0, "baseColorFactor": [*colour, 1.0]}
    # glTF's roughness is the square root of the microfacets' alpha
    surface["roughnessFactor"] = math.sqrt(mirror.roughness_alpha)
    document.add_mesh(
        MIRROR_NAME,
        pose.points(points.reshape(-1, 3)),
        {"name": MIRROR_NAME, "doubleSided": True, "pbrMetallicRoughness": surface},
        grid_triangles(_RINGS, _SPOKES, closed=True),
        pose.directions(normals.reshape(-1, 3)),
    )


def _add_spot(document: GltfWriter, spot: LaserSpot) -> None:
    a, b = spot.tangents()
    turn = 2.0 * np.pi * np.arange(_SPOT_SIDES) / _SPOT_SIDES
    rim = 0.5 * spot.diameter_m * (np.cos(turn)[:, None] * a + np.sin(turn)[:, None] * b)
    normal = np.array(spot.normal_world)
    points = np.array(spot.position_world_m) + _SPOT_LIFT_M * normal + np.concatenate([np.zeros((1, 3)), rim])
    i = np.arange(_SPOT_SIDES)
    fan = np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % _SPOT_SIDES], axis=-1)
    area_m2 = math.pi * spot.diameter_m**2 / 4.0
    # of a Lambertian disc that sends out all the power that its albedo leaves
    radiance = spot.power_w * (0.7 if spot.albedo is None else spot.albedo) / (math.pi * area_m2)
    document.add_mesh("laser_spot", points, document.emitting("laser_spot", (radiance, 0.0, 0.0)), fan)


def _add_camera(document: GltfWriter, view: View) -> None:
    """Camera of the view; glTF's looks along -z, its y axis up in the image."""
    camera = view.rig.camera
    matrix = np.eye(4)
    matrix[:3, :3] = y_up(view.T_world_camera.R.T).T @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = y_up(view.camera_centre_m)
    document.add_camera(
        "camera",
        {
            "yfov": 2.0 * math.atan(0.5 * camera.height_px / camera.fy_px),
            "aspectRatio": camera.width_px / camera.height_px * camera.fy_px / camera.fx_px,
            "znear": 0.001,  # metres; the mirror is decimetres away
        },
        matrix,
    )
