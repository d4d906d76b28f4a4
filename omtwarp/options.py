"""Every option of a map: its name, values and default, and the message for an unknown value.

The command line and Python take their options from here. Nothing heavy is imported, so that ``omtwarp --help`` is fast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NotRequired, TypeAlias, TypedDict, Unpack

from omtwarp.device.names import Solver, parse_device
from omtwarp.errors import OmtwarpError, choose, shown

Record: TypeAlias = dict[str, float]
"""Numbers of one step of a stage by their names, ready for JSON; counts are int and yes or no is bool."""


def continued(history: list[Record], records: Sequence[Record]) -> list[Record]:
    """Append the records of further steps to a history; their iterations are numbered on from its length."""
    return history + [record | {"iteration": len(history) + k} for k, record in enumerate(records)]


Progress: TypeAlias = Callable[[str, int, int, Record], None]
"""How long work reports on itself: ``progress(stage, done, total, details)``."""


class Method(StrEnum):
    """How a surface is mapped: the whole pipeline, or a system that the paper compares with."""

    OMT = "omt"
    HAKER = "haker"
    MOSER = "moser"
    TUTTE = "tutte"
    MEAN_VALUE = "mean-value"


class Stage(StrEnum):
    """Stages of the pipeline, in their order."""

    CONFORMAL = "conformal"
    MOSER = "moser"
    OMT = "omt"
    REFINE = "refine"


class Cost(StrEnum):
    """The cost that transport minimises: squared geodesic distance, or the paper's geodesic distance."""

    SQUARED = "squared"
    GEODESIC = "geodesic"


class Scheme(StrEnum):
    """How transport is optimised; ``paper`` is Algorithms 1 and 2 as written."""

    DEFAULT = "default"
    PLAIN = "plain"
    PAPER = "paper"


class Refinement(StrEnum):
    """Named weights of area against angle in the last stage."""

    NONE = "none"
    AREA = "area"
    BALANCED = "balanced"
    ANGLE = "angle"


class WeightsAt(StrEnum):
    """What weights belong to; ``auto`` goes by their number, which decides unless it is that of both."""

    AUTO = "auto"
    VERTICES = "vertices"
    TRIANGLES = "triangles"


class Interpolation(StrEnum):
    """How data are carried from one sphere to another."""

    BARYCENTRIC = "barycentric"
    NEAREST = "nearest"
    ADAPTIVE = "adaptive"
    CONSERVATIVE = "conservative"


class TextureFormat(StrEnum):
    """How the pictures of a glTF file are encoded; both keep every texel."""

    PNG = "png"
    WEBP = "webp"


class Domain(StrEnum):
    """The domain of a map; ``auto`` is the sphere for closed surfaces and the hemisphere for those with one hole."""

    AUTO = "auto"
    SPHERE = "sphere"
    HEMISPHERE = "hemisphere"
    DISK = "disk"
    CAP = "cap"
    TORUS = "torus"


class FillArea(StrEnum):
    """How much of the sphere filled holes take."""

    NATURAL = "natural"
    SMALL = "small"


class CutAlong(StrEnum):
    """The loops that handles are cut along; ``auto`` takes the shortest unless they leave thin limbs."""

    AUTO = "auto"
    HANDLES = "handles"
    HOLES = "holes"


class Backend(StrEnum):
    """Programs that draw pictures: OpenGL through pyrender, the built-in ray caster, or whichever works."""

    AUTO = "auto"
    PYRENDER = "pyrender"
    WARP = "warp"


class PatternName(StrEnum):
    """The built-in patterns, each a file of :mod:`omtwarp.texturing.patterns`."""

    CIRCLES = "circles"
    PUZZLE = "puzzle"
    GLOBE = "globe"
    CHECKER = "checker"


class AtlasName(StrEnum):
    """Layouts of a texture of the sphere."""

    EQUIRECTANGULAR = "equirectangular"
    CUBE = "cube"
    OCTAHEDRAL = "octahedral"


