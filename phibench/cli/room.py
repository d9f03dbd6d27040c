"""Commands `phibench room`: panoramas of mirror-ball photos or rooms, meshes; `phibench scene`: samples for Mitsuba."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.options import DATA, DataFolder, OneSample, OutFolder, Whole

if TYPE_CHECKING:
    from phibench.calibration.outline.mirror_ball import BallPhoto

room = App(name="room", group=DATA, help="Make rooms of photographs, and files of rooms.")


@Parameter(name="*")
@dataclass(frozen=True)
class BallOptions:
    """Ball and camera of the photograph.

    Parameters
    ----------
    radius_m
        Radius of the ball.
    distance_m
        From the lens to the ball's centre; this or --focal-px is needed.
    focal_px
        Focal length, pixels of the photograph.
    principal_point_px
        Pixel (u, v) on the camera's axis; the middle of the photograph by default.
    circle
        Centre (u, v) and radius of the ball's outline, pixels; looked for by default.
    camera_elevation_deg
        Of the camera's axis above the horizon: 0 horizontal, 90 looking up at the ball.
    """

    radius_m: float
    distance_m: float | None = None
    focal_px: float | None = None
    principal_point_px: Annotated[tuple[float, float] | None, Parameter(negative="")] = None
    circle: Annotated[tuple[float, float, float] | None, Parameter(negative="")] = None
    camera_elevation_deg: float = 0.0

    @property
    def stated(self) -> BallPhoto:
        """The same for the fit."""
        from phibench.calibration.outline.mirror_ball import BallPhoto

        centre_px, elevation_deg = self.principal_point_px, self.camera_elevation_deg
        return BallPhoto(self.radius_m, self.distance_m, self.focal_px, centre_px, self.circle, elevation_deg)


@room.command
def from_mirror_ball(
    photo: Path,
    *,
    out: Path,
    ball_of: BallOptions,
    surroundings_m: float = 2.5,
    width: Whole | None = None,
    point_m: Annotated[tuple[float, float, float] | None, Parameter(negative="")] = None,
    box_m: Annotated[tuple[float, float, float, float, float] | None, Parameter(negative="")] = None,
    sensor: Path | None = None,
) -> int:
    """Unwrap a photograph of a mirror ball into a panorama of its surroundings.

    A copy of the photograph with the ball's outline is written beside it. The panorama's middle looks from the ball to
    the camera, which is seen there. It is taken at the ball's centre. The table of a recipe that reads the file is
    printed. A photograph does not tell the walls and where the ball was: state them, or put them into the table.

    Parameters
    ----------
    photo
        JPEG, PNG, TIFF, BMP, PPM, PGM, OpenEXR or Radiance HDR file; turned upright as its EXIF data say.
    out
        Panorama to write: .exr (linear light, and what is seen) or .png.
    surroundings_m
        Distance of the surroundings from the ball's centre; a large number for a scene far away.
    width
        Columns of the panorama, even; by default as fine as the photograph, up to the 2880 that a recipe reads.
    point_m
        Place of the ball's centre in the room: from the robot, x its front, z up from the floor; for the table.
    box_m
        Walls around the robot: x_low, x_high, y_low, y_high, height; for the table.
    sensor
        TOML file of the sensor, of a photograph that holds DN; by default the preset bayer-raw is assumed.
    """
    from phibench.calibration.captures.picture_files import read_linear
    from phibench.calibration.outline.mirror_ball import (
        find_ball,
        panorama_table,
        require_suffix,
        unwrap,
        write_outline,
        write_panorama,
    )
    from phibench.datasets.frames.sensor_file import read_sensor_file
    from phibench.datasets.store.files import require_writable

    stated = ball_of.stated
    require_suffix(out)
    require_writable(out)  # before the work, so that nothing is lost
    table = panorama_table(out, point_m, box_m, surroundings_m)  # checks the numbers before the photograph is read
    light = read_linear(photo, None if sensor is None else read_sensor_file(sensor))
    ball = find_ball(light, stated)
    u, v, radius = ball.circle_px
    found = (
        "as stated"
        if ball_of.circle
        else f"each +- {ball.sigma_px:.2g} px, with edges on {100.0 * ball.edges:.0f} % of it; if it is wrong, give "
        "--circle"
    )
    print(f"outline: centre ({u:.1f}, {v:.1f}) px, radius {radius:.1f} px, {found}")
    camera, s = ball.view.rig.camera, ball.view.rig.sphere_in_camera_m
    print(f"focal length {camera.fx_px:.0f} px; ball's centre {sum(x * x for x in s) ** 0.5:.4g} m from the lens")
    panorama = unwrap(light, ball, surroundings_m, width)
    write_panorama(out, panorama)
    drawn = write_outline(out.with_name(f"{out.stem}-outline.png"), light, ball)
    print(f"{drawn}: the outline on the photograph; look at it")
    rows, columns = panorama.seen.shape
    print(
        f"{out}: {columns} x {rows} pixels of {360.0 / columns:.2g} degrees, scene {surroundings_m:g} m away; "
        f"{100.0 * float(panorama.seen.mean()):.1f} % is seen, the rest takes the nearest that is"
    )
    print(f"\n{table}")
    return 0


_Properties = Annotated[tuple[str, ...], Parameter(name="--set", negative="")]


@room.command
def panorama(
    *,
    out: Path,
    point_m: Annotated[tuple[float, float, float], Parameter(negative="")],
    room_name: Annotated[str | None, Parameter(name="--room")] = None,
    seed: Whole | None = None,
    properties: _Properties = (),
    heading_deg: float = 0.0,
    rows: Whole = 512,
) -> int:
    """Render a panorama of a generated room or of one of the catalogue, for rooms without a photograph.

    The robot is left out. The table of a recipe that reads the file is printed.

    Parameters
    ----------
    out
        OpenEXR file to write, W/(m^2 sr).
    point_m
        Place of the camera: from the robot, x its front, z up from the floor.
    room_name
        Room of the catalogue, "lab"; without its boards.
    seed
        Number of a generated room, instead: a box along the world's axes unless --set says otherwise.
    properties
        A property of the generated room, such as height_m=2.6; once for each, the others are drawn.
    heading_deg
        Azimuth of the picture's middle column, from world x towards y.
    rows
        Rows of the panorama; it has twice as many columns.
    """
    from phibench.datasets.build.room_export import export_panorama, export_room
    from phibench.datasets.common.progress import Steps, progress_console

    room_of_it = export_room(room_name, seed, properties, box=True)
    with Steps(progress_console(), f"panorama of {room_of_it.name}, light and pixels", 1, announce=True) as steps:
        made = export_panorama(room_of_it, out, point_m, heading_deg, rows)
        steps.advance()
    print(f"\n# {made.path}: {2 * rows} x {rows} pixels\n{made.table}")
    return 0


@room.command
def mesh(
    *,
    out: Path,
    room_name: Annotated[str | None, Parameter(name="--room")] = None,
    seed: Whole | None = None,
    properties: _Properties = (),
) -> int:
    """Write a generated room or one of the catalogue as glTF, with its textures and lamps.

    The robot, the sun and glossy coats are left out. The table of a recipe that reads the file is printed.

    Parameters
    ----------
    out
        File to write, .glb.
    room_name
        Room of the catalogue, "lab"; without its boards.
    seed
        Number of a generated room, instead.
    properties
        A property of the generated room, such as height_m=2.6; once for each, the others are drawn.
    """
    from phibench.datasets.build.room_export import export_mesh, export_room

    made = export_mesh(export_room(room_name, seed, properties), out)
    print(f"\n# {made.path}: {made.path.stat().st_size / 1e6:.1f} MB\n{made.table}")
    return 0


scene = App(name="scene", group=DATA, help="Write samples as scenes for other programs.")


@scene.command
def export(
    directory: DataFolder, *, out: OutFolder, sample: OneSample = None, position: Literal["down", "up"] | None = None
) -> int:
    """Write a sample as Mitsuba XML with meshes and pictures, for an unmodified Mitsuba.

    Each scene has all its light, the room's alone, or the laser spot alone. Our own images of them lie beside, as
    radiance. README.md in the folder says how to compare, and what a scene does not carry.

    Parameters
    ----------
    position
        "down" or "up"; both by default.
    """
    from phibench.datasets.read import open_finished
    from phibench.datasets.scene.scene_export import export_scene
    from phibench.scenes.rig import POSITIONS

    (chosen,) = open_finished(directory).chosen(["0" if sample is None else sample])  # the first, where none is named
    done = export_scene(chosen, out, POSITIONS if position is None else (position,))
    for loss in done.losses:
        print(f"not carried: {loss}")
    names = ", ".join(path.name for path in done.scenes)
    print(f"{out}: {names}; open one with `mitsuba -m llvm_ad_rgb {done.scenes[0]}`, compare as {done.readme} says")
    return 0
