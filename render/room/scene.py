"""Mitsuba scene of a view: shapes, textures, lamps and the mirror as a scene dictionary.

Units are millimetres, with the sphere centre at the origin: in metres with the origin on the floor Mitsuba's ray offset
moves the spot by 0.01 px. Colours are three bands, one for each colour filter of the detector, in Mitsuba's rgb mode.
Layers are per filter, no measured spectra of the room's materials exist, and the laser is handled at its own wavelength
elsewhere: a spectral variant would add colour noise for no gain in truth. The steel's n and k are taken at each band's
wavelength.

A mirror that is no perfect sphere is a triangle mesh, for the reference by path tracing alone. The normals, which steer
the reflection, are those of the surface at the corners and interpolated between. With e the side of a facet and k the
curvature, facets lie within k e^2 / 8 of the surface. With a form error e is R (0.4 degrees): 0.4 micrometres. The cap
of a mirror of revolution has facets of 0.4 degrees around the axis and of pi / 900 rim radii along it: 0.4 micrometres
for a rim radius of 60 mm. Interpolated normals err by some (0.4 degrees)^2 / 8 = 6e-6 rad, which is 0.002 px.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.camera_plugin import MM_PER_M, sensor_dict
from phibench.scenes.faces import face_table
from phibench.scenes.frames import Array, Vector
from phibench.scenes.mirror import MetalSurface, SphereMirror, deviation, level
from phibench.scenes.revolved_mirror import FormedProfile, Profile, RevolvedMirror
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room
from phibench.scenes.shapes import Cuboid, Rectangle, Shape
from phibench.scenes.textures import Bitmap, Texture, Uniform
from phibench.scenes.validation import SceneError

_RINGS, _SPOKES = 450, 900  # 0.4 degrees apart


def grid_mesh(mi: ModuleType, view: View, points_m: Array, normals: Array, bsdf: Any, *, closed: bool) -> Any:
    """Mesh in the scene's coordinates of a grid of points in the mirror's frame.

    Parameters
    ----------
    points_m, normals : arrays, shape (rings, spokes, 3)
        Outside is where spokes times rings point: the side that mirrors.
    bsdf
    closed : bool
        Whether the last spoke has the first beside it.
    """
    axes, (rings, spokes, _) = view.T_world_sphere.R, points_m.shape
    props = mi.Properties()
    props["bsdf"] = bsdf
    triangles = _triangles(rings, spokes, closed)
    mesh = mi.Mesh(MIRROR_NAME, rings * spokes, len(triangles), has_vertex_normals=True, props=props)
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = (MM_PER_M * points_m @ axes.T).ravel().astype(np.float32)
    buffers["vertex_normals"] = (normals @ axes.T).ravel().astype(np.float32)
    buffers["faces"] = triangles.ravel()
    buffers.update()
    return mesh


def _triangles(rings: int, spokes: int, closed: bool) -> NDArray[np.uint32]:
    """Corners of the triangles between the rings, outside first, shape (n, 3)."""
    ring, spoke = np.mgrid[0 : rings - 1, 0 : spokes - (not closed)]
    a, b = spokes * ring + spoke, spokes * ring + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3).astype(np.uint32)


def form_grid(mirror: SphereMirror) -> tuple[Array, Array]:
    """Points and outward unit normals of a mirror with a form error, from pole to pole, shape (rings, spokes, 3)."""
    assert mirror.form is not None
    polar = np.linspace(0.0, np.pi, _RINGS)[:, None]
    turn = np.linspace(0.0, 2.0 * np.pi, _SPOKES, endpoint=False)
    grid = np.broadcast_arrays(np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar))
    n = np.stack(grid, axis=-1)
    points = (mirror.radius_m + deviation(n, mirror.form).value_m)[..., None] * n
    normals = level(points, mirror.radius_m, mirror.form).gradient
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def cap_grid(profile: Profile | FormedProfile, radii_m: Array, turns_rad: Array) -> tuple[Array, Array]:
    """Points and unit normals of a mirror of revolution, shape (rings, spokes, 3), for falling radii."""
    if isinstance(profile, FormedProfile):
        x, y = radii_m[:, None] * np.cos(turns_rad), radii_m[:, None] * np.sin(turns_rad)
        at = profile.heights(x, y)
        normals = np.stack([at.x, at.y, np.full(x.shape, -1.0)], axis=-1)
        return np.stack([x, y, at.z_m], axis=-1), normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    sag = profile.sag(radii_m**2)
    # a cone's tip has the normals of all its spokes
    rise = (
        2.0 * radii_m * sag.slope_per_m
        if profile.shape != "cone"
        else np.full_like(radii_m, (-1.0 - profile.conic) ** -0.5)
    )
    across = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=-1)

    def grid(flat: Array, z: Array) -> Array:
        tall = np.broadcast_to(z[:, None, None], (len(radii_m), len(turns_rad), 1))
        return np.concatenate([flat[:, None, None] * across, tall], axis=-1)

    normals = grid(rise, np.full_like(rise, -1.0))
    return grid(radii_m, sag.z_m), normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def cap_places(profile: Profile) -> tuple[Array, Array]:
    """Radii and turns of the whole cap's grid: rings lie closer towards the rim, where the surface may be steep."""
    angle = np.linspace(0.5 * np.pi, 0.0, _RINGS)
    return profile.rim_radius_m * np.sin(angle), np.linspace(0.0, 2.0 * np.pi, _SPOKES, endpoint=False)


