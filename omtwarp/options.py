"""Every option of a map: its name, values and default, and the message for an unknown value.

The command line and Python take their options from here. Nothing heavy is imported, so that ``omtwarp --help`` is fast.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import EnumType, StrEnum
from functools import partial
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypedDict, TypeVar, Unpack, cast, get_args, get_type_hints

from omtwarp.device import Solver, parse_device
from omtwarp.errors import OmtwarpError, choose, shown, truth

Record: TypeAlias = dict[str, float]
"""Numbers of one step of a stage by their names, ready for JSON; counts are int and yes or no is bool."""


def continued(history: list[Record], records: Sequence[Record]) -> list[Record]:
    """Append the records of further steps to a history; their iterations are numbered on from its length."""
    return history + [record | {"iteration": len(history) + k} for k, record in enumerate(records)]


Progress: TypeAlias = Callable[[str, int, int, Record], None]
"""How long work reports on itself: ``progress(stage, done, total, details)``."""


def tell(progress: Progress | None, stage: str, done: int, total: int, details: Record) -> None:
    """Report on work to whoever asked for it.

    Raises:
        OmtwarpError: that is no function.
    """
    if progress is not None and not callable(progress):
        raise OmtwarpError(f"progress {shown(progress)}: must be a function of a stage, done, total and details")
    if progress is not None:
        progress(stage, done, total, details)


class Method(StrEnum):
    """How a surface is mapped: the whole pipeline, or a system that the paper compares with."""

    OMT, HAKER, MOSER, TUTTE, MEAN_VALUE = "omt", "haker", "moser", "tutte", "mean-value"


class Stage(StrEnum):
    """Stages of the pipeline, in their order."""

    CONFORMAL, MOSER, OMT, REFINE = "conformal", "moser", "omt", "refine"


class Cost(StrEnum):
    """The cost that transport minimises: squared geodesic distance, or the paper's geodesic distance."""

    SQUARED, GEODESIC = "squared", "geodesic"


class Scheme(StrEnum):
    """How transport is optimised; ``paper`` is Algorithms 1 and 2 as written."""

    DEFAULT, PLAIN, PAPER = "default", "plain", "paper"


class Refinement(StrEnum):
    """Named weights of area against angle in the last stage."""

    NONE, AREA, BALANCED, ANGLE = "none", "area", "balanced", "angle"


class WeightsAt(StrEnum):
    """What weights belong to; ``auto`` goes by their number, which decides unless it is that of both."""

    AUTO, VERTICES, TRIANGLES = "auto", "vertices", "triangles"


class Interpolation(StrEnum):
    """How data are carried from one sphere to another."""

    BARYCENTRIC, NEAREST, ADAPTIVE, CONSERVATIVE = "barycentric", "nearest", "adaptive", "conservative"


class Side(StrEnum):
    """A hemisphere of the brain."""

    LEFT, RIGHT = "left", "right"


class TextureFormat(StrEnum):
    """How the pictures of a glTF file are encoded; both keep every texel."""

    PNG, WEBP = "png", "webp"


class Domain(StrEnum):
    """The domain of a map; ``auto`` is the sphere for closed surfaces and the hemisphere for those with one hole."""

    AUTO, SPHERE, HEMISPHERE, DISK, CAP, TORUS = "auto", "sphere", "hemisphere", "disk", "cap", "torus"


class FillArea(StrEnum):
    """How much of the sphere filled holes take."""

    NATURAL, SMALL = "natural", "small"


class CutAlong(StrEnum):
    """The loops that handles are cut along; ``auto`` takes the shortest unless they leave thin limbs."""

    AUTO, HANDLES, HOLES = "auto", "handles", "holes"


class Backend(StrEnum):
    """Programs that draw pictures: OpenGL through pyrender, the built-in ray caster, or whichever works."""

    AUTO, PYRENDER, WARP = "auto", "pyrender", "warp"


class PatternName(StrEnum):
    """The built-in patterns, each a file of :mod:`omtwarp.texturing.patterns`."""

    CIRCLES, PUZZLE, GLOBE, CHECKER = "circles", "puzzle", "globe", "checker"


