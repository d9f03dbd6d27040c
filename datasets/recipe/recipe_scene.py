"""Rig, room, targets and spots of `scenes`, made from a recipe's tables; and faults of its rig, mirror and holder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from phibench.datasets.recipe.mirror_tables import (
    HALF_ANGLE_DEG,
    OF_SHAPES,
    SHAPES,
    VERTEX_RADIUS_M,
    HolderTable,
    MirrorTable,
)
from phibench.datasets.recipe.room_tables import RoomTable
from phibench.datasets.recipe.tables import OWN_ALBEDO, LaserTable, MisalignmentTable, Recipe, RigTable, TargetTable
from phibench.datasets.rooms.room_sources import NamedRoom, room_of
from phibench.render.optics.faces import face_table
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, Pose, Vector, as_matrix, as_vector, rotation_xyz
from phibench.scenes.holder import LENGTHS, Holder, fitted_holder
from phibench.scenes.laser import Beam, LaserSpot
from phibench.scenes.metals import ReflectanceTable
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import Profile, cone
from phibench.scenes.rig import Rig
from phibench.scenes.room import BOARD_ALBEDO, RIGS, Room, TargetBoard
from phibench.scenes.validation import Fault, SceneError

CAMERA_KEYS = (
    *("width_px", "height_px", "pixel_pitch_um", "fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2"),
    *("f_number", "focus_distance_m", "blur_sigma_px"),
)

HOLDER_KINDS: Mapping[str, tuple[str, ...]] = {
    "radius_m": ("rods", "post", "tube"),  # of a tube it sets the plates where plate_m is not given
    "circle_m": ("rods", "post", "tube"),
    "plate_m": ("rods", "post", "tube"),
    "rise_m": ("rods", "post", "tube"),
    "azimuth_deg": ("rods", "post"),
    "wall_m": ("tube",),
    "glass_index": ("tube",),
}
"""Kinds of a holder that a key of `[rig.holder]` has an effect on."""

_NANOMETRE = 9  # decimals
_OWNERS = (
    *(("Holder.", "rig.holder."), ("SphereMirror.", "rig."), ("Camera.", "rig.")),
    *(("Profile.", "rig.mirror."), ("RevolvedMirror.", "rig."), ("ReflectanceTable.", "rig.reflectance.")),
)


def build_rig(table: RigTable) -> Rig:
    """Rig of a recipe; raises `SceneError`, by the recipe's keys, where the numbers do not go together."""
    try:
        return _rig(table)
    except SceneError as error:
        raise SceneError(text_by_keys(str(error))) from error


def text_by_keys(text: str) -> str:
    """Sentence of a `SceneError` of a rig with the recipe's keys instead of names of classes."""
    for owner, path in _OWNERS:
        text = re.sub(rf"\b{re.escape(owner)}(?=[a-z])", path, text)
    return text


def rig_fault_of(error: SceneError) -> Fault:
    """Fault at the key of `[rig]` that an error of `build_rig` begins with, or else of the whole table."""
    match = re.match(r"(rig(?:\.\w+)+) = (.+)", str(error), re.DOTALL)
    return Fault("rig", str(error)) if match is None else Fault(match[1], match[2])


def idle_holder_faults(path: str, given: Iterable[str], kinds: Iterable[str]) -> list[Fault]:
    """Faults of keys of a holder that have no effect on any of the kinds that it may be of."""
    possible, faults = sorted(set(kinds) - {"none"}), []
    for key in given:
        takers = HOLDER_KINDS.get(key, ())
        if takers and not set(takers) & set(possible):
            quoted = " or ".join(f'"{kind}"' for kind in takers)
            is_now = " or ".join(f'"{kind}"' for kind in possible) or '"none"'
            text = f"has no effect on a holder of kind {is_now}; remove it, or give kind = {quoted}"
            faults.append(Fault(f"{path}.{key}", text))
    return faults