def scene_dict(mi: ModuleType, view: View, room: Room, crop: tuple[int, int, int, int] | None = None) -> dict[str, Any]:
    """Whole scene of one view: sensor, mirror, and every shape of the room under its name.

    A mirror that is no perfect sphere is a fine mesh.
    """
    scene: dict[str, Any] = {"type": "scene", "sensor": sensor_dict(mi, view, crop)}
    scene[MIRROR_NAME] = mirror_entry(mi, view)
    for index, shape in enumerate(room.shapes(view)):
        scene[shape_key(index)] = shape_dict(mi, view, shape)
    return scene


def load_scene(mi: ModuleType, scene: dict[str, Any]) -> Any:
    """Load a scene dictionary so that lamps keep their order, and runs their bits.

    Mitsuba's scene optimisation merges meshes and materials in an order that differs between loads.
    """
    return mi.load_dict(scene, parallel=False, optimize=False)


def shape_key(index: int) -> str:
    """Key of the shape with an object id; sorts like the ids."""
    return f"shape_{index:04d}"


def shape_dict(mi: ModuleType, view: View, shape: Shape) -> Any:
    """One shape with its material; what shines has albedo 0.

    Rectangles are Mitsuba's own, and cuboids without a bitmap. All others are meshes of their faces.
    """
    if not isinstance(shape, Rectangle | Cuboid) or (isinstance(shape, Cuboid) and isinstance(shape.texture, Bitmap)):
        return _faces_mesh(mi, view, shape)
    half = [0.5 * MM_PER_M * length for length in shape.size_m]
    to_world = mi.ScalarTransform4f(_matrix(view, shape)) @ mi.ScalarTransform4f().scale([*half, 1.0][:3])
    kind = "cube" if isinstance(shape, Cuboid) else "rectangle"
    entry: dict[str, Any] = {"type": kind, "to_world": to_world}
    if isinstance(shape.texture, Bitmap) and shape.texture.is_radiance:
        entry["emitter"] = {"type": "area", "radiance": texture_dict(mi, shape.texture, shape.size_m)}
        entry["bsdf"] = {"type": "diffuse", "reflectance": _rgb((0.0, 0.0, 0.0))}
    elif isinstance(shape, Rectangle) and shape.emits:
        # without a material an emitter would reflect: Mitsuba's default has the albedo 0.5
        entry["emitter"] = {"type": "area", "radiance": _rgb(shape.radiance_w_m2_sr)}
        entry["bsdf"] = {"type": "diffuse", "reflectance": _rgb((0.0, 0.0, 0.0))}
    else:
        entry["bsdf"] = _material(shape.coat, texture_dict(mi, shape.texture, shape.size_m))
    return entry


def _faces_mesh(mi: ModuleType, view: View, shape: Shape) -> Any:
    """Mesh of a shape's faces, its corners placed on the texture as `scenes.faces` says."""
    table = face_table([shape])
    corners = table.corners_m.reshape(-1, 3)
    props = mi.Properties()
    texture = shape.texture
    assert not (isinstance(texture, Bitmap) and texture.is_radiance), "Mitsuba takes a mesh's area before it has one"
    albedo = _bitmap_dict(mi, texture) if isinstance(texture, Bitmap) else _rgb(_plain(texture))
    material = _material(shape.coat, albedo)
    two_sided = bool(table.two_sided.any())
    props["bsdf"] = mi.load_dict({"type": "twosided", "material": material} if two_sided else material)
    mesh = mi.Mesh(shape.name, len(corners), len(table.patch), has_vertex_texcoords=True, props=props)
    patch = np.repeat(table.patch, 3)
    local = np.concatenate([table.local_m(patch, corners), np.ones((len(patch), 1))], axis=1)
    texels = texture.values.shape[1::-1] if isinstance(texture, Bitmap) else (1, 1)
    uv = np.einsum("nij,nj->ni", table.texels[patch], local) / texels
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = to_scene_mm(view, corners).ravel().astype(np.float32)
    buffers["vertex_texcoords"] = uv.ravel().astype(np.float32)
    buffers["faces"] = np.arange(len(corners), dtype=np.uint32)
    buffers.update()
    return mesh


