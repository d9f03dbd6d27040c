"""Mirror, room, robot, holder, glass tube and lamps as standard Mitsuba plugins.

Plain rectangles and cuboids are Mitsuba's own; every other shape is a mesh of its faces, with the place of its corners
on its texture. Meshes lie in their shape's own frame, those of `Mesh` in the world's, so that both stroke positions
share them. What shines has albedo 0: without a material an emitter would reflect, Mitsuba's default being 0.5.

Mitsuba draws points on a shining texture from its first period, without the transform of its coordinates. A shining
rectangle therefore takes the size of its picture. Walls of a photographed room have one texel beyond each edge, behind
the next wall.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import face_table
from phibench.render.plugins.plugin_tree import BitmapPlugin, Plugin, Rgb, Triangles, Value
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.frames import Array, Pose, Vector
from phibench.scenes.metals import MetalSurface
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room
from phibench.scenes.shapes import Bitmap, Cuboid, Mesh, Rectangle, Shape, Texture, Uniform
from phibench.scenes.validation import SceneError

# Mirror as standard Mitsuba plugins: a sphere, or a fine mesh, of a conductor.
#
# A mirror that is no perfect sphere is a triangle mesh. The normals, which steer the reflection, are those of the
# surface at the corners and interpolated between. With e the side of a facet and k the curvature, facets lie within k
# e^2 / 8 of the surface. With a form error e is R (0.4 degrees): 0.4 micrometres. The cap of a mirror of revolution has
# facets of 0.4 degrees around the axis and of pi / 900 rim radii along it: 0.4 micrometres for a rim radius of 60 mm.
# Interpolated normals err by some (0.4 degrees)^2 / 8 = 6e-6 rad, which is 0.002 px.
#
# The steel's n and k are taken at each band's wavelength: layers are per colour filter.


_RINGS, _SPOKES = 450, 900  # 0.4 degrees apart


def mirror_plugin(view: View) -> Plugin:
    """The mirror: a sphere at the origin, or a mesh.

    Raises
    ------
    SceneError
        If no standard plugin reflects as it does.
    """
    mirror = view.rig.mirror
    bsdf = mirror_bsdf(mirror, view.rig.camera.detector.band_wavelength_nm)
    if mirror.radius_m is not None and mirror.form is None:
        ball: dict[str, Value] = {"radius": MM_PER_M * mirror.radius_m, "bsdf": bsdf}
        return Plugin("shape", "sphere", ball, MIRROR_NAME, MIRROR_NAME)
    return grid_plugin(view, *mirror.grid(_RINGS, _SPOKES), bsdf, closed=True)


def mirror_bsdf(mirror: MetalSurface, wavelengths_nm: Vector) -> Plugin:
    """Smooth or rough conductor with the metal's n and k at the bands' wavelengths.

    A measured reflectance that is a factor of the metal's, or one for all angles, is a factor of the conductor.

    Raises
    ------
    SceneError
        Of a reflectance that depends on the angle otherwise.
    """
    bands = [mirror.band(nm) for nm in wavelengths_nm]
    values: dict[str, Value] = {"eta": Rgb(tuple(band.index.real for band in bands))}
    values["k"] = Rgb(tuple(band.index.imag for band in bands))
    table = mirror.reflectance_table
    if table is not None and (len(table.angle_deg) > 1 or any(band.loss < 1.0 for band in bands)):
        what = (
            f"a measured reflectance at {len(table.angle_deg)} angles"
            if table.angle_deg
            else "a measured reflectance above that of its metal"
        )
        raise SceneError(
            f"the mirror has {what}, which no standard plugin of Mitsuba reflects: allowed are the metal's own, one "
            "below it, and one for all angles; render a sample whose mirror has one of these"
        )
    if table is not None and table.angle_deg:
        values = {"material": "none", "specular_reflectance": Rgb(tuple(float(band.values[0]) for band in bands))}
    elif table is not None:
        values["specular_reflectance"] = Rgb(tuple(band.gain for band in bands))
    if mirror.roughness_alpha > 0.0:
        rough: dict[str, Value] = {"distribution": "beckmann", "alpha": mirror.roughness_alpha}
        return Plugin("bsdf", "roughconductor", rough | values)
    return Plugin("bsdf", "conductor", values)


def grid_plugin(view: View, points_m: Array, normals: Array, bsdf: Plugin, *, closed: bool) -> Plugin:
    """Mesh of a grid of points in the mirror's frame.

    Parameters
    ----------
    points_m, normals : arrays, shape (rings, spokes, 3)
        Outside is where spokes times rings point: the side that mirrors.
    closed : bool
        Whether the last spoke has the first beside it.
    """
    corners = MM_PER_M * points_m.reshape(-1, 3)
    mesh = Triangles(MIRROR_NAME, corners, grid_triangles(*points_m.shape[:2], closed=closed), normals.reshape(-1, 3))
    to_world = np.eye(4)
    to_world[:3, :3] = view.T_world_sphere.R
    return Plugin("shape", "ply", {"filename": mesh, "to_world": to_world, "bsdf": bsdf}, MIRROR_NAME, MIRROR_NAME)


def grid_triangles(rings: int, spokes: int, *, closed: bool) -> NDArray[np.int64]:
    """Corners of the triangles between the rings, outside first, shape (n, 3)."""
    ring, spoke = np.mgrid[0 : rings - 1, 0 : spokes - (not closed)]
    a, b = spokes * ring + spoke, spokes * ring + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)


BLACK = Rgb((0.0, 0.0, 0.0))


def room_plugins(view: View, room: Room, *, lit: bool = True) -> dict[str, Plugin]:
    """Every shape of a room with robot and holder, under its key; `lit` False switches off all that shines."""
    shapes = {shape_key(i): shape_plugin(view, shape, i, lit=lit) for i, shape in enumerate(room.shapes(view))}
    return shapes | tube_plugins(view)


def shape_key(index: int) -> str:
    """Key of the shape with an object id; sorts like the ids."""
    return f"shape_{index:04d}"


def shape_plugin(view: View, shape: Shape, index: int, *, lit: bool = True) -> Plugin:
    """One shape with its material and, if it shines, its light."""
    texture = shape.texture
    if isinstance(shape, Rectangle) and shape.emits:
        light: Rgb | Plugin | None = Rgb(shape.radiance_w_m2_sr)
    elif isinstance(texture, Bitmap) and texture.is_radiance:
        light = _bitmap(texture, shape.name, index)
    else:
        light = None
    values: dict[str, Value] = {}
    if light is None:
        values["bsdf"] = _material(shape, index)
    else:
        values["bsdf"] = diffuse(BLACK)
        if lit:
            values["emitter"] = Plugin("emitter", "area", {"radiance": light})
    if isinstance(shape, Rectangle) and (isinstance(texture, Uniform) or light is not None):
        size, pose = _emitting_size(shape) if isinstance(light, Plugin) else (shape.size_m, shape.T_world_shape)
        half = (0.5 * size[0], 0.5 * size[1], 1.0 / MM_PER_M)
        return _shape("rectangle", {"to_world": scene_transform(view, pose, half)} | values, shape, index)
    if isinstance(shape, Cuboid) and isinstance(texture, Uniform):
        half = (0.5 * shape.size_m[0], 0.5 * shape.size_m[1], 0.5 * shape.size_m[2])
        return _shape("cube", {"to_world": scene_transform(view, shape.T_world_shape, half)} | values, shape, index)
    pose = Pose("world", "shape") if isinstance(shape, Mesh) else shape.T_world_shape
    mesh = _faces_mesh(shape, index)
    own: dict[str, Value] = {"filename": mesh, "face_normals": True, "to_world": scene_transform(view, pose)}
    return _shape("ply", own | values, shape, index)


def scene_transform(view: View, pose: Pose, scale_m: tuple[float, float, float] | None = None) -> Array:
    """Transform, shape (4, 4), of a shape's frame to the scene's; a mesh is in millimetres already."""
    matrix = np.eye(4)
    matrix[:3, :3] = pose.R * (1.0 if scale_m is None else MM_PER_M * np.array(scale_m))
    matrix[:3, 3] = to_scene_mm(view, pose.t)
    return matrix


def diffuse(albedo: Rgb | Plugin) -> Plugin:
    """Lambertian surface."""
    return Plugin("bsdf", "diffuse", {"reflectance": albedo})


def tube_plugins(view: View) -> dict[str, Plugin]:
    """Two faces of a glass tube around the mirror; nothing where there is none."""
    tube = view.tube
    if tube is None:
        return {}
    ends = [to_scene_mm(view, tube.origin_m + height * tube.axis) for height in (tube.low_m, tube.high_m)]
    found = {}
    for name, radius, inside, outside in (
        ("glass_inner", tube.inner_m, 1.0, tube.index),
        ("glass_outer", tube.outer_m, tube.index, 1.0),
    ):
        values: dict[str, Value] = {"p0": ends[0], "p1": ends[1], "radius": MM_PER_M * radius}
        values["bsdf"] = Plugin("bsdf", "dielectric", {"int_ior": inside, "ext_ior": outside})
        found[name] = Plugin("shape", "cylinder", values, name, name)
    return found


def _shape(kind: str, values: dict[str, Value], shape: Shape, index: int) -> Plugin:
    return Plugin("shape", kind, values, shape_key(index), shape.name)


def _emitting_size(shape: Rectangle) -> tuple[tuple[float, float], Pose]:
    """Size and pose of a shining rectangle: those of its picture."""
    texture = shape.texture
    assert isinstance(texture, Bitmap)
    period = [texture.texel_m[i] * texture.values.shape[1 - i] for i in (0, 1)]
    middle = [texture.origin_m[i] + 0.5 * period[i] for i in (0, 1)]
    pose = shape.T_world_shape @ Pose("shape", "picture", (middle[0], middle[1], 0.0))
    return (period[0], period[1]), pose


def _faces_mesh(shape: Shape, index: int) -> Triangles:
    """Mesh of a shape's faces, its corners placed on the texture as `render.optics.faces` says."""
    own = shape if isinstance(shape, Mesh) else replace(shape, T_world_shape=Pose("world", "shape"))
    table = face_table([own])
    corners = table.corners_m.reshape(-1, 3)
    patch = np.repeat(table.patch, 3)
    uv = None if isinstance(shape.texture, Uniform) else table.places(patch, corners) / _period(shape.texture)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Triangles(shape_key(index), MM_PER_M * corners, faces, uv=uv)