def _rig(table: RigTable) -> Rig:
    base = RIGS[table.preset]()
    if table.mirror is not None:
        return _revolved_rig(table, table.mirror, base)
    mirror = replace(base.sphere, **_given(table, ("radius_m", *_SURFACE)), reflectance_table=_reflectance(table))
    z_c_m = base.sphere_in_camera_m[2] if table.z_c_m is None else table.z_c_m
    T_world_camera, T_camera_sphere = _poses(table, base, z_c_m)
    before_m = min(T_camera_sphere.translation_m[2], float(np.linalg.norm(T_camera_sphere.t)))
    if before_m <= mirror.radius_m:
        raise SceneError(
            f"z_c_m = {z_c_m:g} with radius_m = {mirror.radius_m:g}: the sphere centre is {before_m:.4f} m in front of "
            f"the lens, which is inside the sphere; give a z_c_m above the mirror radius or a smaller radius_m"
        )
    camera = _camera(base.camera, table)
    if table.z_c_m is not None or table.radius_m is not None:  # on the virtual image
        camera = _focused(camera, table, z_c_m - mirror.radius_m / 2.0)
    holder = _holder(table.holder, mirror.bound_m, None)
    return Rig(camera, mirror, T_world_camera, T_camera_sphere, _stroke_axis(table), holder=holder)


_VERTEX_M = 0.220  # from the lens: rims of 60 mm fit the image


def idle_mirror_faults(path: str, table: MirrorTable, shapes: Sequence[str] = ()) -> list[Fault]:
    """Faults of keys of `[rig.mirror]` that belong to none of its possible shapes, and of one that a shape needs."""
    shapes = shapes or (table.shape,)
    given = [key for key in OF_SHAPES if getattr(table, key) is not None]
    faults = _idle_of_shapes(path, given, shapes)
    needing = [shape for shape in shapes if "even_terms" in SHAPES[shape].keys]
    if needing and not table.even_terms:
        faults.append(Fault(f"{path}.even_terms", f'is missing: shape = "{needing[0]}" needs at least one number'))
    return faults


def drawn_mirror_faults(path: str, drawn: Mapping[str, Any], shapes: Sequence[str]) -> list[Fault]:
    """Faults of drawn keys of a mirror that none of its shapes has, or of whose values a shape refuses some."""
    given = [key for key, value in drawn.items() if value is not None]
    faults = _idle_of_shapes(path, given, shapes)
    if "conic" in given:
        least, most = drawn["conic"].support
        faults += _conic_faults(f"{path}.conic", least, most, shapes)
    return faults


def fixed_conic_faults(path: str, table: MirrorTable, shapes: Sequence[str]) -> list[Fault]:
    """Faults of a conic that is not drawn, where shapes are and one of them refuses it."""
    return [] if table.conic is None else _conic_faults(f"{path}.conic", table.conic, table.conic, shapes)


def _conic_faults(key: str, least: float, most: float, shapes: Sequence[str]) -> list[Fault]:
    faults = []
    for name in shapes:
        shape = SHAPES[name]
        if "conic" in shape.keys and not shape.low < least <= most < shape.high:
            reach = f"is {least:g}" if least == most else f"reaches from {least:g} to {most:g}"
            text = f'{reach}; a conic of shape = "{name}" is {shape.side}'
            faults.append(Fault(key, f"{text}, give such a one or leave that shape out"))
    return faults


def _idle_of_shapes(path: str, given: Iterable[str], shapes: Sequence[str]) -> list[Fault]:
    faults = []
    for key in given:
        takers = tuple(name for name, shape in SHAPES.items() if key in shape.keys) if key in OF_SHAPES else shapes
        if not set(takers) & set(shapes):
            quoted, is_now = (" or ".join(f'"{shape}"' for shape in names) for names in (takers, shapes))
            text = f"has no effect on shape = {is_now}; remove it, or give shape = {quoted}"
            faults.append(Fault(f"{path}.{key}", text))
    return faults


def build_profile(table: MirrorTable, vertex_m: float) -> Profile:
    """Profile of a mirror whose vertex lies so far before the lens; the lens is in a hyperboloid's focus by default."""
    shape = SHAPES[table.shape]
    if shape.conic is None:
        return cone(float(np.radians(table.half_angle_deg or HALF_ANGLE_DEG)), table.rim_radius_m)
    conic = shape.conic if table.conic is None else table.conic
    if not shape.low < conic < shape.high:
        raise SceneError(f'Profile.conic = {conic:g}: {shape.side} for shape = "{table.shape}"')
    radius_m = table.vertex_radius_m
    if radius_m is None:
        radius_m = vertex_m * ((-conic) ** 0.5 - 1.0) if shape.lens_in_focus else VERTEX_RADIUS_M
    return Profile(radius_m, conic, table.rim_radius_m, table.even_terms or ())