class AtlasName(StrEnum):
    """Layouts of a texture of the sphere."""

    EQUIRECTANGULAR, CUBE, OCTAHEDRAL = "equirectangular", "cube", "octahedral"


class ProjectionName(StrEnum):
    """Projections of pictures of the sphere."""

    EQUIRECTANGULAR, SINUSOIDAL = "equirectangular", "sinusoidal"


class Coordinates(StrEnum):
    """Whose texture coordinates a mesh gets: those of an atlas, or its own."""

    ATLAS, OWN = "atlas", "own"


class Keep(StrEnum):
    """Where a picture goes among a mesh's own materials."""

    OVER, UNDER = "over", "under"


class AlignBy(StrEnum):
    """What two maps are aligned by."""

    AUTO, FEATURES, VERTICES = "auto", "features", "vertices"


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
# Of registration: weight of distortion against features; bound of log2 of ratios of areas, and of stretches
STIFFNESS, MAX_STRAIN = 0.59, 1.12
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


class ChosenOptions(TypedDict, total=False):
    """The options that shape a map, as a report has them; ``exact`` where it was asked for."""

    method: str
    cost: str
    scheme: str
    refine: str | float | None
    exact: bool


class MapKeywords(TypedDict, total=False):
    """What :class:`MapOptions` takes for each option, for editors and type checkers."""

    method: MethodLike
    until: StageLike
    cost: CostLike
    scheme: SchemeLike
    refine: str | float | AreaMatch | None
    exact: bool
    optimality: bool
    device: str | None
    solver: SolverLike
    strict: bool


class Option(NamedTuple):
    """What is said about an option, on the command line and in lists of options, and how its value is read.

    Attributes:
        help: a sentence.
        metavar: the form of a value; that of a choice is its names.
        parse: reads a value as users write it; a choice is read by its names, and other values are what they are.
    """

    help: str
    metavar: str = ""
    parse: Callable[[object], object] | None = None

    def reader(self, kind: object) -> Callable[[object], object] | None:
        """Return what reads a value of a type, None where there is nothing to read."""
        choice = isinstance(kind, type) and issubclass(kind, StrEnum)
        return partial(choose, cast(type[StrEnum], kind)) if choice and self.parse is None else self.parse

    def sentence(self, kind: object) -> str:
        """Return what a docstring says of the option, with the forms of a value of a type."""
        words = list(map(str, kind)) if isinstance(kind, EnumType) else self.metavar.split("|")
        forms = ", ".join(f"``{word}``" for word in words if word)
        return f"{self.help.removesuffix('.')} ({forms})." if forms else self.help


Device: TypeAlias = Annotated[str, Option("Device to compute on.", "auto|cpu|cuda:N", parse_device)]


