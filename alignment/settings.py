"""Settings of the align stage, with the `[[ruler]]` and `[[control]]` tables of a scene's file."""

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import BeforeValidator, Field, model_validator

from groundwalk.store import Settings, UserError
from groundwalk.store.settings import validated

if TYPE_CHECKING:
    import cv2

S = TypeVar("S", bound=Settings)
APRILTAG = "DICT_APRILTAG_36H11"


@cache
def dictionaries() -> tuple[str, ...]:
    """The names of OpenCV's predefined dictionaries, which is loaded for a scene with rulers alone."""
    import cv2

    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))


def _dictionary(name: Any) -> Any:
    if not isinstance(name, str) or name.upper() not in map(str.upper, dictionaries()):
        raise ValueError(f"not a dictionary that OpenCV knows; one of {', '.join(dictionaries())}")
    return next(candidate for candidate in dictionaries() if candidate.upper() == name.upper())


Dictionary = Annotated[str, BeforeValidator(_dictionary)]


class RulerSettings(Settings):
    """What all kinds of rulers have in common."""

    name: str = Field("", description="name of the ruler in tables and messages; by default its kind")
    use_for_scale: bool = Field(
        False, description="set the map's scale by this ruler; every second corner is held out and checks it"
    )
    length_sd_percent: float = Field(
        0.2, gt=0, le=10, description="standard error of the stated size, percent, as printed and measured"
    )
    size_name: ClassVar[str]

    @property
    def size_mm(self) -> float:
        """The stated size that messages compare, millimetres."""
        raise NotImplementedError


class CharucoRuler(RulerSettings):
    """A ChArUco board: a chessboard with ArUco markers in its white squares."""

    kind: Literal["charuco"]
    squares_x: int = Field(ge=3, le=100, description="squares along the board's rows")
    squares_y: int = Field(ge=3, le=100, description="squares along the board's columns")
    square_mm: float = Field(gt=0, description="side of a square, millimetres")
    marker_mm: float = Field(gt=0, description="side of a marker, millimetres; less than square_mm")
    dictionary: Dictionary = Field(description="OpenCV's name of the markers' dictionary, such as DICT_6X6_250")
    legacy: bool = Field(
        False, description="pattern of OpenCV before 4.6: boards with an even number of rows begin with a white square"
    )
    size_name: ClassVar[str] = "squares"

    @property
    def size_mm(self) -> float:
        return self.square_mm

    @model_validator(mode="after")
    def _consistent(self) -> "CharucoRuler":
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm {self.marker_mm:g} must be less than square_mm {self.square_mm:g}")
        needed = self.squares_x * self.squares_y // 2
        available = len(dictionary(self.dictionary).bytesList)
        if needed > available:
            raise ValueError(
                f"{self.squares_x} x {self.squares_y} squares need {needed} markers, {self.dictionary} has {available}"
            )
        return self


class AprilTagRuler(RulerSettings):
    """AprilTags of one size, anywhere in the scene, each id once."""

    kind: Literal["apriltag"]
    tag_mm: float = Field(gt=0, description="side of a tag's black square, millimetres")
    dictionary: Dictionary = Field(APRILTAG, description="OpenCV's name of the tags' dictionary")
    ids: list[int] = Field(default_factory=list, description="ids of the tags; empty: all that are detected")
    size_name: ClassVar[str] = "tags"

    @property
    def size_mm(self) -> float:
        return self.tag_mm

    @model_validator(mode="after")
    def _consistent(self) -> "AprilTagRuler":
        count = len(dictionary(self.dictionary).bytesList)
        unknown = [tag for tag in self.ids if not 0 <= tag < count]
        if unknown:
            raise ValueError(f"id {unknown[0]}: {self.dictionary} has ids 0 to {count - 1}")
        return self


class PointObservation(Settings):
    """Where a frame sees a point."""

    frame: str = Field(description="frame_id of import.frames, <session>/<six digits>, or its image's file name")
    xy: tuple[float, float] = Field(description="pixels; the centre of the top-left pixel is (0.5, 0.5)")


