"""The command line: streams, JSON, several inputs, help, completion."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import shlex
import subprocess
import sys

import click
import numpy as np
import pytest
import trimesh

from omtwarp.commands import function_of
from omtwarp.commands._cli import SUMMARIES, main, program
from omtwarp.commands._command import as_command, heading_of, sections
from omtwarp.files.output import PREFIX
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import SUFFIXES, write_mesh

BALL = shapes.icosphere(2)


class Piped(io.TextIOWrapper):
    """A standard stream that is a pipe."""

    def isatty(self) -> bool:
        return False


def run(monkeypatch, capfdbinary, arguments, given: bytes = b"") -> tuple[int, bytes, str]:
    """Run a command with an input; return its exit status, standard output as bytes and standard error."""
    monkeypatch.setattr(sys, "stdin", Piped(io.BytesIO(given)))
    stdout = Piped(open(1, "wb", closefd=False))
    monkeypatch.setattr(sys, "stdout", stdout)
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    stdout.flush()
    out, err = capfdbinary.readouterr()
    return int(ended.value.code or 0), out, err.decode()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a sphere in every format, and its map."""
    for suffix in SUFFIXES:
        write_mesh(tmp_path / f"ball{suffix}", BALL.vertices, BALL.faces)
    count = len(BALL.vertices)
    MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(count)).save(tmp_path / "map.npz")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_standard_input_is_known_by_its_first_bytes(folder, monkeypatch, capfdbinary, suffix):
    given = (folder / f"ball{suffix}").read_bytes()
    status, out, err = run(monkeypatch, capfdbinary, ["check", "-"], given)
    assert (status, err) == (0, "")
    assert b"standard input: 42 vertices, 80 faces" in out
    assert not list(folder.glob(PREFIX + "*"))


@pytest.mark.parametrize("suffix", [".ply", ".off", ".obj", ".gii", ".vtk"])
def test_standard_input_may_be_compressed(folder, monkeypatch, capfdbinary, suffix):
    given = gzip.compress((folder / f"ball{suffix}").read_bytes())
    status, out, err = run(monkeypatch, capfdbinary, ["check", "-"], given)
    assert (status, err) == (0, "") and b"standard input: 42 vertices, 80 faces" in out


@pytest.mark.parametrize(("kind", "cells"), [("PolyData", "Polys"), ("UnstructuredGrid", "Cells")])
def test_vtk_files_of_xml_are_known_on_standard_input(folder, monkeypatch, capfdbinary, kind, cells):
    def array(name, values, width=1):
        text = " ".join(map(str, np.ravel(values).tolist()))
        return f'<DataArray type="Float64" Name="{name}" NumberOfComponents="{width}" format="ascii">{text}</DataArray>'

    count = len(BALL.faces)
    given = f'<?xml version="1.0"?><VTKFile type="{kind}" byte_order="LittleEndian"><{kind}><Piece><Points>'
    given += array("Points", BALL.vertices, 3) + f"</Points><{cells}>" + array("connectivity", BALL.faces)
    given += array("offsets", 3 * np.arange(1, count + 1)) + array("types", np.full(count, 5))
    given += f"</{cells}></Piece></{kind}></VTKFile>"
    status, out, err = run(monkeypatch, capfdbinary, ["check", "-"], given.encode())
    assert (status, err) == (0, "") and b"standard input: 42 vertices, 80 faces" in out


def test_a_map_goes_through_a_pipe(folder, monkeypatch, capfdbinary):
    given = (folder / "map.npz").read_bytes()
    words = ["texture", "--map", "-", "-o", "-", "--size", "64", "--device", "cpu"]
    status, out, err = run(monkeypatch, capfdbinary, words, given)
    assert status == 0 and out.startswith(b"glTF") and "standard output: 42 vertices" in err
    status, out, _ = run(monkeypatch, capfdbinary, ["check", "ball.ply", "--repair", "-o", "-"])
    assert status == 0 and out == (folder / "ball.ply").read_bytes()
    assert not list(folder.glob(PREFIX + "*"))


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("Failed to allocate 393216 bytes on device 'cpu'")])
def test_memory_that_is_used_up_is_one_line(folder, monkeypatch, capfdbinary, error):
    def full(*_, **__):
        raise error

    monkeypatch.setattr("omtwarp.commands.map.make_map", full)
    status, _, err = run(monkeypatch, capfdbinary, ["map", "ball.ply", "-o", "full.npz"])
    assert status == 1 and err == "omtwarp: error: out of memory: use a coarser mesh, or a machine with more\n"
    assert not (folder / "full.npz").exists()