def _period(texture: Texture) -> tuple[int, ...]:
    """Texels, or cells of a checker, of one period: columns and rows."""
    return texture.values.shape[1::-1] if isinstance(texture, Bitmap) else (2, 2)


def _material(shape: Shape, index: int) -> Plugin:
    """Diffuse ground, below a smooth dielectric coat if that has a refractive index."""
    albedo = _albedo(shape.texture, shape.name, index)
    if shape.coat == 0.0:
        material = diffuse(albedo)
    else:
        ior: dict[str, Value] = {"int_ior": shape.coat, "ext_ior": 1.0, "nonlinear": True}
        material = Plugin("bsdf", "plastic", {"diffuse_reflectance": albedo} | ior)
    if isinstance(shape, Mesh) and shape.two_sided:
        return Plugin("bsdf", "twosided", {"material": material})
    return material


def _albedo(texture: Texture, label: str, index: int) -> Rgb | Plugin:
    if isinstance(texture, Uniform):
        return Rgb(texture.albedo)
    if isinstance(texture, Bitmap):
        return _bitmap(texture, label, index)
    colours: dict[str, Value] = {"color0": Rgb(texture.albedo_even), "color1": Rgb(texture.albedo_odd)}
    return Plugin("texture", "checkerboard", colours)


def _bitmap(texture: Bitmap, label: str, index: int) -> Plugin:
    """Bitmap with linear values, repeated."""
    picture = BitmapPlugin(shape_key(index), texture.values[..., :3])
    values: dict[str, Value] = {"filename": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}
    return Plugin("texture", "bitmap", values, label=label)


def to_scene_mm(view: View, points_world_m: Array) -> Array:
    """World points, metres, in Mitsuba's scene: millimetres from the sphere centre.

    In metres with the origin on the floor Mitsuba's ray offset moves the spot by 0.01 px.
    """
    return MM_PER_M * (points_world_m - view.sphere_centre_m)
