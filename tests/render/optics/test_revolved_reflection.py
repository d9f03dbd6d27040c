"""Reflection points on mirrors of revolution against other mathematics.

* Lens on the axis: with the mirror r^2 = q(z) = 2 R z - A z^2, A = 1 + k, the lens at (0, -d) and the point (p, h), the
  reflected ray passes the point where r (a (h - z) + b) = b p. Here n = (r, A z - R) is the normal, v = (r, z + d) the
  ray, a = n.n - 2 n.v and b = (z + d) n.n - 2 (A z - R) n.v. Squared, and with r^2 = q, it is a polynomial in z of the
  degree 6 (A. Agrawal, Y. Taguchi and S. Ramalingam, "Beyond Alhazen's problem", CVPR 2011). Its roots are polished
  with 60 digits, and each is told apart.
* Lens anywhere: the law of reflection, solved by a root finder of another library from many starts, with normals by
  complex steps.
"""

from __future__ import annotations

from collections import Counter
from decimal import Decimal, localcontext

import numpy as np
import pytest
from helpers.revolved_rigs import PROFILES, revolved
from scipy import optimize

from phibench.render.optics.ray_tracer import meet_profile, trace_pixels
from phibench.render.optics.reflection_point import bundle_spread, mirror_points, reflection_points
from phibench.render.optics.revolved_reflection import revolved_points
from phibench.scenes.form_error import Form
from phibench.scenes.frames import Array, Pose
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import Profile, cone, hyperboloid, paraboloid, sphere_cap
from phibench.scenes.rig import Rig, View

QUADRICS = [name for name, profile in PROFILES.items() if profile.is_quadric]
PX_PER_M = 1430.0 / 0.2  # at the vertex; farther away a metre is fewer pixels


def rng_of(*names: object) -> np.random.Generator:
    return np.random.default_rng([ord(c) for c in "".join(map(str, names))])