def test_streams_that_fail_are_one_line(folder, monkeypatch, capfdbinary):
    for given, words in ((b"", "standard input is empty"), (b"ply\nnonsense", "standard input: cannot be read as ply")):
        status, out, err = run(monkeypatch, capfdbinary, ["check", "-"], given)
        assert (status, out) == (1, b"") and err.startswith("omtwarp: error: " + words) and err.count("\n") == 1
    status, out, err = run(monkeypatch, capfdbinary, ["texture", "--map", "none.npz", "-o", "-"])
    assert (status, out) == (1, b"") and "none.npz: no such file" in err
    assert not list(folder.glob(PREFIX + "*"))


def test_check_of_several_meshes_as_json(folder, monkeypatch, capfdbinary):
    write_mesh(folder / "open.ply", BALL.vertices, BALL.faces[1:])
    words = ["check", "ball.ply", "open.ply", "none.ply", "--json"]
    status, out, err = run(monkeypatch, capfdbinary, words)
    sound, bad = json.loads(out)
    assert status == 1 and sound["mappable"] and not bad["mappable"]
    assert [defect["kind"] for defect in bad["defects"]] == ["open-boundary"]
    assert err.splitlines()[-1] == "omtwarp: error: 2 of 3 meshes failed: open.ply, none.ply"
    assert "none.ply: no such file" in err
    status, out, _ = run(monkeypatch, capfdbinary, ["check", "ball.ply", "--json"])
    assert status == 0 and json.loads(out)["vertices"] == 42


@pytest.mark.parametrize("words", [["check"], ["map", "-o", "map.npz"], ["texture", "-o", "made.glb"]])
def test_json_of_a_single_mesh_that_fails_is_an_empty_list(folder, monkeypatch, capfdbinary, words):
    """A script can parse what it gets, whatever the exit status."""
    status, out, err = run(monkeypatch, capfdbinary, [words[0], "none.ply", *words[1:], "--json"])
    assert status == 1 and json.loads(out) == [] and "none.ply: no such file" in err


def test_maps_of_several_meshes(folder, monkeypatch, capfdbinary):
    words = ["map", "ball.ply", "ball.off", "-o", "maps", "--until", "conformal", "--device", "cpu"]
    status, _, err = run(monkeypatch, capfdbinary, words)
    assert status == 1 and "two meshes would both be written as 'maps/ball.npz'" in err
    (folder / "other.off").write_bytes((folder / "ball.off").read_bytes())
    words[2] = "other.off"
    status, out, err = run(monkeypatch, capfdbinary, [*words, "--json", "--verbose", "--report", "maps"])
    first, second = json.loads(out)
    assert status == 0 and first["output"] == "maps/ball.npz" and first["bijective"] and first["flips"] == 0
    assert second["report"] == "maps/other.json" and "omtwarp: conformal: " in err
    assert sorted(path.name for path in (folder / "maps").iterdir()) == [
        ".omtwarp.json", "ball.json", "ball.npz", "other.json", "other.npz",
    ]  # fmt: skip


