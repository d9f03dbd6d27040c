"""Recipe of a data set as pydantic models, one per TOML table: keys, types, ranges, defaults, meanings.

Lengths are in metres, angles in radians unless the key says degrees; every key names its unit. Types and ranges stand
here and nowhere else. `recipe/checks` checks several keys together. `recipe/load` reports the faults.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, create_model

from phibench.datasets.recipe.distributions import (
    Distribution,
    DistributionTable,
    Name,
    Table,
    Targets,
    ValuesOf,
    drawn_fields,
    is_whole,
)
from phibench.datasets.recipe.film_tables import FilmTable
from phibench.datasets.recipe.mirror_tables import (
    DRAWN_OF_MIRROR,
    HolderTable,
    MirrorTable,
    OfHolder,
    ReflectionTable,
    Tilt,
    Unit,
)
from phibench.datasets.recipe.room_tables import RoomsTable, RoomTable
from phibench.scenes.metals import MetalName
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS
from phibench.scenes.random_streams import LARGEST_SEED
from phibench.scenes.room import BOARD_SIZE_M
from phibench.scenes.validation import SceneError, shipped_tables

MIN_STROKE_M, MAX_STROKE_M = 1e-3, 10.0  # below a millimetre there is no parallax to measure
DatasetName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)]
StrokeM = Annotated[float, Field(ge=MIN_STROKE_M, le=MAX_STROKE_M)]
Decentre = Annotated[float, Field(ge=-0.1, le=0.1)]
Distortion = Annotated[float, Field(ge=-1000.0, le=1000.0)]
FocalPx = Annotated[float, Field(ge=50.0, le=50000.0)]
Response = Annotated[tuple[Unit, ...], Field(strict=False, min_length=3, max_length=3)]


def _pixel_presets() -> tuple[str, ...]:
    """Names of the shipped presets that end in pixels; `settings` is not imported, as no spot depends on a sensor."""
    file = Path(__file__).parents[2] / "render" / "sensor" / "settings_presets.toml"
    presets = shipped_tables(file).get("presets")
    if not isinstance(presets, dict) or not all(isinstance(table, dict) for table in presets.values()):
        raise SceneError(f"{file} needs a table [presets.NAME] for each preset; mend it")
    return tuple(name for name, table in presets.items() if table.get("output") != "electrons")


if TYPE_CHECKING:
    Preset = str
else:
    Preset = Literal[_pixel_presets()]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
OWN_ALBEDO = "surface"
"""Value of `laser.albedo`: that of each surface."""
SENSOR_KEYS = ("jpeg_quality", "sharpen_amount", "analogue_gain", "read_noise_e", "prnu")
"""Keys of `[frames]` that are numbers of the sensor's preset."""
SENSOR_OF_FRAME = (
    "preset",
    "name",
    "exposure_s",
    "output",
    "findings",
    "sigma",
    "assumed",
    "not_determined",
    "measured",
    "source",
)
"""What `[frames.sensor]` does not take: what belongs to frames, and a sensor file's tables beside its numbers."""


def _one() -> DistributionTable:
    return DistributionTable(choice=(1.0,))


def _half() -> DistributionTable:
    return DistributionTable(log_uniform=(0.05, 0.5))


def _albedo_tag(given: object) -> str:
    return "<surface>" if isinstance(given, str) else "<number>"


def _exposure_tag(given: object) -> str:
    return "<auto>" if isinstance(given, str) else "<distribution>"


Stroke = Annotated[Distribution, ValuesOf(StrokeM)]
Level = Annotated[Distribution, ValuesOf(Annotated[float, Field(ge=0.0, le=1e6)])]
FluxRatio = Annotated[Distribution, ValuesOf(Annotated[float, Field(ge=1e-6, le=0.5)])]
Diameter = Annotated[Distribution, ValuesOf(Annotated[float, Field(ge=1e-6, le=min(BOARD_SIZE_M) / 2.0)])]
Distance = Annotated[Distribution, ValuesOf(Annotated[float, Field(ge=0.1, le=100.0)])]
Elevation = Annotated[Distribution, ValuesOf(Annotated[float, Field(ge=-89.0, le=89.0)])]
WholeNumbers = Annotated[Distribution, AfterValidator(is_whole)]
Exposure = Annotated[
    Annotated[Distribution, Tag("<distribution>")] | Annotated[Literal["auto"], Tag("<auto>")],
    Discriminator(_exposure_tag),
]
Albedo = Annotated[
    Annotated[Unit, Tag("<number>")] | Annotated[Literal["surface"], Tag("<surface>")], Discriminator(_albedo_tag)
]
"""The tags keep pydantic from trying both; `validation` leaves what stands in angle brackets out of a path."""


