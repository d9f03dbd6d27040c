"""Commands `phibench calibrate` and `phibench align`: fit a rig's corrections, or align the mirror under the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from phibench.calibration.rig.sphere_options import SphereOptions
from phibench.cli.options import DEFAULT_PRESET, DataFolder, Flag, Preset, SensorFile

if TYPE_CHECKING:
    from phibench.calibration.rig.from_dataset import CalibrationSources
    from phibench.calibration.rig.known_spots import Ruler

_LAB = (
    "sigma of the outline: checked in the room `lab`; in a room with more lamps or edges widen it with "
    "--outline-sigma-factor 2"
)


@Parameter(name="*")
@dataclass(frozen=True)
class SourceOptions:
    """Sources of a calibration, and how well its rig is known.

    Parameters
    ----------
    spots
        Also use the laser spots at their known distances.
    vertical
        Also use the room's vertical edges, which give the camera's tilt.
    distance_sigma_m
        How well the distance of each spot was measured, one standard deviation, metres.
    height_sigma_m
        The same of its height above the floor; not measured by default.
    azimuth_sigma_deg
        The same of its azimuth, degrees; not measured by default.
    outline_sigma_factor
        Widens the outline's standard deviation. 1 holds in the room `lab`; take 1.5 to 2 in a room with more lamps,
        edges or patterns.
    focal_sigma
        How well the nominal focal length is known, relative: 0.003 by default. Give 0.018 for a lens that was turned
        since it was measured.
    """

    spots: bool = False
    vertical: Flag = False
    distance_sigma_m: float = 1e-3
    height_sigma_m: float = math.inf
    azimuth_sigma_deg: float = math.inf
    outline_sigma_factor: float = 1.0
    focal_sigma: float | None = None

    @property
    def sources(self) -> CalibrationSources:
        """The same for the calibration."""
        from phibench.calibration.rig.from_dataset import CalibrationSources

        return CalibrationSources(self.spots, self.vertical, self.outline_sigma_factor, self.focal_sigma)

    @property
    def ruler(self) -> Ruler:
        """Precision of the spots' places.

        Raises
        ------
        DatasetError
            If it is given without spots, or is out of its range.
        """
        from phibench.calibration.rig.known_spots import Ruler
        from phibench.datasets.common.errors import DatasetError

        if not self.spots and (math.isfinite(self.height_sigma_m) or math.isfinite(self.azimuth_sigma_deg)):
            raise DatasetError("--height-sigma-m and --azimuth-sigma-deg are about calibration spots: give --spots too")
        return Ruler(self.distance_sigma_m, self.height_sigma_m, math.radians(self.azimuth_sigma_deg))


_OUTLINES = SourceOptions()


def calibrate(
    directory: DataFolder,
    *,
    out: Path,
    sample: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    preset: Preset = DEFAULT_PRESET,
    given: SourceOptions = _OUTLINES,
    picture: Path | None = None,
) -> int:
    """Calibrate a rig from the images of a data set; write a calibration file and a picture.

    Parameters
    ----------
    out
        JSON file to write.
    sample
        Samples: numbers, counted from 0, or ids; the first one by default.
    preset
        Preset of the frames to draw: "mjpeg", "srgb8", "bayer-raw" or "mono-raw"; "layers" is noise-free.
    picture
        PNG to write: the outline on the frame, with its residuals enlarged; by default beside the calibration.
    """
    from phibench.calibration.captures.imported_calibration import calibrate_imported
    from phibench.calibration.captures.imported_set import open_imported
    from phibench.calibration.rig.from_dataset import calibrate_dataset
    from phibench.calibration.rig.known_spots import Ruler
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.common.progress import progress_console, stages
    from phibench.datasets.store.files import require_writable
    from phibench.datasets.store.pair_files import is_imported
    from phibench.estimator.geometry.rig_parameters import PARAMETERS, has_effect
    from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT

    sources, ruler = given.sources, given.ruler
    require_writable(out)  # a folder such as "." has no name to which an ending could be given
    picture = out.with_suffix(".png") if picture is None else picture
    imported = is_imported(directory)
    if imported and (ruler != Ruler() or preset not in (DEFAULT_PRESET, open_imported(directory).preset)):
        raise DatasetError(
            f"{directory} holds pictures: their kind and the tape's standard deviation were imported with them; "
            "leave --preset and the sigmas out"
        )
    with stages(progress_console(), "calibrate") as told:
        told("outlines" + " and spots" * given.spots)
        if imported:
            result = calibrate_imported(directory, out, sample, sources)
        else:
            result = calibrate_dataset(directory, out, sample, preset, sources, ruler)
    print(f"{result.verdict}.")
    print(f"{result.write_picture(picture)}: the outline on the frame that fits worst, residuals enlarged")
    print(_LAB)
    print(f"\n{'parameter':18s} {'unit':4s} {'correction':>11s} {'sigma':>8s} {'prior sigma':>11s}")
    # what changes no pixel has no row
    every = zip(PARAMETERS, result.bundle.values, result.prior_sigmas, has_effect(result.nominal), strict=True)
    for name, value, prior in (row[:3] for row in every if row[3]):
        unit = MISALIGNMENT[name].unit
        print(f"{name:18s} {unit:4s} {value:+11.3e} {result.bundle.sigmas[name]:8.1e} {prior:11.1e}")
    if result.bundle.undetermined:
        print("\ncombinations that the data say little about (shares in prior sigmas):")
        for weak in result.bundle.undetermined:
            parts = ", ".join(f"{name} {share:+.2f}" for name, share in weak.parts.items())
            print(f"  {parts} ({100.0 * weak.remaining:.0f} % of the prior sigma is left)")
    print(f"\n{out}: calibration; use it with `phibench measure` or `score`, --calibration {out}")
    return 0


@Parameter(name="*")
@dataclass(frozen=True)
class Doubts:
    """Standard deviations of what is known of the rig.

    Parameters
    ----------
    tilt_sigma_deg
        How well the camera is known to be vertical.
    principal_point_sigma_px
        How well the principal point is known.
    mirror_tilt_sigma_deg
        How well the axis of a mirror that is no sphere is known to be upright.
    outline_sigma_factor
        As in `phibench calibrate`.
    """

    tilt_sigma_deg: float = 0.1
    principal_point_sigma_px: float = 5.0
    mirror_tilt_sigma_deg: float = 0.5
    outline_sigma_factor: float = 1.0

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """The same for `alignment`, in its order and units."""
        tilt, mirror_tilt = math.radians(self.tilt_sigma_deg), math.radians(self.mirror_tilt_sigma_deg)
        return tilt, self.principal_point_sigma_px, self.outline_sigma_factor, mirror_tilt


_DEFAULT_RIG, _BY_HAND = SphereOptions(), Doubts()


def align(
    image: Path,
    *,
    out: Path | None = None,
    rig: Path | None = None,
    stated: Annotated[SphereOptions, Parameter(name="*")] = _DEFAULT_RIG,
    doubts: Doubts = _BY_HAND,
    sensor: SensorFile = None,
    vertical: bool = True,
) -> int:
    """Print by how far and in which direction the mirror must move to be centred, and how sharp the picture is.

    Vertical edges of the room make the paper's check: of an aligned rig they pass through the middle of the mirror's
    image. Where the rig is known they also tell the camera's tilt, and the move becomes more certain.

    A rig file says camera and mirror, of any shape. Without one the mirror is a sphere, and numbers say the rest. Of a
    camera whose focal length is not stated, the circle of the mirror's outline is printed and drawn, in pixels.

    Parameters
    ----------
    image
        Frame of the camera: JPEG, PNG, TIFF, BMP, PPM or PGM; turned upright as its EXIF data say.
    out
        PNG to write: the outline and an arrow, 20 times as long as the move; by default `<image>-align.png` in
        the current folder.
    rig
        TOML file with what is known of the rig, as for `phibench measure`; instead of the numbers of camera and mirror.
    vertical
        Use the room's vertical edges, where three or more agree; --no-vertical leaves them out.
    """
    from phibench.calibration.captures.picture_files import read_picture, sensor_choice
    from phibench.calibration.captures.rig_file import read_rig_file, require_camera_size
    from phibench.calibration.outline.first_circle import rig_circle
    from phibench.calibration.rig.align import (
        alignment,
        alignment_verdict,
        camera_in_words,
        circle_in_words,
        circle_of,
        edges_in_words,
        in_words,
        meeting_of,
        rig_of_numbers,
        sharpness,
        sharpness_in_words,
        write_alignment_picture,
        write_circle_picture,
    )
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.frames.sensor_file import read_sensor_file

    stated.require_sound()
    given = stated.given()
    if rig is not None and given:
        raise DatasetError(f"{next(iter(given))}: {rig} says what the rig is; write it there, and leave the option out")
    known = None if rig is None else read_rig_file(rig).rig
    photo = read_picture(image)
    pixels, card = photo.pixels, sensor_choice(photo, None if sensor is None else read_sensor_file(sensor)).card
    out = Path(f"{image.stem}-align.png") if out is None else out
    if known is None:
        known = rig_of_numbers(pixels, card, stated)
    else:
        require_camera_size(known, (pixels.shape[1], pixels.shape[0]), str(image))
    if known is None:
        circle = circle_of(pixels, card)
        meeting = meeting_of(pixels, card, circle) if vertical else None
        print(circle_in_words(circle))
        print(f"{write_circle_picture(out, pixels, card, circle, meeting)}: outline and vertical edges; look at it")
        if vertical:
            print(edges_in_words(meeting, float(circle.sigma_px[:2].max())))
        print(sharpness_in_words(sharpness(pixels, card, circle.circle_px)))
        return 0
    result = alignment(pixels, known, card, *doubts.numbers, vertical)
    print(alignment_verdict(result))
    print(f"{write_alignment_picture(out, pixels, known, result)}: outline, and the move drawn 20 times as long")
    print(in_words(result))
    if vertical:
        print(edges_in_words(result.meeting))
    print(camera_in_words(result))
    print(sharpness_in_words(sharpness(pixels, card, rig_circle(result.outline.rig(known)))))
    print(_LAB)
    return 0