def seen_points(view: View, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random pixels on the mirror, shape (n, 2), and points 0.3 to 6 m along their reflected rays."""
    uv = view.rig.outline_px().mean(axis=0) + rng.uniform(-1.0, 1.0, (3 * count + 30, 2)) * 380.0
    rays = trace_pixels(view, uv)
    hit = np.flatnonzero(np.isfinite(rays.cos_incidence))[:count]
    assert len(hit) == count
    away = rng.uniform(0.3, 6.0, (count, 1))
    return uv[hit], rays.points_m[hit] + away * rays.directions[hit]


# -- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("aligned", [True, False], ids=["aligned", "off axis"])
@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_pixel_to_point_and_back(shape: str, aligned: bool) -> None:
    """10 000 pixels: 1e-9 px is required. Rounding of 6 m, 1e-15 m, is 1e-11 px where a mirror shows 1e4 px per m."""
    view = revolved(shape, aligned=aligned).at(0.0)
    uv, points = seen_points(view, 10_000, rng_of("back", shape))
    found = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape))
    assert found.lit.all()  # no pixel inside the rim is lost
    back = view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m))
    worst = float(np.linalg.norm(back - uv, axis=1).max())
    print(f"{shape}, {'aligned' if aligned else 'off axis'}: {worst:.1e} px")
    assert worst < 1e-9


# -- lens on the axis: roots of the polynomial -----------------------------------------------------------------------


def exact_polynomial(
    profile: Profile, d: float, p: float, h: float
) -> tuple[list[Decimal], list[Decimal], list[Decimal]]:
    """Coefficients of the polynomial, of b and of a (h - z) + b, without rounding, lowest first."""

    def times(x: list[Decimal], y: list[Decimal]) -> list[Decimal]:
        result = [Decimal(0)] * (len(x) + len(y) - 1)
        for i, s in enumerate(x):
            for j, t in enumerate(y):
                result[i + j] += s * t
        return result

    def plus(x: list[Decimal], y: list[Decimal], scale: int = 1) -> list[Decimal]:
        size = max(len(x), len(y))
        x, y = x + [Decimal(0)] * (size - len(x)), y + [Decimal(0)] * (size - len(y))
        return [s + scale * t for s, t in zip(x, y, strict=True)]

    A, R, D, H, X = (Decimal(float(v)) for v in (1.0 + profile.conic, profile.vertex_radius_m, d, h, p))
    q, nz, ray = [Decimal(0), 2 * R, -A], [-R, A], [D, Decimal(1)]
    nn, nv = plus(q, times(nz, nz)), plus(q, times(nz, ray))
    a, b = plus(nn, nv, -2), plus(times(ray, nn), times(nz, nv), -2)
    bracket = plus(times(a, [H, Decimal(-1)]), b)
    return plus(times(q, times(bracket, bracket)), [X * X * c for c in times(b, b)], -1), b, bracket


def value(c: list[Decimal], z: Decimal) -> Decimal:
    total = Decimal(0)
    for coefficient in reversed(c):
        total = total * z + coefficient
    return total


def explained_roots(profile: Profile, d: float, p: float, h: float) -> tuple[Counter[str], list[tuple[float, float]]]:
    """Kinds of all roots, and (r, z) of those that reflect light inside the rim."""
    kinds: Counter[str] = Counter()
    lit = []
    with localcontext() as context:
        context.prec = 60
        c, b, bracket = exact_polynomial(profile, d, p, h)
        while abs(float(c[0])) < 1e-40:  # roots at 0
            kinds["the tip"] += 1
            c = c[1:]
        slope = [i * x for i, x in enumerate(c)][1:]
        largest = max(abs(float(x)) for x in c)
        degree = max(i for i, x in enumerate(c) if abs(float(x)) > 1e-13 * largest)
        starts = np.polynomial.polynomial.polyroots([float(x) for x in c[: degree + 1]])
        for start in starts:
            if abs(start.imag) > 1e-5 * max(abs(start.real), 1e-2):
                kinds["complex"] += 1
                continue
            z = Decimal(float(start.real))
            for _ in range(80):
                step = value(c, z) / value(slope, z)
                z -= step
                if abs(step) < Decimal("1e-45"):
                    break
            if abs(value(bracket, z)) < Decimal("1e-25"):
                kinds["double, of both squares"] += 1
                continue
            r = float(value(b, z) * Decimal(p) / value(bracket, z))
            kind = told(profile, d, p, h, r, float(z))
            kinds[kind] += 1
            if kind == "lit":
                lit.append((r, float(z)))
    return kinds, lit


def told(profile: Profile, d: float, p: float, h: float, r: float, z: float) -> str:
    A, R = 1.0 + profile.conic, profile.vertex_radius_m
    if z < 0.0 or R - A * z < 0.0:
        return "other sheet or half"
    n = np.array([r, A * z - R])  # away from the mirror
    sides = [float(n @ (np.array(end) - (r, z))) for end in ((0.0, -d), (p, h))]
    if min(sides) > 0.0:
        return "lit" if abs(r) <= profile.rim_radius_m else "lit beyond the rim"
    return "straight on" if max(sides) > 0.0 else "from inside"


@pytest.mark.parametrize("shape", QUADRICS)
def test_accuracy_against_the_roots_of_the_forward_polynomial(shape: str) -> None:
    """200 random lenses and points: 1e-6 px is required. Every root is explained, and one reflects light."""
    rng, profile, kinds, worst, checked = rng_of("roots", shape), PROFILES[shape], Counter[str](), 0.0, 0
    for _ in range(200):
        d = float(rng.uniform(0.15, 0.4))
        rig = Rig(mirror=RevolvedMirror(profile), T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, d)))
        _, points = seen_points(rig.at(0.0), 1, rng)
        x = rig.at(0.0).T_world_sphere.inverse().points(points)
        p, h = float(np.hypot(*x[0, :2])), float(x[0, 2])
        found, lit = explained_roots(profile, d, p, h)
        kinds += found
        assert len(lit) == 1, (d, p, h, found)
        P, _, valid = revolved_points(np.array([[p, 0.0, h]]), np.array([[0.0, 0.0, -d]]), profile)
        assert valid[0]
        worst = max(worst, float(np.hypot(P[0, 0] - lit[0][0], P[0, 2] - lit[0][1])) * PX_PER_M)
        checked += 1
    print(f"{shape}: {worst:.1e} px; {dict(kinds)}")
    assert checked == 200
    assert worst < 1e-9
    known = {
        "complex",
        "the tip",
        "double, of both squares",
        "other sheet or half",
        "lit",
        "lit beyond the rim",
        "straight on",
    }
    assert set(kinds) <= known | {"from inside"}


# -- lens anywhere: the law of reflection from many starts -----------------------------------------------------------


def normal_of(profile: Profile, x: float, y: float) -> Array:
    """Unit normal towards the camera, by complex steps through the sag's formula."""
    step = 1e-30

    def sag(x: complex, y: complex) -> complex:
        s, R, A = x * x + y * y, profile.vertex_radius_m, 1.0 + profile.conic
        return s / (R + np.sqrt(R * R - A * s + 0j)) + sum(a * s**i for i, a in enumerate(profile.even_terms, start=2))

    slope = np.array([sag(x + 1j * step, y).imag, sag(x, y + 1j * step).imag]) / step
    n = np.array([slope[0], slope[1], -1.0])
    return np.asarray(n / np.linalg.norm(n))


def solutions(profile: Profile, a: Array, b: Array, starts: int) -> list[Array]:
    """Places inside the rim that both ends see, where the law of reflection holds, from starts^2 places."""

    def unequal(xy: Array) -> Array:
        P = np.array([*xy, profile.sag(np.array(xy @ xy)).z_m])
        u, v = ((end - P) / np.linalg.norm(end - P) for end in (a, b))
        n = normal_of(profile, *xy)
        aside = u + v - ((u + v) @ n) * n
        return np.asarray(aside[:2])

    grid = 0.6 * profile.rim_radius_m * np.linspace(-1.0, 1.0, starts)
    distinct: list[Array] = []
    for start in np.stack(np.meshgrid(grid + 1e-4, grid), -1).reshape(-1, 2):
        with np.errstate(all="ignore"):
            found = optimize.root(unequal, start, tol=1e-15, options={"maxfev": 80})
            P = np.array([*found.x, profile.sag(np.array(found.x @ found.x)).z_m])
        inside = np.isfinite(P).all() and np.hypot(*found.x) <= profile.rim_radius_m
        if not inside or np.linalg.norm(found.fun) > 1e-12:
            continue
        lit = all((end - P) @ normal_of(profile, *found.x) > 0.0 for end in (a, b))
        if lit and all(np.linalg.norm(P - other) > 1e-7 for other in distinct):
            distinct.append(P)
    return distinct


def lens_and_point(profile: Profile, which: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random lens and a point: of every four two that it sees, one anywhere, and one beside the mirror."""
    eye = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(-0.4, -0.12)])
    if which % 4 == 2:
        point = rng.normal(0.0, 2.0, 3)
        return eye, point * [1.0, 1.0, -1.0] if profile.holds(point) else point
    if which % 4 == 3:  # just not inside the body behind the mirror
        turn, beside = rng.uniform(0.0, 2.0 * np.pi), 1.01 * profile.rim_radius_m
        return eye, np.array([beside * np.cos(turn), beside * np.sin(turn), profile.depth_m - 1e-3])
    r, turn = profile.rim_radius_m * np.sqrt(rng.uniform(0.01, 0.98)), rng.uniform(0.0, 2.0 * np.pi)
    xy = r * np.array([np.cos(turn), np.sin(turn)])
    P = np.array([*xy, profile.sag(np.array(r * r)).z_m])
    d, n = (P - eye) / np.linalg.norm(P - eye), normal_of(profile, *xy)
    return eye, P + rng.uniform(0.3, 5.0) * (d - 2.0 * (d @ n) * n)


def one_or_none(shape: str, count: int, starts: int) -> None:
    rng, profile, seen, unseen, worst = rng_of("law", shape), PROFILES[shape], 0, 0, 0.0
    for i in range(count):
        eye, point = lens_and_point(profile, i, rng)
        expected = solutions(profile, point, eye, starts)
        P, _, valid = revolved_points(point[None], eye[None], profile)
        assert len(expected) <= 1
        assert bool(valid[0]) == (len(expected) == 1), (i, eye, point)
        if valid[0]:
            worst = max(worst, float(np.linalg.norm(P[0] - expected[0])) * PX_PER_M)
        seen, unseen = seen + bool(valid[0]), unseen + (not valid[0])
    print(f"{shape}: {worst:.1e} px, {seen} seen, {unseen} not")
    assert seen >= count // 2
    assert worst < 1e-6


@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_off_axis_there_is_one_reflection_point_or_none(shape: str) -> None:
    """12 random places of lens and point: 1e-6 px required; residuals of 1e-12 rad leave 1e-13 m, 1e-9 px.

    Where the point is not seen, no start finds a reflection either.
    """
    one_or_none(shape, 12, 3)


@pytest.mark.slow
@pytest.mark.parametrize("shape", PROFILES)
def test_accuracy_off_axis_200_rigs(shape: str) -> None:
    """The same with 200 rigs and 25 starts."""
    one_or_none(shape, 200, 5)


# -- viewpoints and the caustic --------------------------------------------------------------------------------------


def nearest_to_axis(points: Array, directions: Array) -> Array:
    """Heights where rays cross the axis, shape (N,)."""
    r, along = np.hypot(*points.T[:2]), np.sum(points[:, :2] * directions[:, :2], axis=1)
    return np.asarray(points[:, 2] - directions[:, 2] * r**2 / along)


def meridian_rays(profile: Profile, origins: Array, directions: Array) -> tuple[Array, Array]:
    points, normals, _ = meet_profile(origins, directions, profile)
    assert np.isfinite(points).all()
    return points, directions - 2.0 * np.sum(directions * normals, axis=1)[:, None] * normals


def test_accuracy_a_lens_in_the_focus_has_one_viewpoint() -> None:
    """The other focus of the hyperboloid, at R / (1 + e) behind the vertex, to 1e-9 m."""
    profile = hyperboloid(0.2, 1.25, 0.06)
    slopes = np.linspace(0.01, 0.22, 300)  # the rim is at 0.23
    d = np.stack([slopes, 0.3 * slopes, np.ones(300)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    points, out = meridian_rays(profile, np.tile([0.0, 0.0, -0.2], (300, 1)), d)
    heights = nearest_to_axis(points, out)
    print(f"{np.ptp(heights):.1e} m")
    assert heights == pytest.approx(0.05 / 2.25, abs=1e-12)


def test_accuracy_a_paraboloid_seen_along_its_axis_has_one_viewpoint() -> None:
    """Its focus, R / 2 behind the vertex, to 1e-9 m."""
    r = np.linspace(1e-3, 0.059, 300)
    points, out = meridian_rays(
        paraboloid(0.06, 0.06), np.stack([r, 0.0 * r, 0.0 * r - 0.2], 1), np.tile([0, 0, 1.0], (300, 1))
    )
    heights = nearest_to_axis(points, out)
    print(f"{np.ptp(heights):.1e} m")
    assert heights == pytest.approx(0.03, abs=1e-12)


def test_accuracy_the_caustic_of_the_sphere() -> None:
    """Rays of a cap touch a caustic 1 / (1/l + 2 / (R cos i)) behind the mirror (Coddington), to 1e-9 m.

    The touching point is found from rays 1e-4 rad apart: central differences of the point along the ray that moves
    least, which err by the square, 1e-8 of some centimetres.
    """
    R, d, step = 0.06, 0.2, 1e-4
    profile, angles = sphere_cap(R, 0.055), np.linspace(0.02, 0.2, 60)

    def rays(angle: Array) -> tuple[Array, Array]:
        aim = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
        return meridian_rays(profile, np.tile([0.0, 0.0, -d], (len(angle), 1)), aim)

    points, out = rays(angles)
    (p1, o1), (p2, o2), (p3, o3), (p4, o4) = (rays(angles + s * step) for s in (-2, -1, 1, 2))
    dP, dr = ((8.0 * (c - b) - (e - a)) / (12.0 * step) for a, b, c, e in ((p1, p2, p3, p4), (o1, o2, o3, o4)))
    behind = np.sum(dP * dr, axis=1) / np.sum(dr * dr, axis=1)  # P - t r stands still at t
    length = np.linalg.norm(points - [0.0, 0.0, -d], axis=1)
    cos_i = np.sum(out * (points - [0.0, 0.0, R]), axis=1) / R
    expected = 1.0 / (1.0 / length + 2.0 / (R * cos_i))
    print(f"{np.abs(behind - expected).max():.1e} m")
    assert behind == pytest.approx(expected, abs=1e-9)


# -- the sphere, and bundles -----------------------------------------------------------------------------------------


def test_accuracy_the_sphere_by_the_general_path_is_the_sphere() -> None:
    """Points in the mirror by both paths, the centre R above the vertex: 1e-9 px is required."""
    rng, R = rng_of("sphere"), 0.06
    cap = Rig(
        mirror=RevolvedMirror(sphere_cap(R, 0.058)), T_camera_sphere=Pose("camera", "sphere", (0.004, -0.002, 0.2))
    )
    ball = Rig(mirror=SphereMirror(R), T_camera_sphere=Pose("camera", "sphere", (0.004, -0.002, 0.2 + R)))
    uv, points = seen_points(cap.at(0.0), 2000, rng)
    one, two = (trace_pixels(rig.at(0.0), uv) for rig in (cap, ball))
    assert one.points_m == pytest.approx(two.points_m, abs=1e-14)
    assert one.directions == pytest.approx(two.directions, abs=1e-12)
    eye = ball.at(0.0).camera_centre_m
    centre = ball.at(0.0).sphere_centre_m
    closed, lit = reflection_points(points - centre, np.broadcast_to(eye, points.shape) - centre, R)
    found = mirror_points(cap.at(0.0), points, np.broadcast_to(eye, points.shape))
    assert lit.all()
    assert found.lit.all()
    worst = float(np.linalg.norm(found.points_m - centre - closed, axis=1).max()) * PX_PER_M
    print(f"{worst:.1e} px")
    assert worst < 1e-9


@pytest.mark.parametrize("shape", PROFILES)
def test_spread_of_bundles_against_neighbouring_rays(shape: str) -> None:
    """Rays from the point to four eyes 0.1 mm around: area per solid angle; differences err by 1e-6 of it and less."""
    view = revolved(shape, aligned=False).at(0.0)
    _, points = seen_points(view, 40, rng_of("spread", shape))
    eye = np.broadcast_to(view.camera_centre_m, points.shape)
    found = mirror_points(view, points, eye)
    to_eye = eye - found.points_m
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    spread = bundle_spread(view, found, eye, np.sum(to_eye * found.normals, axis=1))
    side = np.cross(to_eye, [0.0, 0.0, 1.0] if shape != "cone" else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    moves = (side, np.cross(to_eye, side))
    step, slopes = 1e-4, []
    for move in moves:
        ways = []
        for sign in (1.0, -1.0):
            near = mirror_points(view, points, eye + sign * step * move)
            way = near.points_m - points
            ways.append(way / np.linalg.norm(way, axis=1, keepdims=True))
        slopes.append((ways[0] - ways[1]) / (2.0 * step))
    steradians = np.linalg.norm(np.cross(*slopes), axis=1)
    good = np.isfinite(steradians)
    assert good.sum() >= 35  # beside the rim an eye may see nothing
    assert 1.0 / steradians[good] == pytest.approx(spread[good], rel=2e-4)


def test_places_beside_the_tip_of_a_cone_are_found() -> None:
    """400 places 1 um to 1 mm from the tip, lens 4 mm off the axis: the point to which a ray goes on leads back there.

    The tip is where the search in the half-plane ends for most of them.
    """
    profile, rng = PROFILES["cone"], np.random.default_rng(9)
    r, turn = 10.0 ** rng.uniform(-6.0, -3.0, 400), rng.uniform(0.0, 2.0 * np.pi, 400)
    side = np.stack([np.cos(turn), np.sin(turn), np.ones(400)], axis=-1)  # 45 degrees: as far up as out
    places, normals = r[:, None] * side, (side - [0.0, 0.0, 2.0]) / np.sqrt(2.0)
    eyes = np.array([0.004, -0.003, -0.2]) + np.append(rng.uniform(-8e-4, 8e-4, (400, 2)), np.zeros((400, 1)), axis=1)
    ways = (places - eyes) / np.linalg.norm(places - eyes, axis=1)[:, None]
    out = ways - 2.0 * np.einsum("ni,ni->n", ways, normals)[:, None] * normals
    found, _, valid = revolved_points(places + rng.uniform(0.5, 4.0, (400, 1)) * out, eyes, profile)
    assert valid.all()
    assert np.abs(found - places).max() < 1e-12


@pytest.mark.parametrize("shape", [name for name in PROFILES if name != "cone"])
def test_points_within_millimetres_of_a_mirror_are_found(shape: str) -> None:
    """4000 places of a mirror with a trefoil of 0.1 mm: the point 0.5 to 10 mm along the reflected ray leads back.

    Newton's steps alone lose some of these in the cap of a sphere, for the path bends within millimetres there.
    """
    profile, rng = PROFILES[shape], np.random.default_rng(17)
    surface = RevolvedMirror(profile, form=Form(form_33c_m=1e-4)).surface
    r, turn = profile.rim_radius_m * np.sqrt(rng.uniform(0.0, 0.9999, 4000)), rng.uniform(0.0, 2.0 * np.pi, 4000)
    x, y = r * np.cos(turn), r * np.sin(turn)
    at = surface.heights(x, y)
    places, normals = np.column_stack([x, y, at.z_m]), np.column_stack([at.x, at.y, np.full(4000, -1.0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ways = places - [0.004, -0.003, -0.2]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    facing = -np.einsum("ni,ni->n", ways, normals)
    out = ways + 2.0 * facing[:, None] * normals
    points = places + 10.0 ** rng.uniform(-3.3, -2.0, (4000, 1)) * out
    seen = facing > 1e-3
    assert seen.sum() > 1000
    eyes = np.broadcast_to([0.004, -0.003, -0.2], points.shape)
    found, _, valid = revolved_points(points[seen], eyes[seen], surface)
    assert valid.all()
    assert np.abs(found - places[seen]).max() < 1e-12


@pytest.mark.parametrize("half_angle", [0.5, np.pi / 4.0])
def test_the_tip_of_a_cone_reflects_nothing(half_angle: float) -> None:
    """A point straight below is seen nowhere, and the ray into the tip has no answer that is finite by chance."""
    profile, eye = cone(half_angle, 0.06), np.array([[0.0, 0.0, -0.2]])
    _, _, valid = revolved_points(np.array([[0.0, 0.0, -1.0]]), eye, profile)
    assert not valid.any()