class DatasetTable(Table):
    """`[dataset]`."""

    name: DatasetName = Field(description="name of the data set")
    seed: int = Field(default=0, ge=0, le=LARGEST_SEED, description="root of all random streams; 0 is legal")


class RigTable(Table):
    """`[rig]`: a preset, and what differs from it."""

    later = ("mirror", "metal", "reflectance")

    preset: Literal["default", "c310"] = Field(default="default", description="rig to start from")
    z_c_m: float | None = Field(
        default=None, gt=0.0, le=5.0, description="camera centre to sphere centre, along the camera's axis"
    )
    camera_height_m: float | None = Field(
        default=None, ge=0.34, le=10.0, description="height of the lens centre above the floor at the down position"
    )
    radius_m: float | None = Field(default=None, gt=0.0, le=1.0, description="radius of the spherical mirror")
    roughness_alpha: float | None = Field(
        default=None, ge=0.0, le=0.05, description="Beckmann roughness of the mirror; 0 is ideal"
    )
    metal: MetalName | None = Field(default=None, description='metal of the mirror; "steel" where not given')
    width_px: int | None = Field(default=None, ge=16, le=8192, description="image width")
    height_px: int | None = Field(default=None, ge=16, le=8192, description="image height")
    pixel_pitch_um: float | None = Field(default=None, gt=0.0, le=100.0, description="pixel pitch")
    fx_px: FocalPx | None = Field(default=None, description="focal length along u; fy_px if only that is given")
    fy_px: FocalPx | None = Field(default=None, description="focal length along v; fx_px if only that is given")
    cx_px: float | None = Field(
        default=None, ge=-8192.0, le=16384.0, description="principal point u; the image centre if width_px is given"
    )
    cy_px: float | None = Field(
        default=None, ge=-8192.0, le=16384.0, description="principal point v; the image centre if height_px is given"
    )
    k1: Distortion | None = Field(default=None, description="radial distortion (Brown, as OpenCV)")
    k2: Distortion | None = Field(default=None, description="radial distortion (Brown, as OpenCV)")
    k3: Distortion | None = Field(default=None, description="radial distortion (Brown, as OpenCV)")
    p1: Distortion | None = Field(default=None, description="tangential distortion (Brown, as OpenCV)")
    p2: Distortion | None = Field(default=None, description="tangential distortion (Brown, as OpenCV)")
    f_number: float | None = Field(default=None, ge=0.5, le=256.0, description="focal length over aperture diameter")
    focus_distance_m: float | None = Field(
        default=None, ge=0.01, le=1000.0, description="plane of focus from the lens; z_c - R/2 where not given"
    )
    blur_sigma_px: float | None = Field(
        default=None, ge=0.05, le=20.0, description="Gaussian optical blur besides defocus"
    )
    laser_filter_response: Response | None = Field(default=None, description="R, G, B at the laser's line, over red")
    decentre_x_m: Decentre = Field(default=0.0, description="sphere centre off the camera's vertical, world x")
    decentre_y_m: Decentre = Field(default=0.0, description="sphere centre off the camera's vertical, world y")
    tilt_x_rad: Tilt = Field(default=0.0, description="camera turned about world x, the mirror stays")
    tilt_y_rad: Tilt = Field(default=0.0, description="camera turned about world y, the mirror stays")
    stroke_tilt_x_rad: Tilt = Field(default=0.0, description="stroke axis turned about world x")
    stroke_tilt_y_rad: Tilt = Field(default=0.0, description="stroke axis turned about world y")
    reflectance: ReflectionTable | None = Field(default=None, description="measured reflectance of the mirror")
    holder: HolderTable = Field(default_factory=HolderTable, description="what carries the mirror")
    mirror: MirrorTable | None = Field(default=None, description="a mirror of another shape than a sphere")