@dataclass(frozen=True)
class MapOptions:
    """The options of :func:`omtwarp.map_to_sphere`, parsed; types, defaults, help and reading are declared here.

    The command line and the functions that take these options have their documentation from here (:func:`takes`).

    Raises:
        OmtwarpError: options exclude each other, or one has no effect on such a map.
    """

    method: Annotated[Method, Option("How to map; all but omt are there for comparison.")] = Method.OMT
    until: Annotated[Stage, Option("Stop after this stage.")] = Stage.REFINE
    cost: Annotated[Cost, Option("What transport minimises: squared geodesic distance, or distance.")] = Cost.SQUARED
    scheme: Annotated[Scheme, Option("How the transport descends; paper is the published one.")] = Scheme.DEFAULT
    refine: Annotated[
        Refinement | AreaMatch | float | None,
        Option(
            "Refine the optimal map towards less distortion: a weight of area against angle; none by default.",
            "none|area|balanced|angle|NUMBER|match:AREA",
            parse_refinement,
        ),
    ] = None
    exact: Annotated[
        bool, Option("Cut every triangle into four and keep the area of each to 1e-6; the map is that of the parts.")
    ] = False
    optimality: Annotated[bool, Option("Also bound the cost of every map from below (column gap).")] = True
    device: Device = "auto"
    solver: Annotated[
        Solver, Option("How sparse systems are solved; scipy is the plain way, cudss needs a GPU; maps agree to 1e-7.")
    ] = Solver.AUTO
    strict: Annotated[bool, Option("Refuse a map that would come with a warning: an error, no output.")] = False

    def __post_init__(self) -> None:
        if self.exact and not (Stage.OMT in self.stages and self.refine is None and self.scheme is Scheme.DEFAULT):
            raise OmtwarpError(
                "exact areas are those of the optimal map: leave method, until, scheme and refine as they are"
            )
        uses = {
            "scheme": (self.method is Method.OMT, "the method omt"),  # whose start depends on it too
            "cost": (Stage.MOSER in self.stages, "the stages moser and omt"),  # reports tell of both
            "refine": (Stage.REFINE in self.stages, "the stage refine of the method omt"),
        }
        for name, (used, of) in uses.items():
            if not used and getattr(self, name) != getattr(MapOptions, name):
                raise OmtwarpError(f"{name} is of {of}: leave it out")

    @classmethod
    def parse(cls, **given: Unpack[MapKeywords]) -> "MapOptions":
        """Read options as users write them; those that are left out have their defaults.

        Raises:
            OmtwarpError: an option is unknown, has no such value, or excludes another.
        """
        declared, values = options_of(cls), vars(cls()).copy()
        for name, value in given.items():
            if name not in declared:
                raise OmtwarpError(f"unknown option '{name}': use {', '.join(declared)}")
            kind, option = declared[name]
            read = option.reader(kind)
            values[name] = truth(value, name) if kind is bool else value if read is None else read(value)
        return cls(**values)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages that these options ask for, in their order."""
        of_method = {Method.OMT: self.until, Method.MOSER: Stage.MOSER, Method.HAKER: Stage.CONFORMAL}
        last = of_method.get(self.method, Stage.CONFORMAL)  # whose place barycentric maps take
        every = tuple(Stage)
        wanted = every[: min(every.index(last), every.index(self.until)) + 1]
        return tuple(stage for stage in wanted if stage is not Stage.REFINE or self.refine is not None)

    def to_dict(self) -> ChosenOptions:
        """Return the options that shape a map, for a report; without those that the method does not use."""
        chosen: ChosenOptions = {"method": str(self.method), "cost": "", "scheme": "", "refine": None}
        if self.method not in (Method.TUTTE, Method.MEAN_VALUE):
            weight = str(self.refine) if isinstance(self.refine, Refinement | AreaMatch) else self.refine
            chosen |= {"cost": str(self.cost), "scheme": str(self.scheme), "refine": weight}
        if self.exact:
            chosen["exact"] = True
        return chosen


def options_of(declaration: type) -> dict[str, tuple[object, Option]]:
    """Return the type of every option that a class declares, and what is said about it."""
    hints = get_type_hints(declaration, include_extras=True)
    return {name: cast(tuple[object, Option], get_args(hint)) for name, hint in hints.items()}


Function = TypeVar("Function", bound=Callable[..., object])


def takes(kind: type, defaults: Mapping[str, object], said: str = "") -> Callable[[Function], Function]:
    """Give a function that ends in ``**options`` the signature and the documentation of every option, for ``help``.

    Args:
        kind: the TypedDict of the options.
        defaults: a value for each of them.
        said: entries of a docstring's ``Args:`` in place of that of ``options``; none to leave the docstring.
    """
    types = {name: getattr(given, "__forward_arg__", given) for name, given in inspect.get_annotations(kind).items()}

    def signed(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [given for given in signature.parameters.values() if given.kind is not inspect.Parameter.VAR_KEYWORD]
        known = {given.name for given in own}
        options = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=types[name])
            for name, value in defaults.items()
            if name not in known
        ]
        function.__signature__ = signature.replace(parameters=[*own, *options])  # type: ignore[attr-defined]
        if said and function.__doc__:
            words = inspect.cleandoc(function.__doc__)
            function.__doc__ = re.sub("^    options: .*\n", said, words, flags=re.MULTILINE)
        return function

    return signed


takes_map_options = takes(
    MapKeywords,
    vars(MapOptions()),
    "".join(f"    {name}: {option.sentence(kind)}\n" for name, (kind, option) in options_of(MapOptions).items()),
)
"""Decorates functions that pass options of a map on."""