def test_a_folder_for_several_results_keeps_what_the_user_has_there(folder, monkeypatch, capfdbinary):
    (folder / "other.off").write_bytes((folder / "ball.off").read_bytes())
    words = ["map", "ball.ply", "other.off", "-o", "maps", "--until", "conformal", "--device", "cpu", "--quiet"]
    (folder / "maps").mkdir()
    (folder / "maps/other.npz").write_bytes(b"precious")
    status, _, err = run(monkeypatch, capfdbinary, words)
    assert status == 1 and "cannot write 'maps/other.npz': omtwarp did not write what is there" in err
    assert (folder / "maps/other.npz").read_bytes() == b"precious" and not (folder / "maps/ball.npz").exists()
    for again in ([*words, "--force"], words):  # what it wrote itself it replaces
        assert run(monkeypatch, capfdbinary, again)[0] == 0
        assert (folder / "maps/other.npz").stat().st_size > 1000


def test_torus_and_exact_maps_of_several_meshes(folder, monkeypatch, capfdbinary):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=12, minor_sections=6)
    write_mesh(folder / "ring.ply", ring.vertices, ring.faces)
    status, out, err = run(
        monkeypatch, capfdbinary, ["map", "ring.ply", "ball.ply", "-o", "maps", "--torus", "-q", "-v"]
    )
    assert status == 1 and not out and (folder / "maps/ring.npz").exists() and "omtwarp: omt: " in err
    assert "omtwarp: ball.ply: the surface has genus 0, closed, and only one of genus 1, closed, maps to a torus" in err
    status, out, err = run(monkeypatch, capfdbinary, ["map", "ring.ply", "-o", "ring2.ply", "--torus", "--beside"])
    assert status == 1 and err == (
        "omtwarp: error: --beside is for maps to the sphere: a ring torus is written by itself\n"
    )
    status, out, _ = run(monkeypatch, capfdbinary, ["map", "ball.ply", "-o", "ball.npz", "--exact", "-q", "--json"])
    found = json.loads(out)
    assert status == 0 and found["faces"] == 4 * len(BALL.faces) and found["largest_area_error"] < 1e-6