def _material(coat: float, albedo: dict[str, Any]) -> dict[str, Any]:
    """Diffuse ground, below a smooth dielectric coat if that has a refractive index."""
    if coat == 0.0:
        return {"type": "diffuse", "reflectance": albedo}
    return {"type": "plastic", "diffuse_reflectance": albedo, "int_ior": coat, "ext_ior": 1.0, "nonlinear": True}


def _plain(texture: Texture) -> Vector:
    assert isinstance(texture, Uniform)
    return texture.albedo


def _bitmap_dict(mi: ModuleType, texture: Bitmap) -> dict[str, Any]:
    """Bitmap as Mitsuba's: linear values, repeated."""
    image = mi.Bitmap(np.array(texture.values[..., :3]))  # a copy in any case: one texel's slice would be read-only
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def mirror_entry(mi: ModuleType, view: View) -> Any:
    """The steel mirror: a sphere at the origin, or a mesh."""
    mirror = view.rig.mirror
    bsdf = mirror_bsdf(mirror, view.rig.camera.detector.band_wavelength_nm)
    if isinstance(mirror, RevolvedMirror):
        grid = cap_grid(mirror.surface, *cap_places(mirror.profile))
    elif mirror.form is not None:
        grid = form_grid(mirror)
    else:
        return {"type": "sphere", "center": [0.0, 0.0, 0.0], "radius": MM_PER_M * mirror.radius_m, "bsdf": bsdf}
    return grid_mesh(mi, view, *grid, mi.load_dict(bsdf), closed=True)


def mirror_bsdf(mirror: MetalSurface, wavelengths_nm: Vector) -> dict[str, Any]:
    """Smooth or rough conductor with the metal's n and k at the three bands' wavelengths.

    Of a measured reflectance one that is the same for all angles: a perfect conductor with a factor. Mitsuba has no
    table of angles.
    """
    index = [mirror.refractive_index(nm) for nm in wavelengths_nm]
    table = mirror.reflectance_table
    if table is not None:
        if len(table.angle_deg) != 1 or mirror.roughness_alpha > 0.0:
            raise SceneError("path tracing knows a measured reflectance of one angle and a smooth mirror alone")
        values = [float(mirror.band(nm).values[0]) for nm in wavelengths_nm]
        return {"type": "conductor", "material": "none", "specular_reflectance": _rgb(values)}
    entry: dict[str, Any] = {"eta": _rgb([m.real for m in index]), "k": _rgb([m.imag for m in index])}
    if mirror.roughness_alpha > 0.0:
        return {"type": "roughconductor", "distribution": "beckmann", "alpha": mirror.roughness_alpha, **entry}
    return {"type": "conductor", **entry}


def texture_dict(mi: ModuleType, texture: Texture, size_m: Vector) -> dict[str, Any]:
    """Texture as Mitsuba's rgb, bitmap or checkerboard; a period of the latter is two cells."""
    if isinstance(texture, Uniform):
        return _rgb(texture.albedo)
    if isinstance(texture, Bitmap):
        period = [texture.texel_m[i] * texture.values.shape[1 - i] for i in (0, 1)]
        shift = [-(0.5 * size_m[i] + texture.origin_m[i]) / period[i] for i in (0, 1)]
        scaled = mi.ScalarTransform4f().scale([size_m[0] / period[0], size_m[1] / period[1], 1.0])
        return {**_bitmap_dict(mi, texture), "to_uv": mi.ScalarTransform4f().translate([*shift, 0.0]) @ scaled}
    # uv runs from 0 to 1 over the face, Mitsuba's pattern has the period 1
    scale = [0.5 * size_m[i] / texture.cell_m[i] for i in (0, 1)]
    shift = [-0.5 * (0.5 * size_m[i] + texture.origin_m[i]) / texture.cell_m[i] for i in (0, 1)]
    to_uv = mi.ScalarTransform4f().translate([*shift, 0.0]) @ mi.ScalarTransform4f().scale([*scale, 1.0])
    colours = {"color0": _rgb(texture.albedo_even), "color1": _rgb(texture.albedo_odd)}
    return {"type": "checkerboard", "to_uv": to_uv, **colours}


def to_scene_mm(view: View, points_world_m: Array) -> Array:
    """World points, metres, in Mitsuba's scene: millimetres from the sphere centre."""
    return MM_PER_M * (points_world_m - view.sphere_centre_m)


def _matrix(view: View, shape: Rectangle | Cuboid) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = shape.T_world_shape.R
    matrix[:3, 3] = to_scene_mm(view, shape.T_world_shape.t)
    return matrix


def _rgb(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(x) for x in values]}
