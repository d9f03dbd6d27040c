"""Export of a sample as Mitsuba scenes that an unmodified Mitsuba opens, with what phibench has in the same pixels.

One folder holds both stroke positions, each with all its light, the room's alone and the laser spot alone. Beside them
lie our own layers as radiance in the same pixels, and a README that says what a scene does not carry.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.datasets.scene.scene_gltf import scene_glb
from phibench.datasets.scene.scene_xml import write_scene
from phibench.datasets.store.files import require_writable, write_bytes, write_text
from phibench.datasets.store.layers import write_exr
from phibench.render.plugins.plugin_tree import Plugin, mitsuba_dict
from phibench.render.plugins.standard_scene import LIGHTS, Light, carried, etendue, standard_scene
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import Room

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
    losses = tuple(what_is_lost(sample.view(positions[0]), sample.room))
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
    """Radiance in the pixels of the carried camera, shape (H, W, 3), of electrons/s in those of the camera."""
    scene = carried(camera)
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    pixels = np.stack([u, v], axis=-1)
    if scene == camera:
        return electrons_per_s / etendue(camera, pixels)
    xy = camera.normalised(pixels)
    cos2 = 1.0 / (1.0 + np.sum(xy * xy, axis=-1))
    area = np.pi * camera.aperture_radius_m**2 * camera.solid_angle_density(xy)
    ours = electrons_per_s / ((area * cos2**2)[..., None] * np.array(camera.detector.band_electrons_per_joule()))
    return np.stack([in_carried_pixels(camera, ours[..., k]) for k in range(3)], axis=-1)


def in_carried_pixels(camera: Camera, plane: Array, order: int = 1) -> Array:
    """Plane of an image, shape (H, W), in the pixels of the carried camera; NaN beyond the image.

    `order` 1 is bilinear, 0 takes the nearest pixel.
    """
    scene = carried(camera)
    if scene == camera:
        return plane
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    places = camera.to_pixel(scene.normalised(np.stack([u, v], axis=-1)))
    at = [places[..., 1], places[..., 0]]
    return np.asarray(ndimage.map_coordinates(plane, at, order=order, cval=np.nan))


def what_is_lost(view: View, room: Room) -> list[str]:
    """Sentences on what the scene of a view does not carry."""
    camera, scene = view.rig.camera, carried(view.rig.camera)
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
    camera = carried(sample.rig.camera)
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