def _revolved_rig(table: RigTable, mirror: MirrorTable, base: Rig) -> Rig:
    """Rig with a mirror of revolution, its axis upright but for its tilt."""
    if table.radius_m is not None:
        raise SceneError(f"rig.radius_m = {table.radius_m:g}: is a sphere's; a {mirror.shape} has its own keys")
    vertex_m = _VERTEX_M if table.z_c_m is None else table.z_c_m
    profile = build_profile(mirror, vertex_m)
    given = _given(table, _SURFACE)
    T_world_camera, T_camera_sphere = _poses(table, base, vertex_m)
    tilt = rotation_xyz(mirror.tilt_x_rad, mirror.tilt_y_rad)
    T_camera_mirror = replace(T_camera_sphere, rotation=as_matrix(T_world_camera.R.T @ np.array(tilt)))
    camera = _focused(_camera(base.camera, table), table, vertex_m + _image_depth_m(profile))
    stroke = _stroke_axis(table)
    revolved = RevolvedMirror(profile, **given, reflectance_table=_reflectance(table))
    holder = _holder(table.holder, profile.rim_radius_m, profile.depth_m)
    return Rig(camera, revolved, T_world_camera, T_camera_mirror, stroke, holder=holder)


def _image_depth_m(profile: Profile) -> float:
    """Depth behind the vertex at which a far room's virtual image lies: R / 2; behind a cone, half its height."""
    return 0.5 * (profile.vertex_radius_m or profile.depth_m)


_SURFACE = ("roughness_alpha", "metal")


def _reflectance(table: RigTable) -> ReflectanceTable | None:
    given = table.reflectance
    return None if given is None else ReflectanceTable(given.wavelength_nm, given.value, given.angle_deg)


def _poses(table: RigTable, base: Rig, z_c_m: float) -> tuple[Pose, Pose]:
    """Camera in the world, and mirror in the camera, for a mirror so far above the lens."""
    height_m = base.T_world_camera.t[2] if table.camera_height_m is None else table.camera_height_m
    T_world_camera = Pose("world", "camera", (0.0, 0.0, height_m), rotation_xyz(table.tilt_x_rad, table.tilt_y_rad))
    mirror_from_camera = np.array([table.decentre_x_m, table.decentre_y_m, z_c_m])  # world axes
    return T_world_camera, Pose("camera", "sphere", as_vector(T_world_camera.R.T @ mirror_from_camera))


def _stroke_axis(table: RigTable) -> Vector:
    turn = rotation_xyz(table.stroke_tilt_x_rad, table.stroke_tilt_y_rad)
    return as_vector(np.array(turn) @ np.array([0.0, 0.0, 1.0]))


def _focused(camera: Camera, table: RigTable, distance_m: float) -> Camera:
    """Camera focused at a distance, unless the recipe says where."""
    return camera if table.focus_distance_m is not None else replace(camera, focus_distance_m=distance_m)


def _holder(table: HolderTable, wide_m: float, depth_m: float | None) -> Holder | None:
    """Holder of a ball, or of a mirror of revolution with a rim so wide and so far over its vertex."""
    if table.kind == "none":
        return None
    given = {name: value for name in (*LENGTHS, "glass_index") if (value := getattr(table, name)) is not None}
    return fitted_holder(table.kind, wide_m, depth_m, azimuth_rad=float(np.radians(table.azimuth_deg)), **given)


def build_misalignment(table: MisalignmentTable) -> Misalignment:
    """Deviations of the true rig from the nominal one."""
    return Misalignment(**table.model_dump())


def build_true_rig(recipe: Recipe) -> Rig:
    """True rig of a recipe without drawn numbers; raises `SceneError` as `build_rig`."""
    return build_rig(recipe.rig).perturbed(build_misalignment(recipe.misalignment))


def true_stroke_m(misalignment: Misalignment, nominal_stroke_m: float) -> float:
    """True stroke, to the nanometre where it is not the nominal one: a pose's name then says its offset exactly.

    Raises
    ------
    SceneError
        If it is not above 0.
    """
    true_m = misalignment.stroke_m(nominal_stroke_m)
    return true_m if true_m == nominal_stroke_m else round(true_m, _NANOMETRE)


def build_target(table: TargetTable) -> TargetBoard:
    """Target board of a recipe."""
    return TargetBoard(table.name, table.depth_m, float(np.radians(table.azimuth_deg)), table.height_m)


def room_source(table: RoomTable, targets: Iterable[TargetTable]) -> NamedRoom:
    """Source of the room of a recipe, with its target boards."""
    return NamedRoom(table.name, tuple(build_target(target) for target in targets))


def build_room(table: RoomTable, targets: Iterable[TargetTable]) -> Room:
    """Room of a recipe with its target boards."""
    return room_of(room_source(table, targets))