class _OfMisalignment(Table):
    """Table with keys of a misalignment."""

    later = OF_REVOLVED


if TYPE_CHECKING:
    MisalignmentTable = Table
    RandomMisalignmentTable = Table
else:
    MisalignmentTable = create_model(
        "MisalignmentTable",
        __base__=_OfMisalignment,
        __doc__="`[misalignment]`: what the true rig deviates by from `[rig]`, which is the nominal one.",
        **{
            key: (float, Field(default=0.0, ge=-one.limit, le=one.limit, description=one.meaning))
            for key, one in PARAMETERS.items()
        },
    )
    RandomMisalignmentTable = create_model(
        "RandomMisalignmentTable",
        __base__=_OfMisalignment,
        __doc__="`[random.misalignment]`: distributions of keys of `[misalignment]`.",
        **drawn_fields(MisalignmentTable, PARAMETERS),
    )


class LaserTable(Table):
    """`[laser]`: one laser for all targets."""

    power_w: float = Field(default=1e-3, gt=0.0, le=10.0, description="laser power on the wall")
    wavelength_nm: float = Field(default=650.0, ge=400.0, le=700.0, description="vacuum wavelength")
    profile: Literal["gaussian", "uniform"] = Field(default="gaussian", description="shape of the spot")
    albedo: Albedo = Field(
        default=0.7,
        description="albedo of what the spot lies on, at the laser's wavelength; 'surface' is each surface's own",
    )
    diameter_m: float | None = Field(
        default=None, gt=0.0, le=1.0, description="one diameter for every spot, instead of base and growth"
    )
    diameter_base_m: float = Field(default=3e-3, ge=0.0, le=1.0, description="spot diameter at distance 0")
    diameter_growth_m_per_m: float = Field(
        default=1e-3, ge=0.0, le=0.1, description="growth of the spot diameter per metre of depth_m"
    )


class AmbientTable(Table):
    """`[ambient]`: how well the room is rendered."""

    quality: Literal["reference", "training"] = Field(
        default="reference",
        description="noise of the room's light in the mirror: below a quarter of the sensor's, or below a half",
    )
    cells_per_pixel: int = Field(
        default=2,
        ge=2,
        le=32,
        description="cells along a pixel's side where the image has detail; more samples where noise asks",
    )
    texel_m: float = Field(default=0.05, ge=0.01, le=2.0, description="size of the light map's texels")
    indirect_texel_m: float = Field(
        default=0.1, ge=0.01, le=2.0, description="texels for light that comes from surfaces; texel_m if that is more"
    )
    lamp_rays: int = Field(
        default=64, ge=1, le=65536, description="shadow rays per texel and lamp, twice, where shadows end; the mean"
    )
    bounces: int = Field(default=12, ge=0, le=100, description="passes of bounced light before the last one")
    bounce_rays: int = Field(default=64, ge=1, le=65536, description="rays in such a pass, per texel of 0.1 m")
    final_rays: int = Field(
        default=128, ge=1, le=65536, description="rays per texel in the last pass, twice; more where noise asks"
    )


class TargetTable(Table):
    """`[[targets]]`: a board with a laser spot at its centre."""

    name: Name = Field(description="name of the target")
    depth_m: float = Field(
        gt=0.0, le=100.0, description="horizontal distance of the board's face from the world's z axis"
    )
    azimuth_deg: float = Field(ge=-360.0, le=360.0, description="direction from world x towards world y")
    height_m: float = Field(ge=0.0, le=100.0, description="height of the spot above the floor")
    diameter_m: float | None = Field(
        default=None, gt=0.0, le=1.0, description="diameter of this spot, instead of what [laser] says"
    )


class ExperimentTable(Table):
    """`[[experiments]]`: every target with every stroke."""

    name: Name = Field(description="name of the experiment")
    targets: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="names from [[targets]]"
    )
    strokes_m: Annotated[tuple[StrokeM, ...], Field(strict=False, min_length=1)] = Field(
        description="strokes (baselines); 0 has no parallax and gives no depth"
    )


DRAWABLE = tuple(
    key
    for key, field in RigTable.model_fields.items()
    if "float" in (kind := str(field.annotation)) and "tuple" not in kind
)
"""Keys of `[rig]` that may be drawn: all single numbers but the size of the image, which all samples share."""