SEVERAL = {
    "texture": (".glb", ["--until", "conformal", "--size", "64"]),
    "unwrap": (".glb", []),
    "preview": (".png", ["--size", "48", "--backend", "warp"]),
    "report": (".html", ["--until", "conformal"]),
    "film": (".gif", ["--size", "64x48", "--seconds", "0.2", "--fps", "10", "--backend", "warp"]),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_several_meshes_go_to_a_directory(folder, monkeypatch, capfdbinary, small_pictures, name):
    suffix, options = SEVERAL[name]
    (folder / "other.off").write_bytes((folder / "ball.off").read_bytes())
    words = [name, "ball.ply", "none.ply", "other.off", *options, "--device", "cpu", "--quiet", "--json", "-o"]
    status, out, err = run(monkeypatch, capfdbinary, [*words, "made"])
    assert status == 1 and err.splitlines()[-1] == "omtwarp: error: 1 of 3 meshes failed: none.ply"
    assert [facts["output"] for facts in json.loads(out)] == [f"made/ball{suffix}", f"made/other{suffix}"]
    written = sorted(path.name for path in (folder / "made").iterdir())
    assert written == [".omtwarp.json", f"ball{suffix}", f"other{suffix}"]
    status, out, err = run(monkeypatch, capfdbinary, [*words, "-"])
    assert (status, out) == (1, b"") and "3 files cannot go to standard output: name a directory" in err
    status, out, err = run(monkeypatch, capfdbinary, [*words, "made", "--map", "map.npz"])
    assert (status, out) == (1, b"") and "one map 'map.npz' cannot be that of 3 meshes" in err


def commands():
    context = program.make_context("omtwarp", [], resilient_parsing=True)
    return {name: as_command(function_of(name)) for name in program.list_commands(context)}, context


EXAMPLES = {name: sections(function_of(name))[1] for name in SUMMARIES}


@pytest.mark.parametrize("name", EXAMPLES)
def test_help_has_examples_groups_and_a_whole_summary(name):
    found, parent = commands()
    command = found[name]
    text = command.get_help(click.Context(command, info_name=name, parent=parent))
    assert "Examples:\n" in text and all(line in text for line in EXAMPLES[name].splitlines())
    assert "Output:\n" in text and "Options:\n" not in text
    assert not re.search(r"<(?!=)", text.partition("Examples:")[0])  # no names of Python's types
    assert text.partition("Other:\n")[2].partition("\n\n")[0].strip().startswith("-h, --help")
    assert "{" not in text and not re.search(r"(?<= )--?[a-z-]+-\n", text)  # no braces, no option cut in two
    assert max(len(line) for line in text.splitlines()) <= 80
    assert SUMMARIES[name] in parent.command.get_help(parent)
    for line in EXAMPLES[name].splitlines():
        for part in line.split("|"):
            program, *arguments = shlex.split(part)
            if program == "omtwarp":  # it parses; the pages' tests run such lines
                found[arguments[0]].make_context(arguments[0], arguments[1:], parent=parent).close()


def test_every_command_is_summed_up():
    assert all(EXAMPLES.values()) and set(SUMMARIES) == set(commands()[0])


def completing(*arguments: str, **environment: str) -> str:
    """Return what the program prints with arguments and variables of a shell."""
    command = [sys.executable, "-m", "omtwarp", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **environment}).stdout


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("omtwarp te", ["plain,texture"]),
        ("omtwarp map --ref", ["plain,--refine"]),
        ("omtwarp map --refine a", ["plain,area", "plain,angle"]),
        ("omtwarp texture --atlas cu", ["plain,cube"]),
        ("omtwarp map ball", ["file,ball"]),
        ("omtwarp resample - --to map", ["file,map"]),
    ],
)
def test_completion_knows_commands_options_their_words_and_files(words, offered):
    count = str(len(words.split()) - 1)
    assert completing(_OMTWARP_COMPLETE="bash_complete", COMP_WORDS=words, COMP_CWORD=count).split() == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_shown_and_added_to_what_the_shell_reads(tmp_path, shell):
    shown = completing("--show-completion", SHELL=f"/usr/bin/{shell}")
    assert shown.strip() == completing(_OMTWARP_COMPLETE=f"{shell}_source").strip()
    assert f"_OMTWARP_COMPLETE={shell}_complete" in shown
    user = {"SHELL": f"/usr/bin/{shell}", "HOME": str(tmp_path), "USERPROFILE": str(tmp_path)}
    for _ in range(2):
        said = completing("--install-completion", **user)
    (start,) = (path for path in tmp_path.rglob("*") if path.is_file())
    assert said.startswith(f"{start}: ") and start.read_text().count(f"_OMTWARP_COMPLETE={shell}_source omtwarp") == 1


def test_completion_of_an_unknown_shell_is_refused(folder, monkeypatch, capfdbinary):
    monkeypatch.setenv("SHELL", "/bin/csh")
    for option in ("--show-completion", "--install-completion"):
        status, out, err = run(monkeypatch, capfdbinary, [option])
        assert (status, out) == (1, b"") and err.startswith("omtwarp: error: no completion for the shell 'csh'")


# What every command takes: the words that it needs with - as its input, the output that may be -, and whether it takes
# several inputs.
TABLE = {
    "map": (["-", "-o", "x.npz"], "-o", True),
    "texture": (["-", "-o", "x.glb"], "-o", True),
    "transfer": (["-", "ball.ply", "-o", "x.glb"], "-o", False),
    "unwrap": (["-", "-o", "x.glb"], "-o", True),
    "preview": (["-", "-o", "x.png"], "-o", True),
    "film": (["--map", "-", "-o", "x.gif"], "-o", True),
    "report": (["--map", "-", "-o", "x.html"], "-o", True),
    "align": (["-", "-o", "x.npz"], "-o", False),
    "resample": (["-", "--to", "ico0", "-o", "x.ply"], "-o", False),
    "register": (["-", "--to", "map.npz", "-o", "x.npz"], "-o", True),
    "check": (["-", "--repair", "-o", "x.ply"], "-o", True),
    "cohort": (["-", "-o", "x"], None, False),  # a table or a pattern names them
    "spharm": (["-", "-o", "x.csv"], "-o", False),
    "distance": (["-", "map.npz"], None, False),
    "group": (["-", "-o", "x"], None, True),
    "demo": (None, None, False),
}


