"""Options are parsed once, with the same words on the command line and in Python."""

import inspect
from dataclasses import dataclass
from typing import Annotated, get_args

import pytest
from click.testing import CliRunner

import omtwarp
from omtwarp import options
from omtwarp.cohort.run import run_cohort
from omtwarp.commands._cli import main
from omtwarp.commands._command import as_command
from omtwarp.commands._options import Only, Typed
from omtwarp.errors import OmtwarpError
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.write import write_mesh
from omtwarp.options import AreaMatch, Cost, MapOptions, Method, Refinement, Scheme, Stage, choose, parse_device


@pytest.mark.parametrize(
    ("option", "name", "value"),
    [
        ("--method", "method", "magic"),
        ("--until", "until", "noon"),
        ("--cost", "cost", "cubed"),
        ("--scheme", "scheme", "fancy"),
        ("--refine", "refine", "0"),
        ("--solver", "solver", "gauss"),
    ],
)
def test_python_and_the_command_line_refuse_with_the_same_words(capsys, option, name, value):
    with pytest.raises(OmtwarpError) as caught:
        map_to_sphere(object(), **{name: value})
    with pytest.raises(SystemExit) as ended:
        main(["map", "mesh.ply", "-o", "map.npz", option, value])
    assert ended.value.code == 2
    assert str(caught.value) in " ".join(capsys.readouterr().err.split())


def test_the_options_of_a_group_are_options_of_the_command():
    """A command takes a dataclass of options, whole or those that are named; defaults are those of the class."""

    @dataclass(frozen=True)
    class Size:
        width: Annotated[int, Typed(bounds=(1, None))] = 3
        height: Annotated[int, Typed(bounds=(1, None))] = 2

    seen = []

    def draw(*, size: Size, mapping: Annotated[MapOptions, Only(("refine", "exact"))], title: str = "none"):
        seen.append((size, mapping, title))

    app = as_command(draw)
    assert CliRunner().invoke(app, ["--width", "4", "--refine", "match:2.5", "--title", "a"]).exit_code == 0
    assert CliRunner().invoke(app, ["--exact"]).exit_code == 0
    assert seen == [(Size(4), MapOptions(refine=AreaMatch(2.5)), "a"), (Size(), MapOptions(exact=True), "none")]
    assert (
        CliRunner().invoke(app, ["--width", "0"]).exit_code
        == CliRunner().invoke(app, ["--until", "omt"]).exit_code
        == 2
    )
    assert isinstance(CliRunner().invoke(app, ["--exact", "--refine", "area"]).exception, OmtwarpError)


def test_a_value_left_out_is_not_offered():
    with pytest.raises(OmtwarpError, match=r"unknown scheme 'paper': use default, plain$"):
        choose(Scheme, "paper", without=(Scheme.PAPER,))


@pytest.mark.parametrize("name", ["auto", "cpu", "cuda", "cuda:3"])
def test_device_names(name):
    assert parse_device(name) == name
    assert parse_device(None) == "auto"


def test_stages_follow_from_the_options():
    every = tuple(Stage)
    assert MapOptions(refine=Refinement.AREA).stages == every
    assert MapOptions(refine=None).stages == every[:-1]
    assert MapOptions(until=Stage.MOSER).stages == every[:2]
    assert MapOptions(method=Method.HAKER).stages == every[:1]
    assert MapOptions(method=Method.MOSER, until=Stage.REFINE).stages == every[:2]
    assert MapOptions(method=Method.MOSER, until=Stage.CONFORMAL).stages == every[:1]