if TYPE_CHECKING:
    RandomHolderTable = Table
else:
    RandomHolderTable = create_model(
        "RandomHolderTable",
        __base__=OfHolder,
        __doc__="`[random.rig.holder]`: distributions of keys of `[rig.holder]`.",
        **drawn_fields(HolderTable, HolderTable.model_fields),
    )

if TYPE_CHECKING:
    RandomMirrorTable = Table
else:
    RandomMirrorTable = create_model(
        "RandomMirrorTable",
        __base__=Table,
        __doc__="`[random.rig.mirror]`: distributions of keys of `[rig.mirror]`.",
        **drawn_fields(MirrorTable, DRAWN_OF_MIRROR),
    )


class _OfRandomRig(Table):
    """Table with distributions of keys of a rig."""

    later = ("mirror",)


if TYPE_CHECKING:
    RandomRigTable = Table
else:
    RandomRigTable = create_model(
        "RandomRigTable",
        __base__=_OfRandomRig,
        __doc__="`[random.rig]`: distributions of keys of `[rig]`.",
        **drawn_fields(RigTable, DRAWABLE),
        holder=(
            RandomHolderTable,
            Field(default_factory=RandomHolderTable, description="distributions of keys of [rig.holder]"),
        ),
        mirror=(
            RandomMirrorTable | None,
            Field(default=None, description="distributions of keys of [rig.mirror], which must be given too"),
        ),
    )


class RandomSpotTable(Table):
    """`[random.spot]`: on a board that is drawn, or where a horizontal ray from the axis meets what stands there."""

    target: Targets = Field(default=None, description="boards; all of them where not given")
    across_m: Distribution | None = Field(
        default=None, description="from the board's centre to the right, seen from the axis; 0 where not given"
    )
    up_m: Distribution | None = Field(default=None, description="from the board's centre upwards; 0 where not given")
    azimuth_deg: Distribution | None = Field(
        default=None, description="of the ray, from world x towards world y; instead of a board"
    )
    height_m: Distribution | None = Field(
        default=None, description="of the ray's start above the floor; with azimuth_deg"
    )
    elevation_deg: Elevation | None = Field(
        default=None, description="of the ray above the horizontal; 0 where not given"
    )
    hidden: Probability | None = Field(
        default=None, description="share of samples whose spot is hidden in one image; the others show it in both"
    )
    hidden_elevation_deg: Elevation | None = Field(
        default=None, description="instead of elevation_deg for those samples"
    )

    @property
    def by_ray(self) -> bool:
        """True where a ray finds the spot, instead of a board that is drawn."""
        return self.azimuth_deg is not None


class RandomTable(Table):
    """`[random]`: samples that are drawn, each with a rig, a spot and a stroke of its own."""

    samples: int = Field(default=100, ge=1, le=1_000_000, description="how many; more keep those that are there")
    sequence: Literal["sobol", "independent"] = Field(
        default="sobol", description="points that fill the space evenly, or independent ones"
    )
    stroke_m: Stroke = Field(description="distribution of the stroke; drawn ones are rounded to 1 nm")
    rig: RandomRigTable = Field(default_factory=RandomRigTable, description="distributions of keys of [rig]")
    misalignment: RandomMisalignmentTable = Field(
        default_factory=RandomMisalignmentTable, description="distributions of keys of [misalignment]"
    )
    spot: RandomSpotTable = Field(default_factory=RandomSpotTable, description="distribution of the laser spot")


class DrawnRigsTable(Table):
    """`[rigs]`: drawn rigs, each of which sees all `[[experiments]]`."""

    count: int = Field(default=1, ge=1, le=100_000, description="how many; more keep those that are there")
    misalignment: RandomMisalignmentTable = Field(
        default_factory=RandomMisalignmentTable, description="distributions of keys of [misalignment]"
    )