@pytest.mark.parametrize("name", SUMMARIES)
def test_every_command_has_json_verbose_and_quiet(name):
    options = [word for option in commands()[0][name].params for word in option.opts]
    assert {"--json", "--verbose", "-v", "--quiet", "-q"} <= set(options)
    assert "--output" in options or name == "distance"


@pytest.mark.parametrize("name", [name for name in SUMMARIES if TABLE[name][0]])
def test_commands_read_standard_input(folder, monkeypatch, capfdbinary, name):
    status, out, err = run(monkeypatch, capfdbinary, [name, *TABLE[name][0]])
    assert (status, out) == (1, b"") and err == "omtwarp: error: standard input is empty\n"


class Terminal(Piped):
    """A standard stream that is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("name", [name for name in SUMMARIES if TABLE[name][1]])
def test_commands_write_standard_output(folder, monkeypatch, capsys, name):
    words, option, _ = TABLE[name]
    monkeypatch.setattr(sys, "stdin", Piped(io.BytesIO((folder / "map.npz").read_bytes())))
    monkeypatch.setattr(sys, "stdout", Terminal(io.BytesIO()))
    with pytest.raises(SystemExit) as ended:
        main([name, *words[: words.index(option) + 1], "-"])
    err = capsys.readouterr().err
    assert ended.value.code == 1 and err.startswith("omtwarp: error: standard output is a terminal")


HEADINGS = {
    "texture size": "Texture", "transfer size": "Texture", "preview size": "View", "resample method": "Method",
    "map method": "Map", "group components": "Method", "map components": "Holes, handles, parts",
    "preview projection": "View", "texture projection": "Texture",
}  # fmt: skip


@pytest.mark.parametrize("name", SUMMARIES)
def test_options_stand_under_headings_that_fit(name):
    options = [one.name for one in commands()[0][name].params if one.param_type_name == "option"]
    assert [option for option in options if heading_of(name, option) == "Other"] in ([], ["help"])
    for option in options:
        assert heading_of(name, option) == HEADINGS.get(f"{name} {option}", heading_of(name, option))


@pytest.mark.parametrize("name", SUMMARIES)
def test_commands_that_take_several_inputs(name):
    several = any(one.param_type_name == "argument" and one.nargs == -1 for one in commands()[0][name].params)
    assert several == TABLE[name][2]


def test_no_example_is_shown_twice():
    assert [name for name, command in commands()[0].items() if "Example" in (command.help or "")] == []


def test_verbose_says_how_long_stages_took(folder, monkeypatch, capfdbinary):
    status, out, err = run(monkeypatch, capfdbinary, ["align", "map.npz", "-o", "turned.npz", "-v"])
    assert status == 0 and b"turned.npz: turned by" in out
    assert re.fullmatch("".join(rf"omtwarp: {step}: \d+\.\d\d s\n" for step in ("read", "align", "write")), err)


def test_a_mesh_beside_its_map_needs_a_use(folder, monkeypatch, capfdbinary):
    words = ["texture", "ball.ply", "--map", "map.npz", "-o", "area.glb", "--bake", "area"]
    status, _, err = run(monkeypatch, capfdbinary, words)
    assert status == 1 and err == (
        "omtwarp: error: a mesh beside --map is for --uv own or --keep-materials: "
        "add one of them, or leave the mesh out\n"
    )
    assert not (folder / "area.glb").exists()


def test_a_command_prints_to_a_stream_of_text_alone(folder, monkeypatch):
    """Standard output may be a text in memory, as in notebooks."""
    text = io.StringIO()
    monkeypatch.setattr(sys, "stdout", text)
    with pytest.raises(SystemExit) as ended:
        main(["check", "ball.ply"])
    assert not ended.value.code and text.getvalue().startswith("ball.ply: 42 vertices")
