"""Commands on surfaces of other topology: what they refuse, and what the options do."""

from __future__ import annotations

import json

import numpy as np
import pytest

import omtwarp
from omtwarp.cli import main
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.shape_analysis import expand


def run(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


@pytest.fixture
def open_mesh(tmp_path):
    """A file with a surface that has one hole."""
    blob = shapes.blob(seed=3, sphere=1280)
    used, faces = np.unique(blob.faces[(blob.vertices[blob.faces, 2] > -0.3).all(axis=1)], return_inverse=True)
    write_mesh(tmp_path / "open.ply", blob.vertices[used], faces.reshape(-1, 3))
    return tmp_path / "open.ply"


def test_open_surface_is_refused_with_the_option_that_maps_it(capsys, open_mesh):
    status, _, err = run(capsys, "map", open_mesh, "-o", open_mesh.with_name("m.npz"))
    assert status == 1 and "--hemisphere" in err and "--fill-area" in err and len(err.splitlines()) == 1
    status, out, _ = run(capsys, "check", open_mesh)
    options = [line.split()[1] for line in out.splitlines() if line.startswith("  option ")]
    assert status == 1 and options == ["--hemisphere:", "--disk,", "--fill-area"]


@pytest.mark.parametrize("option", [("--hemisphere",), ("--disk",), ("--cap",), ("--fill-area", "natural")])
def test_options_map_and_the_other_commands_take_the_result(capsys, open_mesh, option):
    target = open_mesh.with_name("m.npz")
    status, out, err = run(capsys, "map", open_mesh, "-o", target, "--quiet", *option)
    assert (status, out, err) == (0, "", "")
    result = omtwarp.SurfaceMap.load(target)
    assert result.report["certificate"]["bijective"] and result.domain == (option[0][2:], "sphere")[len(option) - 1]
    for command, name in (("texture", "m.glb"), ("preview", "m.png"), ("report", "m.html")):
        size = ["--size", "256"] if command != "report" else []
        status, _, err = run(capsys, command, "--map", target, "-o", open_mesh.with_name(name), "--quiet", *size)
        assert status == 0, err


def test_summary_tells_the_sizes_of_the_input(capsys, open_mesh):
    """Vertices and faces that the map has in addition are named beside them."""
    target, mesh = open_mesh.with_name("m.npz"), read_mesh(open_mesh)
    given, count = len(mesh.vertices), len(mesh.faces)
    status, out, err = run(capsys, "map", open_mesh, "-o", target, "--fill-area", "natural", "--exact")
    new = len(omtwarp.SurfaceMap.load(target).vertices) - given
    assert status == 0 and f"{given} vertices and {new} new ones, {count} faces in {4 * count} parts; flips 0" in out, (
        err
    )
    status, out, err = run(capsys, "map", open_mesh, "-o", target, "--hemisphere", "--json")
    facts = json.loads(out)
    result = omtwarp.SurfaceMap.load(target)
    assert (
        facts["new_vertices"] == len(result.split_edges) == facts["vertices"] - given and facts["copied_vertices"] == 0
    )
    assert facts["input_faces"] == count and facts["faces"] == len(result.faces), err


def test_disk_is_written_flat(capsys, open_mesh):
    status, _, err = run(capsys, "map", open_mesh, "-o", open_mesh.with_name("disk.off"), "--disk", "--until", "omt")
    assert status == 0, err
    flat = read_mesh(open_mesh.with_name("disk.off")).vertices
    assert (flat[:, 2] == 0.0).all() and np.linalg.norm(flat, axis=1).max() == pytest.approx(1.0, abs=1e-12)


def test_two_domains_are_wrong(capsys, open_mesh):
    status, _, err = run(capsys, "map", open_mesh, "-o", open_mesh.with_name("m.npz"), "--disk", "--cap")
    assert status == 1 and "both --disk and --cap" in err


def test_parts(capsys, tmp_path):
    ball = shapes.blob(seed=1, sphere=320)
    vertices = np.concatenate([ball.vertices, ball.vertices + 4.0])
    write_mesh(tmp_path / "two.ply", vertices, np.concatenate([ball.faces, ball.faces + ball.vertex_count]))
    status, _, err = run(capsys, "map", tmp_path / "two.ply", "-o", tmp_path / "m.npz")
    assert status == 1 and "--components" in err
    status, _, err = run(capsys, "map", tmp_path / "two.ply", "-o", tmp_path / "m.npz", "--components", "--quiet")
    assert status == 0, err
    assert np.bincount(omtwarp.SurfaceMap.load(tmp_path / "m.npz").part).tolist() == [320, 320]
    status, _, err = run(capsys, "texture", tmp_path / "m.npz", "-o", tmp_path / "m.glb", "--pattern", "dots")
    assert status == 2 and "'dots' is not one of 'circles'" in err and "Value error" not in err
    status, out, err = run(capsys, "unwrap", "--map", tmp_path / "m.npz", "-o", tmp_path / "m.glb")
    assert status == 0 and "324 vertices, 640 faces, 12 charts" in out, err
    words = ["texture", "--map", tmp_path / "m.npz", "--bake", "curvature", "-o", tmp_path / "b.glb"]
    status, out, err = run(capsys, *words, "--size", "512")
    assert status == 0 and "324 vertices, 640 faces, texture colour 512 x 512" in out, err
    status, _, err = run(capsys, *words, "--size", "64")
    assert status == 1 and err == "omtwarp: error: a picture of 64 x 64 texels has no room for 2 parts\n", err
    status, out, err = run(capsys, "map", tmp_path / "two.ply", "-o", tmp_path / "m.npz", "--together")
    slit = len(omtwarp.SurfaceMap.load(tmp_path / "m.npz").vertices) - 324
    assert status == 0 and f"324 vertices and {slit} copies along cuts, 640 faces; flips 0, 97." in out, err
    assert slit > 0 and "% of the sphere covered" in out
    status, _, err = run(capsys, "unwrap", "--map", tmp_path / "m.npz", "-o", tmp_path / "m.glb", "--quiet")
    assert status == 0, err
    status, _, err = run(capsys, "map", tmp_path / "two.ply", "-o", tmp_path / "m.npz", "--together", "--disk")
    assert status == 1 and "both --together and --disk" in err


def test_handles(capsys, tmp_path):
    surface = shapes.rings(2, cell=0.35)
    write_mesh(tmp_path / "pretzel.ply", surface.vertices, surface.faces)
    status, _, err = run(capsys, "map", tmp_path / "pretzel.ply", "-o", tmp_path / "m.npz")
    assert status == 1 and "--cut" in err
    status, _, err = run(capsys, "map", tmp_path / "pretzel.ply", "-o", tmp_path / "m.npz", "--cut", "--quiet")
    assert status == 0, err
    result = omtwarp.SurfaceMap.load(tmp_path / "m.npz")
    assert len(result.loop_pairs) == 2
    copies = len(result.vertices) - surface.vertex_count
    status, out, err = run(capsys, "texture", tmp_path / "m.npz", "-o", tmp_path / "m.glb", "--size", "64")
    words = f"{surface.vertex_count} vertices and {copies} copies along cuts, {surface.face_count} faces, textured"
    assert status == 0 and words in out, err


def test_torus(capsys, tmp_path):
    surface = shapes.rings(1, cell=0.35)
    write_mesh(tmp_path / "ring.ply", surface.vertices, surface.faces)
    for name in ("m.npz", "m.glb"):
        status, out, err = run(capsys, "map", tmp_path / "ring.ply", "-o", tmp_path / name, "--torus")
        assert status == 0, err
        assert "flips 0, degree 1" in out
    assert omtwarp.TorusMap.load(tmp_path / "m.npz").bijective
    status, _, err = run(capsys, "preview", tmp_path / "m.glb", "-o", tmp_path / "m.png", "--quiet")
    assert status == 0, err
    status, _, err = run(capsys, "map", tmp_path / "ring.ply", "-o", tmp_path / "m.ply", "--torus")
    assert status == 0, err
    ring = read_mesh(tmp_path / "m.ply")
    assert len(ring.faces) == len(omtwarp.TorusMap.load(tmp_path / "m.npz").faces)
    assert np.ptp(ring.vertices[:, 2]) < 0.7 * np.ptp(ring.vertices[:, 0])
    whole = tmp_path / "m.npz"
    for words in (
        ["texture", "--map", whole, "-o", tmp_path / "t.glb"],
        ["texture", whole, "-o", tmp_path / "t.obj", "--pattern", "checker", "--size", "64"],
        ["preview", whole, "-o", tmp_path / "t.png", "--size", "64"],
        ["report", whole, "-o", tmp_path / "t.html"],
    ):
        status, _, err = run(capsys, *words)
        assert status == 0, err
    assert "one to one" in (tmp_path / "t.html").read_text("utf-8") and (tmp_path / "t.png").stat().st_size > 1000
    for words, told in (
        (["texture", whole, "-o", tmp_path / "u.glb", "--pattern", "globe"], "is for the sphere"),
        (["texture", whole, "-o", tmp_path / "u.glb", "--atlas", "octahedral"], "for textures on the sphere"),
        (["spharm", whole, "-o", tmp_path / "u.csv"], "a map to a torus"),
    ):
        status, _, err = run(capsys, *words)
        assert status == 1 and told in err and err.count("\n") == 1 and "Traceback" not in err, err


KINDS = {
    "hemisphere": ("open", "--hemisphere"),
    "disk": ("open", "--disk"),
    "cap": ("open", "--cap"),
    "natural": ("open", "--fill-area", "natural"),
    "small": ("open", "--fill-area", "small"),
    "exact": ("open", "--fill-area", "small", "--exact"),
    "parts": ("two", "--components"),
    "together": ("two", "--together"),
    "exact disk": ("open", "--disk", "--exact"),
    "exact together": ("two", "--together", "--exact"),
    "cut": ("pretzel", "--cut"),
    "torus": ("ring", "--torus"),
}
PART = "does not cover the sphere: map the mesh with --fill-area natural"
SEVERAL = "several parts do not cover one sphere: map each part by itself"
TORUS = "is a map to a torus"
# Commands that need the whole sphere take filled and cut surfaces, and say what to do of others.
NOT_THE_SPHERE = {"hemisphere": PART, "disk": PART, "cap": PART, "parts": SEVERAL, "together": SEVERAL, "torus": TORUS}
NOT_THE_SPHERE |= {"exact disk": PART, "exact together": SEVERAL}
COMMANDS = {
    "align {map} -o {out}.npz": NOT_THE_SPHERE,
    "align {map} --to {closed} -o {out}.ply": NOT_THE_SPHERE,
    "align {closed} --to {map} -o {out}.npz --by features": NOT_THE_SPHERE,
    "resample {map} --to {closed} -o {out}.ply": NOT_THE_SPHERE,
    "resample {map} --to ico2 --data {data} -o {out}.npy --matrix {out}.npz": NOT_THE_SPHERE,
    "resample {map} --to ico2 --data {data} -o {out}.npy --method conservative --labels": NOT_THE_SPHERE,
    "resample {closed} --to {map} -o {out}.ply --sphere {out}.off": NOT_THE_SPHERE,
    "spharm {map} -o {out}.csv --degree 3 --reconstruction {out}.ply": NOT_THE_SPHERE,
    "distance {map} {closed} --degree 3": NOT_THE_SPHERE,
    "group {map} {closed} -o {out} --grid ico1 --degree 3": NOT_THE_SPHERE,
    "transfer {painted} {mesh} --map-from {closed} --map-to {map} -o {out}.glb --size 32": NOT_THE_SPHERE
    | {"cut": ""}
    | dict.fromkeys(("exact", "exact disk", "exact together"), "not in the mesh"),
    "texture {map} -o {out}.glb --size 64": {},
    "texture {map} -o {out}.obj --pattern checker --size 64": {},
    "texture {map} -o {out}.ply --size 64": {},
    "texture {map} -o {out}.glb --bake ao --size 256": {},
    "texture {map} -o {out}.obj --pattern checker --bake normal --detail {mesh} --size 256": {},
    "unwrap --map {map} -o {out}.glb": {},
    "preview {map} -o {out}.png --size 48": {},
    "film {map} -o {out}.gif --size 32x32 --seconds 0.2 --fps 5": {},
    "report {map} -o {out}.html": {},
    "texture {mesh} -o {out}.glb": dict.fromkeys(KINDS, "'omtwarp map' with --"),
}


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A folder with a small map of each kind, and one of a closed surface."""
    folder = tmp_path_factory.mktemp("kinds")
    blob = shapes.blob(seed=3, sphere=320)
    used, faces = np.unique(blob.faces[(blob.vertices[blob.faces, 2] > -0.3).all(axis=1)], return_inverse=True)
    write_mesh(folder / "open.ply", blob.vertices[used], faces.reshape(-1, 3))
    both = np.concatenate([blob.vertices, blob.vertices + 4.0])
    write_mesh(folder / "two.ply", both, np.concatenate([blob.faces, blob.faces + blob.vertex_count]))
    for name, count in (("ring", 1), ("pretzel", 2)):
        surface = shapes.rings(count, cell=0.45)
        write_mesh(folder / f"{name}.ply", surface.vertices, surface.faces)
    write_mesh(folder / "closed.ply", blob.vertices, blob.faces)
    for kind, (mesh, *options) in {**KINDS, "closed": ("closed",)}.items():
        with pytest.raises(SystemExit) as ended:
            main(["map", str(folder / f"{mesh}.ply"), "-o", str(folder / f"{kind}.npz"), "--quiet", *options])
        assert not ended.value.code, kind
        with np.load(folder / f"{kind}.npz") as arrays:
            np.save(folder / f"{kind}.npy", np.arange(len(arrays["vertices"])))
    main_words = ["texture", str(folder / "closed.npz"), "-o", str(folder / "painted.ply"), "--size", "64", "--quiet"]
    with pytest.raises(SystemExit):
        main(main_words)
    return folder


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_take_a_kind_of_map_or_say_why_not(capsys, maps, tmp_path, kind, command):
    """Each command takes each kind of map, or refuses it in one line and writes nothing."""
    told = COMMANDS[command].get(kind, "")
    words = {"map": maps / f"{kind}.npz", "mesh": maps / f"{KINDS[kind][0]}.ply", "closed": maps / "closed.npz"}
    words |= {"data": maps / f"{kind}.npy", "painted": maps / "painted.ply", "out": tmp_path / "out"}
    status, shown, err = run(capsys, *(word.format(**words) for word in command.split()))
    assert status == (1 if told else 0) and "Traceback" not in err, err
    if told:
        assert told in err and len(err.splitlines()) == 1, err
        assert not list(tmp_path.iterdir())
    else:
        assert shown
        for word in command.split():
            if word.startswith("{out}"):
                assert (tmp_path / word.format(out="out")).stat().st_size > 100


@pytest.mark.parametrize("kind", ["torus", "parts", "disk", "cut"])
@pytest.mark.parametrize("options", ["--bake ao", "--pattern checker --keep-materials over", "--bake {data}"])
def test_an_unwrapped_mesh_is_painted_in_its_own_coordinates(capsys, maps, tmp_path, kind, options):
    """What unwrap writes is read again with its coordinates, and painted through the same map."""
    status, _, err = run(capsys, "unwrap", "--map", maps / f"{kind}.npz", "-o", tmp_path / "uv.obj", "--quiet")
    assert status == 0, err
    words = ["texture", tmp_path / "uv.obj", "--map", maps / f"{kind}.npz", "-o", tmp_path / "own.glb", "--uv", "own"]
    words += [word.format(data=maps / f"{kind}.npy") for word in options.split()]
    status, out, err = run(capsys, *words, "--size", "64")
    assert status == 0 and "64 x 64" in out and "overlap" not in err, err


def test_resampling_says_how_many_points_lie_in_filled_holes(capsys, maps, tmp_path):
    words = ["resample", maps / "natural.npz", "--to", "ico3", "--data", maps / "natural.npy", "-o", tmp_path / "d.npy"]
    status, out, err = run(capsys, *words)
    empty = int((np.load(tmp_path / "d.npy") == 0.0).sum())
    assert status == 0 and f"to 642 points, {empty} of them 0 as they lie in filled holes" in out and empty > 50, err


def test_error_of_harmonics_is_that_of_the_surface(capsys, maps, tmp_path):
    """Coefficients are those of the surface with its filling, the error that of the surface alone."""
    status, out, err = run(
        capsys, "spharm", maps / "natural.npz", "-o", tmp_path / "c.csv", "--degree", "5", "--json", "--quiet"
    )
    assert status == 0, err
    result = omtwarp.SurfaceMap.load(maps / "natural.npz")
    closed = result.closed()
    found = expand(closed.sphere, closed.vertices, 5, faces=closed.faces)
    written = np.loadtxt(tmp_path / "c.csv", delimiter=",", skiprows=1)[:, 2:]
    assert written == pytest.approx(found.coefficients)
    apart = ((found.at(result.sphere) - result.vertices) ** 2).sum(axis=1)
    areas = omtwarp.Surface(result.vertices, result.faces).vertex_areas
    assert json.loads(out)["rms_error"] == pytest.approx(np.sqrt(areas @ apart / areas.sum()))


def test_sphere_of_a_filled_map_alone_is_refused(capsys, maps, tmp_path):
    """A mesh holds the surface's own triangles only; the line says that the map's file has the others."""
    status, _, err = run(
        capsys, "map", maps / "open.ply", "-o", tmp_path / "s.ply", "--fill-area", "natural", "--quiet"
    )
    assert status == 0, err
    status, _, err = run(
        capsys, "resample", tmp_path / "s.ply", "--to", "ico2", "--data", maps / "natural.npy", "-o", "d.npy"
    )
    assert status == 1 and "or the .npz of one with filled holes" in err and err.count("\n") == 1