class FramesTable(Table):
    """`[frames]`: how frames are taken; every number is drawn per sample and is the same in all presets."""

    later = ("sensor",)

    presets: Annotated[tuple[Preset, ...], Field(strict=False, min_length=1)] = Field(
        default=("bayer-raw",), description="sensor presets, each for every sample"
    )
    draws: int = Field(default=1, ge=1, le=10_000, description="draws of the noise, per sample and preset")
    exposure_s: Exposure | None = Field(
        default="auto", description="exposure time; 'auto' is the camera's for the down image, kept for the others"
    )
    laser_level: Level = Field(default_factory=_one, description="factor of the laser's light")
    lamp_level: Level = Field(default_factory=_one, description="factor of the room's light")
    jpeg_quality: WholeNumbers | None = Field(default=None, description="libjpeg's quality; whole numbers")
    sharpen_amount: Distribution | None = Field(default=None, description="gain of the unsharp mask")
    analogue_gain: Distribution | None = Field(default=None, description="gain before the converter")
    read_noise_e: Distribution | None = Field(default=None, description="read noise, rms electrons per pixel")
    prnu: Distribution | None = Field(default=None, description="relative spread of the pixels' responsivity")
    laser_off: bool = Field(default=True, description="whether frames with the laser off are given too")
    hint: Probability = Field(default=0.0, description="probability that a pair comes with boxes that hold its spots")
    hint_box_px: int = Field(default=64, ge=16, le=8192, description="side of such a box")
    camera: Literal["per_sample", "one"] = Field(
        default="per_sample", description="whether each sample has a camera, hence a fixed pattern, of its own"
    )
    sensor: dict[str, Any] | None = Field(default=None, description="numbers of a measured camera, as in a sensor file")


class DistractorTable(Table):
    """`[[distractors]]`: another light; on a board, where a ray ends, or free in the room."""

    kind: Literal["spot", "glow", "led"] = Field(
        description="'spot' a reflection of the laser, 'glow' the laser itself, 'led' a lamp that stays on"
    )
    probability: Probability = Field(default=1.0, description="part of the samples that have it")
    flux_ratio: FluxRatio = Field(
        default_factory=_half, description="its electrons over the spot's, in the image where that is more"
    )
    diameter_m: Diameter = Field(default=DistributionTable(choice=(0.005,)), description="diameter of the disc")
    target: Targets = Field(default=None, description="boards; all but the sample's own where no place is given")
    azimuth_deg: Distribution | None = Field(
        default=None, description="of a horizontal ray from the world's z axis, from x towards y; instead of a board"
    )
    height_m: Distribution | None = Field(default=None, description="of the ray above the floor; with azimuth_deg")
    distance_m: Distance | None = Field(
        default=None, description="along the ray to a disc that hangs free; where the ray ends if not given"
    )

    @property
    def follows_laser(self) -> bool:
        """True if it goes out with the laser."""
        return self.kind != "led"


class Recipe(Table):
    """A whole recipe: `[[experiments]]` or `[random]` says what is seen."""

    later = ("film",)

    dataset: DatasetTable = Field(description="name and seed")
    rig: RigTable = Field(
        default_factory=RigTable, description="camera, mirror and stroke axis, as the estimator knows them"
    )
    misalignment: MisalignmentTable = Field(
        default_factory=MisalignmentTable, description="what the true rig deviates by"
    )
    room: RoomTable = Field(default_factory=RoomTable, description="the room")
    laser: LaserTable = Field(default_factory=LaserTable, description="the laser")
    ambient: AmbientTable = Field(default_factory=AmbientTable, description="quality of the ambient layer")
    rooms: RoomsTable | None = Field(default=None, description="rooms of several kinds, instead of the one of [room]")
    targets: Annotated[tuple[TargetTable, ...], Field(strict=False)] = Field(
        default=(), description="boards with a laser spot; the rooms of [rooms] have none"
    )
    experiments: Annotated[tuple[ExperimentTable, ...], Field(strict=False)] = Field(
        default=(), description="which targets with which strokes"
    )
    rigs: DrawnRigsTable | None = Field(default=None, description="drawn rigs, each of which sees all experiments")
    random: RandomTable | None = Field(default=None, description="samples that are drawn, instead of experiments")
    frames: FramesTable | None = Field(default=None, description="how frames of the samples are taken")
    film: FilmTable | None = Field(default=None, description="the pairs as films of their strokes")
    distractors: Annotated[tuple[DistractorTable, ...], Field(strict=False)] = Field(
        default=(), description="other lights that may be taken for the spot"
    )