class ProjectionName(StrEnum):
    """Projections of pictures of the sphere."""

    EQUIRECTANGULAR = "equirectangular"
    SINUSOIDAL = "sinusoidal"


class Coordinates(StrEnum):
    """Whose texture coordinates a mesh gets: those of an atlas, or its own."""

    ATLAS = "atlas"
    OWN = "own"


class Keep(StrEnum):
    """Where a picture goes among a mesh's own materials."""

    OVER = "over"
    UNDER = "under"


class AlignBy(StrEnum):
    """What two maps are aligned by."""

    AUTO = "auto"
    FEATURES = "features"
    VERTICES = "vertices"


# What functions take for an option: a member, or its text, which editors offer.
MethodLike: TypeAlias = Method | Literal["omt", "haker", "moser", "tutte", "mean-value"]
StageLike: TypeAlias = Stage | Literal["conformal", "moser", "omt", "refine"]
CostLike: TypeAlias = Cost | Literal["squared", "geodesic"]
SchemeLike: TypeAlias = Scheme | Literal["default", "plain", "paper"]
SolverLike: TypeAlias = Solver | Literal["auto", "scipy", "cholesky", "cudss"]
BackendLike: TypeAlias = Backend | Literal["auto", "pyrender", "warp"]
InterpolationLike: TypeAlias = Interpolation | Literal["barycentric", "nearest", "adaptive", "conservative"]
DomainLike: TypeAlias = Domain | Literal["auto", "sphere", "hemisphere", "disk", "cap", "torus"]
WeightsAtLike: TypeAlias = WeightsAt | Literal["auto", "vertices", "triangles"]
FillAreaLike: TypeAlias = FillArea | Literal["natural", "small"]
CutAlongLike: TypeAlias = CutAlong | Literal["auto", "handles", "holes"]
PatternLike: TypeAlias = PatternName | Literal["circles", "puzzle", "globe", "checker"]
AtlasLike: TypeAlias = AtlasName | Literal["equirectangular", "cube", "octahedral"]
CoordinatesLike: TypeAlias = Coordinates | Literal["atlas", "own"]
KeepLike: TypeAlias = Keep | Literal["over", "under"]
AlignByLike: TypeAlias = AlignBy | Literal["auto", "features", "vertices"]
ProjectionLike: TypeAlias = ProjectionName | Literal["equirectangular", "sinusoidal"]

PICTURE_SIZE = (1024, 1024)  # pixels of a view where no size is given
BACKGROUND = "white"
FILM_RATE = 20.0  # frames per second; a .gif counts in hundredths of a second, of which this is a whole number


@dataclass(frozen=True)
class AreaMatch:
    """A refinement to a given mean area distortion, at least 2, by the weight that leads to it."""

    area: float

    def __str__(self) -> str:
        return f"match:{self.area!r}".removesuffix(".0")  # every digit: the text is read again by other processes