def build_spot(laser: LaserTable, target: TargetTable) -> LaserSpot:
    """Laser spot at the centre of a target board."""
    board = build_target(target)
    diameter_m = beam_of(laser).diameter_m(target.depth_m) if target.diameter_m is None else target.diameter_m
    return make_spot(laser, board.position_world_m, board.normal_world, diameter_m)


def beam_of(laser: LaserTable) -> Beam:
    """Diameter of the laser's spots by their distance from the axis; a target may say otherwise."""
    if laser.diameter_m is not None:
        return Beam(laser.diameter_m, 0.0)
    return Beam(laser.diameter_base_m, laser.diameter_growth_m_per_m)


def make_spot(
    laser: LaserTable,
    position_world_m: Vector,
    normal_world: Vector,
    diameter_m: float,
    beam_direction_world: Vector | None = None,
) -> LaserSpot:
    """Spot of the recipe's laser somewhere; of a beam where its direction is given."""
    return LaserSpot(
        position_world_m=position_world_m,
        normal_world=normal_world,
        diameter_m=diameter_m,
        albedo=spot_albedo(laser.albedo, beam_direction_world),
        power_w=laser.power_w,
        wavelength_nm=laser.wavelength_nm,
        profile=laser.profile,
        beam_direction_world=beam_direction_world,
    )


def spot_albedo(albedo: float | str, beam_direction_world: Vector | None) -> float | None:
    """Albedo of a spot: None, each surface's own, for a beam; for a disc on a board, that of boards."""
    if albedo != OWN_ALBEDO:
        return float(albedo)
    return BOARD_ALBEDO if beam_direction_world is None else None


AXIS_CLEARANCE_M = 0.20  # the mirror, its carriage and what a rig may be off
_MIDDLE_M = 0.5  # between the robot's body and the lowest mirror


def ceiling_m(room: Room) -> float:
    """Height of the lowest face above the robot: less than `AXIS_CLEARANCE_M` from the stroke axis, z = 0 excluded.

    What reaches from below 0.5 m into that cylinder counts as 0.5 m, so that no stroke fits. Infinite in the open.
    Target boards do not count: they may stand nearer, and are checked against the mirror itself.
    """
    shapes = [shape for shape in (*room.surfaces, *room.furniture) if not shape.name.startswith("board_")]
    corners = face_table(shapes).corners_m
    above = corners[..., 2].max(axis=1) > _MIDDLE_M
    over = corners[above][_axis_distance_m(corners[above, :, :2]) < AXIS_CLEARANCE_M]
    return max(float(over[..., 2].min(initial=np.inf)), _MIDDLE_M)


def _axis_distance_m(triangles_m: Array) -> Array:
    """Distances of the origin from triangles of the plane, shape (N,), for corners (N, 3, 2)."""
    side = np.roll(triangles_m, -1, axis=1) - triangles_m
    squared = np.maximum(np.einsum("nki,nki->nk", side, side), 1e-300)  # a side without a length
    share = np.clip(-np.einsum("nki,nki->nk", triangles_m, side) / squared, 0.0, 1.0)
    nearest = np.linalg.norm(triangles_m + share[..., None] * side, axis=-1).min(axis=1)
    turn = triangles_m[..., 0] * side[..., 1] - triangles_m[..., 1] * side[..., 0]
    inside = ((turn > 0.0).all(axis=1)) | ((turn < 0.0).all(axis=1))
    return np.where(inside, 0.0, nearest)


def _given(table: RigTable, keys: Iterable[str]) -> dict[str, Any]:
    """Those keys of the rig's table that the recipe sets."""
    return {key: value for key in keys if (value := getattr(table, key)) is not None}


def _camera(base: Camera, table: RigTable) -> Camera:
    """Camera with the recipe's numbers; principal point and second focal length follow unless they are set."""
    implied: dict[str, Any] = {}
    if table.fx_px is not None or table.fy_px is not None:  # square pixels: the one that is given holds for both
        implied["fx_px"], implied["fy_px"] = table.fx_px or table.fy_px, table.fy_px or table.fx_px
    if table.width_px is not None:
        implied["cx_px"] = (table.width_px - 1) / 2.0
    if table.height_px is not None:
        implied["cy_px"] = (table.height_px - 1) / 2.0
    if table.laser_filter_response is not None:
        implied["detector"] = replace(base.detector, laser_filter_response=table.laser_filter_response)
    return replace(base, **{**implied, **_given(table, CAMERA_KEYS)})