@pytest.mark.parametrize(
    ("given", "unused"),
    [
        *(({"method": method, "refine": 2.0}, "refine") for method in tuple(Method)[1:]),
        *(({"until": until, "refine": "area"}, "refine") for until in tuple(Stage)[:3]),
        *(({"method": method, "scheme": "paper"}, "scheme") for method in tuple(Method)[1:]),
        *(({"method": method, "cost": "geodesic"}, "cost") for method in ("haker", "tutte", "mean-value")),
        ({"until": "conformal", "cost": "geodesic"}, "cost"),
    ],
    ids=str,
)
def test_options_without_effect_are_refused(given, unused):
    with pytest.raises(OmtwarpError, match=f"^{unused} is of .*: leave it out$"):
        MapOptions.parse(**given)


@pytest.mark.parametrize(
    "given",
    [
        {"method": "moser", "cost": "geodesic"},  # in which the report tells the cost
        {"until": "conformal", "scheme": "paper"},  # which begins with another conformal map
        {"method": "tutte", "cost": "squared", "scheme": "default", "refine": "none"},  # as where they are left out
    ],
    ids=str,
)
def test_options_with_an_effect_are_taken(given):
    assert MapOptions.parse(**given).method == given.get("method", "omt")


def test_exact_areas_name_every_option_that_they_exclude():
    with pytest.raises(OmtwarpError, match="leave method, until, scheme and refine as they are"):
        MapOptions(exact=True, until=Stage.MOSER)


def test_what_a_report_says():
    options = MapOptions(cost=Cost.GEODESIC, refine=Refinement.ANGLE)
    assert options.to_dict() == {"method": "omt", "cost": "geodesic", "scheme": "default", "refine": "angle"}
    assert all(type(value) is str for value in options.to_dict().values())
    assert MapOptions(method=Method.TUTTE).to_dict() == {"method": "tutte", "cost": "", "scheme": "", "refine": None}


@pytest.mark.parametrize("function", [omtwarp.map_to_sphere, omtwarp.map_surface, run_cohort])
def test_functions_show_the_declared_options(function):
    """Their signatures have the declared defaults, and their docstrings what the command line says."""
    shown = inspect.signature(function).parameters
    assert {name: shown[name].default for name in vars(MapOptions())} == vars(MapOptions())
    for name, (_, option) in options.options_of(MapOptions).items():
        assert f"    {name}: {option.help.removesuffix('.')}" in function.__doc__
    assert "options" not in shown


def test_editors_offer_every_value_of_an_option():
    """What functions take for an option names its members' texts."""
    names = [name for name in vars(options) if name.endswith("Like")]
    assert len(names) > 10
    for name in names:
        kind, texts = get_args(getattr(options, name))
        assert get_args(texts) == tuple(kind), name


@pytest.mark.parametrize(
    ("function", "option", "name"),
    [
        (omtwarp.texture, "atlas", "AtlasLike"),
        (omtwarp.paint, "uv", "CoordinatesLike"),
        (omtwarp.align, "by", "AlignByLike"),
        (omtwarp.resample, "method", "InterpolationLike"),
        (omtwarp.preview, "backend", "BackendLike"),
        (omtwarp.film, "pattern", "PatternLike"),
        (omtwarp.write_report, "pattern", "PatternLike"),
    ],
)
def test_functions_offer_the_values_of_their_options(function, option, name):
    assert name in str(inspect.signature(function).parameters[option].annotation)


def test_messages_name_arguments_in_python_and_options_on_the_command_line(capsys, tmp_path):
    ball = omtwarp.shapes.icosphere(2)
    with pytest.raises(OmtwarpError, match=r"add bake=\['normal'\]"):
        omtwarp.paint(
            (ball.vertices, ball.faces, ball.vertices), uv="atlas", bake=["ao"], detail=(ball.vertices, ball.faces)
        )
    write_mesh(tmp_path / "ball.obj", ball.vertices, ball.faces)
    mesh, output = str(tmp_path / "ball.obj"), str(tmp_path / "ball.glb")
    with pytest.raises(SystemExit):
        main(["texture", mesh, "-o", output, "--uv", "own", "--device", "cpu", "--size", "64"])
    assert "leave out --uv own" in capsys.readouterr().err