def parse_refinement(value: object) -> Refinement | AreaMatch | float | None:
    """Return a named refinement, an area distortion to match or a positive weight; None for ``none`` and for None.

    Raises:
        OmtwarpError: the value is no name, number or area of a refinement.
    """
    if isinstance(value, AreaMatch):
        return value
    if value is None or (isinstance(value, str) and value == Refinement.NONE.value):
        return None
    if isinstance(value, str) and value in tuple(Refinement):
        return Refinement(value)
    text = value if isinstance(value, str) else ""
    matched = text.startswith("match:")
    try:
        number = -1.0 if isinstance(value, bool) else float(text.removeprefix("match:") if text else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = -1.0
    if matched and 2.0 < number < float("inf"):
        return AreaMatch(number)
    if matched or not 0.0 < number < float("inf"):
        names = ", ".join(Refinement)
        raise OmtwarpError(
            f"unknown refinement {shown(value)}: use {names}, a positive number, or match:AREA, AREA above 2"
        )
    return number


class ChosenOptions(TypedDict):
    """The options that shape a map, as a report has them; ``exact`` where it was asked for."""

    method: str
    cost: str
    scheme: str
    refine: str | float | None
    exact: NotRequired[bool]


class MapChoices(TypedDict, total=False):
    """The options of :func:`omtwarp.map_to_sphere` by name, for functions that pass them on, without the device."""

    method: MethodLike
    until: StageLike
    cost: CostLike
    scheme: SchemeLike
    refine: str | float | AreaMatch | None
    exact: bool
    optimality: bool
    solver: SolverLike
    strict: bool


class MapKeywords(MapChoices, total=False):
    """The options of :func:`omtwarp.map_to_sphere` by name, for functions that pass them on."""

    device: str | None


class SurfaceKeywords(TypedDict, total=False):
    """The options of :func:`omtwarp.map_surface` in addition to those of a map to the sphere."""

    domain: DomainLike
    fill_area: FillAreaLike
    components: bool
    together: bool
    cut: bool
    cut_along: CutAlongLike


@dataclass(frozen=True)
class MapOptions:
    """The options of :func:`omtwarp.map_to_sphere`, parsed; this class defines the defaults.

    Attributes:
        method: the pipeline, or a system that it is compared with.
        until: the last stage that is run.
        cost: what transport minimises.
        scheme: how it does.
        refine: a named refinement, the weight of area against angle, an area distortion to match, or None to leave
            refinement out.
        exact: whether the triangles are quartered, and each keeps its area, the sum of its parts, to 1e-6.
        optimality: whether the map's distance from the optimum is bounded too.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.
        solver: how sparse systems are solved.
        strict: whether warnings about a map are errors.
    """

    method: Method = Method.OMT
    until: Stage = Stage.REFINE
    cost: Cost = Cost.SQUARED
    scheme: Scheme = Scheme.DEFAULT
    refine: Refinement | AreaMatch | float | None = None
    exact: bool = False
    optimality: bool = True
    device: str = "auto"
    solver: Solver = Solver.AUTO
    strict: bool = False

    @classmethod
    def parse(cls, **given: Unpack[MapKeywords]) -> MapOptions:
        """Read options as users write them; those that are left out have their defaults.

        Raises:
            OmtwarpError: an option has no such value.
        """
        options = cls(
            method=choose(Method, given.get("method", cls.method)),
            until=choose(Stage, given.get("until", cls.until)),
            cost=choose(Cost, given.get("cost", cls.cost)),
            scheme=choose(Scheme, given.get("scheme", cls.scheme)),
            refine=parse_refinement(given.get("refine", cls.refine)),
            exact=bool(given.get("exact", cls.exact)),
            optimality=bool(given.get("optimality", cls.optimality)),
            device=parse_device(given.get("device", cls.device)),
            solver=choose(Solver, given.get("solver", cls.solver)),
            strict=bool(given.get("strict", cls.strict)),
        )
        optimal = options.method is Method.OMT and Stage.OMT in options.stages and options.refine is None
        if options.exact and not (optimal and options.scheme is Scheme.DEFAULT):
            raise OmtwarpError("exact areas are those of the optimal map: leave method, scheme and refine as they are")
        return options

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages that these options ask for, in their order."""
        last = {Method.HAKER: Stage.CONFORMAL, Method.MOSER: Stage.MOSER}.get(self.method, self.until)
        every = tuple(Stage)
        wanted = every[: every.index(last) + 1]
        return tuple(stage for stage in wanted if stage is not Stage.REFINE or self.refine is not None)

    def to_dict(self) -> ChosenOptions:
        """Return the options that shape a map, for a report; without those that the method does not use."""
        if self.method in (Method.TUTTE, Method.MEAN_VALUE):
            return {"method": str(self.method), "cost": "", "scheme": "", "refine": None}
        weight = str(self.refine) if isinstance(self.refine, Refinement | AreaMatch) else self.refine
        chosen: ChosenOptions = {
            "method": str(self.method),
            "cost": str(self.cost),
            "scheme": str(self.scheme),
            "refine": weight,
        }
        if self.exact:
            chosen["exact"] = True
        return chosen