class NamedPoint(Settings):
    """An end of a known distance."""

    name: str = Field(min_length=1, description="what the point is, such as 'left edge of the door'")
    observations: list[PointObservation] = Field(min_length=2, description="pixels in two or more frames")

    @model_validator(mode="after")
    def _consistent(self) -> "NamedPoint":
        frames = [observation.frame for observation in self.observations]
        repeated = [frame for frame in frames if frames.count(frame) > 1]
        if repeated:
            raise ValueError(f"point {self.name!r} has two observations in frame {repeated[0]}")
        return self


class DistanceRuler(RulerSettings):
    """Two points a known distance apart."""

    kind: Literal["distance"]
    length_m: float = Field(gt=0, description="distance between the two points, metres")
    points: list[NamedPoint] = Field(min_length=2, max_length=2, description="the two points")
    size_name: ClassVar[str] = "distance"

    @property
    def size_mm(self) -> float:
        return 1000 * self.length_m


Ruler = CharucoRuler | AprilTagRuler | DistanceRuler
_KINDS: dict[str, type[Ruler]] = {"charuco": CharucoRuler, "apriltag": AprilTagRuler, "distance": DistanceRuler}


def dictionary(name: str) -> "cv2.aruco.Dictionary":
    """OpenCV's predefined dictionary of that name."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def named(tables: Any, what: str, key: str, make: Callable[[dict[str, Any], str], S]) -> list[S]:
    """The `[[key]]` tables of a scene's file as settings, which have a `name` each, all different: `make` is given a
    table and where it is. UserError says which one is wrong and how; `what` they are called."""
    if not isinstance(tables, list) or not all(isinstance(table, dict | Settings) for table in tables):
        raise UserError(f"{key}s are a list of tables", found=tables, expected=f"[[{key}]] ...")
    made: list[Any] = []
    for number, table in enumerate(tables, start=1):
        where = f"[[{key}]] number {number}"
        one: Any = table if isinstance(table, Settings) else make(table, where)
        if one.name in (other.name for other in made):
            raise UserError(f"two {what} are named {one.name!r}", where=where, do="give each another name")
        made.append(one)
    return made


def rulers_of(tables: Any) -> list[Ruler]:
    """The `[[ruler]]` tables as settings, each with a name."""
    rulers = named(tables, "rulers", "ruler", _ruler)
    seen: dict[str, str] = {}
    for number, ruler in enumerate(rulers, start=1):
        if isinstance(ruler, DistanceRuler):
            continue
        # DICT_6X6_50 is the beginning of DICT_6X6_250.
        family = ruler.dictionary.rsplit("_", 1)[0] if ruler.dictionary[5].isdigit() else ruler.dictionary
        if family in seen:
            raise UserError(
                f"rulers {seen[family]!r} and {ruler.name!r} have markers of the same dictionary",
                where=f"[[ruler]] number {number}",
                found=ruler.dictionary,
                do="print one of them with another dictionary",
            )
        seen[family] = ruler.name
    return rulers


def _ruler(table: dict[str, Any], where: str) -> Ruler:
    kind = table.get("kind")
    if kind not in _KINDS:
        what = "a ruler needs a kind" if kind is None else f"unknown kind of ruler {kind!r}"
        raise UserError(what, where=where, expected=f"kind = one of {', '.join(_KINDS)}")
    return validated(_KINDS[kind], {**table, "name": table.get("name") or kind}, where)


class ControlSettings(Settings):
    """Surveyed points, and where images show them: pixels in a file, tags that are detected, or both."""

    name: str = Field("control", description="name of the survey in tables and messages")
    points: str = Field(
        min_length=1,
        description="CSV file with columns point, x_m, y_m, z_m and, where they differ, sd_m; or, without `images` and "
        "`dictionary`, a GCP list (.txt) as OpenDroneMap reads it; relative to the data folder",
    )
    images: str = Field(
        "", description="CSV file with columns frame, point, x_px, y_px; relative to the data folder; empty: none"
    )
    dictionary: Dictionary | None = Field(
        None,
        description="OpenCV's name of a dictionary of tags: a point named 17 is the middle of tag 17, 17.0 to 17.3 are "
        "its corners, clockwise from its top left",
    )
    sd_m: float = Field(0.005, gt=0, description="standard error of a surveyed coordinate, metres")
    pixel_sd: float = Field(1.0, gt=0, description="standard error of a pixel coordinate of `images`, at least")
    up: Literal["z", "y", "unknown"] = Field(
        "z", description="the survey's axis that points up: z of east, north, up; unknown: of no use for the tilt"
    )
    origin: tuple[float, float, float] | None = Field(
        None,
        description="latitude, longitude (degrees) and altitude (metres) in WGS84 of (0, 0, 0), where the survey's "
        "axes are true east, north, up: places the map on earth; points in latitude_deg, longitude_deg and altitude_m "
        "need none",
    )
    max_error_m: float = Field(
        0.05, gt=0, description="the check fails where held-out points are further off, RMS, or one of them is, metres"
    )

    @property
    def in_one_file(self) -> bool:
        """Whether `points` is a GCP list, which has points and pixels."""
        return not self.images and self.dictionary is None

    @model_validator(mode="after")
    def _consistent(self) -> "ControlSettings":
        if self.in_one_file and not self.points.lower().endswith(".txt"):
            raise ValueError(
                "nothing says where images show the points: name `images`, `dictionary` or both, or as `points` a GCP "
                "list (.txt)"
            )
        if self.origin is not None and (abs(self.origin[0]) > 90 or abs(self.origin[1]) > 180 or self.up != "z"):
            raise ValueError('an origin is latitude, longitude and altitude of axes east, north, up (up = "z")')
        return self


def controls_of(tables: Any) -> list[ControlSettings]:
    """The `[[control]]` tables as settings; UserError says which one is wrong and how."""
    return named(tables, "surveys", "control", lambda table, where: validated(ControlSettings, table, where))


class AlignSettings(Settings):
    """What ground truth may rest on; docs/explanation/ground-truth.md says what isn't a setting, and why."""

    rulers: Annotated[list[Ruler], BeforeValidator(rulers_of)] = Field(
        default_factory=list, description="boards and known distances in the images; [[ruler]] in the scene's file"
    )
    controls: Annotated[list[ControlSettings], BeforeValidator(controls_of)] = Field(
        default_factory=list, description="surveyed points in the images; [[control]] in the scene's file"
    )
    max_ruler_size_error: float = Field(
        0.03,
        gt=0,
        description="a ruler fails if its size differs by more from that in the map, as a fraction: a print of another "
        "size; it may set the scale within this, or within the 95 % bounds of its difference from VIO's scale",
    )
    vio_link_m: float = Field(
        10.0, ge=0, description="longest VIO path by which SfM models without a common view are linked, metres"
    )
    max_focal_error: float = Field(
        0.03,
        gt=0,
        description="a session fails if its focal length by the images differs from the captured one by more, as a "
        "fraction",
    )
    max_session_scale_error: float = Field(
        0.03, gt=0, description="a session whose scale differs from the others' by more, as a fraction, fails"
    )
    max_session_tilt_deg: float = Field(
        2.0, gt=0, description="a session whose vertical differs from the others' by more, degrees, fails"
    )
    max_reference_error_m: float = Field(
        0.1,
        ge=0,
        description="largest distance between a frame and its reference pose, metres (where that is metric); 1 % of "
        "the reference's extent is added",
    )
    max_reference_error_deg: float = Field(
        3.0, gt=0, description="largest angle between a frame and its reference pose, degrees"
    )
    min_registered_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if SfM registered a smaller fraction of its frames, or a session's"
    )
    min_consistent_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if a smaller fraction of the registered frames passes the checks"
    )
