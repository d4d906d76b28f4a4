"""Commands on surfaces of other topology: what they refuse, and what the options do."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image, ImageSequence
from scipy import sparse

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.commands._work import quality
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.shape_analysis import expand

pytestmark = pytest.mark.usefixtures("small_pictures")


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
    result = omtwarp.MapResult.load(target)
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
    new = len(omtwarp.MapResult.load(target).vertices) - given
    assert status == 0 and f"{given} vertices and {new} new ones, {count} faces in {4 * count} parts; flips 0" in out, (
        err
    )
    status, out, err = run(capsys, "map", open_mesh, "-o", target, "--hemisphere", "--json")
    facts = json.loads(out)
    result = omtwarp.MapResult.load(target)
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
    assert np.bincount(omtwarp.MapResult.load(tmp_path / "m.npz").part).tolist() == [320, 320]
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
    slit = len(omtwarp.MapResult.load(tmp_path / "m.npz").vertices) - 324
    assert status == 0 and f"324 vertices and {slit} copies along cuts, 640 faces; flips 0, 97." in out, err
    assert slit > 0 and "% of the sphere covered" in out
    status, _, err = run(capsys, "unwrap", "--map", tmp_path / "m.npz", "-o", tmp_path / "m.glb", "--quiet")
    assert status == 0, err
    status, _, err = run(capsys, "map", tmp_path / "two.ply", "-o", tmp_path / "m.npz", "--together", "--disk")
    assert status == 1 and "both --together and --disk" in err


def test_degree_is_told_for_each_part(capsys, tmp_path):
    """The degrees of parts that have a sphere each are added up in one number only, beside which all are listed."""
    ball = shapes.blob(seed=1, sphere=320)
    half = ball.faces[(shapes.icosphere(4).vertices[ball.faces, 2] > -1e-9).all(axis=1)]
    used, rim = np.unique(half, return_inverse=True)
    pieces = {"closed": [(ball.vertices, ball.faces)] * 3, "open": [(ball.vertices[used], rim.reshape(-1, 3))] * 2}
    for name, parts in pieces.items():
        counts = np.cumsum([0] + [len(points) for points, _ in parts])
        vertices = np.concatenate([points + 4.0 * k for k, (points, _) in enumerate(parts)])
        faces = np.concatenate([corners + count for (_, corners), count in zip(parts, counts, strict=False)])
        write_mesh(tmp_path / f"{name}.ply", vertices, faces)
    told = {
        ("closed", "--components"): "degree 1.000000 on each of 3 spheres",
        ("open", "--hemisphere"): "50.00% of each of 2 spheres covered",
        ("open", "--disk"): "degree 1.000000 on each of 2 disks",
        ("closed", "--together"): "% of the sphere covered",
    }
    for (name, option), words in told.items():
        asked = ("map", tmp_path / f"{name}.ply", "-o", tmp_path / "m.npz", "--components", option)
        status, out, err = run(capsys, *asked, "--json")
        facts, parts = json.loads(out), omtwarp.MapResult.load(tmp_path / "m.npz").report["parts"]
        assert status == 0 and words in quality(facts), err
        if option == "--together":
            assert facts["degree_of_parts"] is None and facts["degree"] < 1.0
        else:
            assert facts["degree_of_parts"] == [part["stages"][-1]["degree"] for part in parts]
        if option not in ("--disk", "--together"):
            assert sum(facts["degree_of_parts"]) == pytest.approx(facts["degree"], rel=1e-12)


def test_handles(capsys, tmp_path):
    surface = shapes.rings(2, cell=0.35)
    write_mesh(tmp_path / "pretzel.ply", surface.vertices, surface.faces)
    status, _, err = run(capsys, "map", tmp_path / "pretzel.ply", "-o", tmp_path / "m.npz")
    assert status == 1 and "--cut" in err
    status, _, err = run(capsys, "map", tmp_path / "pretzel.ply", "-o", tmp_path / "m.npz", "--cut", "--quiet")
    assert status == 0, err
    result = omtwarp.MapResult.load(tmp_path / "m.npz")
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
    assert omtwarp.MapResult.load(tmp_path / "m.npz").bijective
    status, _, err = run(capsys, "preview", tmp_path / "m.glb", "-o", tmp_path / "m.png", "--quiet")
    assert status == 0, err
    status, _, err = run(capsys, "map", tmp_path / "ring.ply", "-o", tmp_path / "m.ply", "--torus")
    assert status == 0, err
    status, _, err = run(capsys, "map", tmp_path / "ring.ply", "-o", tmp_path / "r.glb", "--torus", "--radius", "2")
    assert status == 1 and "--radius is for spheres as meshes, not for .glb: leave it out" in err
    ring = read_mesh(tmp_path / "m.ply")
    assert len(ring.faces) == len(omtwarp.MapResult.load(tmp_path / "m.npz").faces)
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
    "exact": ("open", "--fill-area", "natural", "--exact"),
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
    "transfer {painted} {mesh} --map-from {closed} --map-to {map} -o {out}.glb --size 32": NOT_THE_SPHERE,
    "transfer {own} {ball} --map-from {map} --map-to {closed} -o {out}.obj --size 32": NOT_THE_SPHERE,
    "texture {map} -o {out}.glb --size 64": {},
    "texture {map} -o {out}.obj --pattern checker --size 64": {},
    "texture {map} -o {out}.ply --size 64": {},
    "texture --map {map} -o {out}.glb --image {picture} --size 64": {},
    "texture {map} -o {out}.glb --pattern globe --size 64": {"torus": "the pattern 'globe' is for the sphere"},
    "texture {map} -o {out}.glb --bake ao --size 256": {},
    "texture {map} -o {out}.obj --pattern checker --bake normal --detail {mesh} --size 256": {},
    "unwrap --map {map} -o {out}.glb": {},
    "preview {map} -o {out}.png --size 48": {},
    "preview {map} -o {out}.gif --size 48 --frames 3 --image {picture}": {},
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
        painted = folder / ("painted.ply" if kind == "closed" else f"{kind}.ply")
        with pytest.raises(SystemExit) as ended:
            main(["texture", str(folder / f"{kind}.npz"), "-o", str(painted), "--size", "64", "--quiet"])
        assert not ended.value.code, kind
    picture = np.zeros((32, 64, 3), dtype=np.uint8)
    picture[::4] = picture[:, ::4] = (250, 120, 20)
    Image.fromarray(picture).save(folder / "picture.png")
    return folder


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_take_a_kind_of_map_or_say_why_not(capsys, maps, tmp_path, kind, command):
    """Each command takes each kind of map, or refuses it in one line and writes nothing."""
    told = COMMANDS[command].get(kind, "")
    words = {"map": maps / f"{kind}.npz", "mesh": maps / f"{KINDS[kind][0]}.ply", "closed": maps / "closed.npz"}
    words |= {"data": maps / f"{kind}.npy", "painted": maps / "painted.ply", "out": tmp_path / "out"}
    words |= {"own": maps / f"{kind}.ply", "ball": maps / "closed.ply", "picture": maps / "picture.png"}
    status, shown, err = run(capsys, *(word.format(**words) for word in command.split()))
    assert status == (1 if told else 0) and "Traceback" not in err, err
    if told:
        assert told in err and len(err.splitlines()) == 1, err
        assert not list(tmp_path.iterdir())
    else:
        assert shown
        result = omtwarp.MapResult.load(words["map"])
        for word in command.split():
            if word.startswith("{out}"):
                look_at(tmp_path / word.format(out="out"), command, result)
        if command.startswith("distance"):
            assert all(float(number) > 0.0 for number in re.findall(r"\d+\.\d+", shown)), shown


SPHERE_OF = "triangles do not cover the sphere once"
NO_SPHERE = "not a sphere about the origin"
# Of meshes that hold what the surface is mapped to, and of surfaces without a map.
MESHES = {
    "align {image} --surface {mesh} -o {out}.ply": {"disk": NO_SPHERE, "torus": NO_SPHERE},
    "align {closed} --to {image} --to-surface {mesh} -o {out}.ply": {"disk": NO_SPHERE, "torus": NO_SPHERE},
    "resample {image} --surface {mesh} --to ico2 -o {out}.ply --sphere {out}.off --matrix {out}.npz": {
        "disk": NO_SPHERE,
        "torus": NO_SPHERE,
    },
    "resample {image} --data {data} --to ico2 -o {out}.npy --method conservative": {
        "disk": NO_SPHERE,
        "torus": NO_SPHERE,
    },
    "spharm {mesh} -o {out}.csv --degree 3": dict.fromkeys(KINDS, "'omtwarp map' with --"),
    "distance {image} {closed}": dict.fromkeys(KINDS, "is not a map"),
    "group {manifest} -o {out} --grid ico1 --degree 3": NOT_THE_SPHERE,
    "transfer {ball} {mesh} -o {out}.glb --size 32": dict.fromkeys(KINDS, "'omtwarp map' with --"),
    "transfer {mesh} {ball} -o {out}.obj --size 32": dict.fromkeys(KINDS, "'omtwarp map' with --"),
}


@pytest.mark.parametrize("kind", ["hemisphere", "disk", "parts", "together", "torus"])
@pytest.mark.parametrize("command", MESHES)
def test_commands_refuse_meshes_that_do_not_cover_the_sphere(capsys, maps, tmp_path, kind, command):
    """In one line, before anything is mapped or written."""
    mesh, *options = KINDS[kind]
    if "{image}" in command and not (maps / f"{kind}_image.ply").exists():
        status, _, err = run(capsys, "map", maps / f"{mesh}.ply", "-o", maps / f"{kind}_image.ply", "-q", *options)
        assert status == 0, err
    whole, own = maps / "closed.npz", maps / f"{kind}.npz"
    (maps / "shapes.csv").write_text(f"path\n{whole}\n{own}\n", "utf-8")
    words = {"image": maps / f"{kind}_image.ply", "mesh": maps / f"{mesh}.ply", "closed": whole}
    words |= {"data": maps / f"{kind}.npy", "ball": maps / "painted.ply", "manifest": maps / "shapes.csv"}
    words |= {"out": tmp_path / "out"}
    status, shown, err = run(capsys, *(word.format(**words) for word in command.split()))
    assert (status, shown) == (1, "") and len(err.splitlines()) == 1, err
    assert MESHES[command].get(kind, SPHERE_OF) in err and not list(tmp_path.iterdir())


def look_at(file, command, result):
    """Read what a command wrote, and see that it is about the map, and not blank."""
    name, count = command.split()[0], len(result.faces)
    if file.suffix == ".npz" and name == "resample":
        matrix = sparse.load_npz(file)
        assert matrix.shape[0] == 162 and matrix.nnz > 162
    elif file.suffix == ".npz":
        turned = omtwarp.MapResult.load(file)
        assert turned.bijective and (len(turned.faces) == (320 if "align {closed}" in command else count))
    elif file.suffix == ".npy":
        values = np.load(file)
        assert len(values) == 162 and len(np.unique(values)) > 20
    elif file.suffix == ".csv":
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        assert len(table) == 16 and np.isfinite(table).all() and np.ptp(table[:, 2:]) > 0.1
    elif file.suffix == ".html":
        assert "one to one" in file.read_text("utf-8") and file.read_text("utf-8").count("<img") > 2
    elif file.suffix in (".png", ".gif"):
        with Image.open(file) as picture:
            frames = [np.asarray(frame.convert("RGB"), dtype=float) for frame in ImageSequence.Iterator(picture)]
        assert all(frame.std() > 10.0 for frame in frames)
        assert len(frames) == 1 or np.abs(frames[0] - frames[-1]).max() > 30.0
    elif file.is_dir():
        assert (
            len((file / "table.csv").read_text("utf-8").splitlines()) == 3 and (file / "mean.ply").stat().st_size > 500
        )
    elif name in ("texture", "transfer", "unwrap") and file.suffix != ".ply":
        mesh = omtwarp.read_painted_mesh(file)
        made = 320 if "{ball}" in command else count
        assert len(mesh.faces) >= made and mesh.uv is not None and np.ptp(mesh.uv[np.isfinite(mesh.uv)]) > 0.5
        material = mesh.materials[0]
        pictures = [p for p in (material.picture, material.normal_picture, material.occlusion_picture) if p is not None]
        assert name == "unwrap" or any(np.asarray(picture).std() > 2.0 for picture in pictures)
    else:
        mesh = read_mesh(file)
        assert len(mesh.faces) >= min(count, 320) and np.ptp(mesh.vertices, axis=0).min() > 0.1


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
    result = omtwarp.MapResult.load(maps / "natural.npz")
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


@pytest.mark.parametrize("kind", KINDS)
def test_the_mesh_of_a_map_is_checked_and_mapped_again(capsys, maps, tmp_path, kind):
    """Of a map's file that is given as a mesh its surface is read, without cuts, and the options for it are named."""
    status, out, _ = run(capsys, "check", maps / f"{kind}.npz")
    options = [line.split()[1].strip(":,") for line in out.splitlines() if line.startswith("  option ")]
    wanted = {"two": "--components", "ring": "--torus", "pretzel": "--cut", "open": "--hemisphere"}[KINDS[kind][0]]
    assert status == 1 and "only the mesh is read" in out and wanted in options
    status, _, err = run(capsys, "map", maps / f"{kind}.npz", "-o", tmp_path / "m.npz", "--quiet")
    assert status == 1 and wanted in err and not list(tmp_path.iterdir())


def test_cohorts_have_rows_for_surfaces_that_are_no_spheres(capsys, maps, tmp_path):
    """Each is mapped or has a record that says why not; a failure stops nothing."""
    names = ("closed", "open", "two", "ring")
    (tmp_path / "m.csv").write_text("path\n" + "".join(f"{maps / name}.ply\n" for name in names), "utf-8")
    words = ["cohort", tmp_path / "m.csv", "-o", tmp_path / "c", "--fill-area", "natural", "--json", "--no-optimality"]
    status, out, err = run(capsys, *words, "--workers", "2")
    assert status == 0 and json.loads(out)["counts"] == {"ok": 2, "error": 2}, err
    rows = {name: json.loads((tmp_path / "c" / "records" / f"{name}.json").read_text("utf-8")) for name in names}
    assert [rows[name]["status"] for name in names] == ["ok", "ok", "error", "error"]
    assert "--components" in rows["two"]["message"] and "--cut" in rows["ring"]["message"]


def test_refusals_name_the_part_and_the_option(capsys, maps, tmp_path):
    """What an option cannot do is one line, which names a part of several and what would map it."""
    both = [read_mesh(maps / f"{name}.ply") for name in ("closed", "ring")]
    vertices = np.concatenate([both[0].vertices, both[1].vertices + 9.0])
    mixed = tmp_path / "mixed.ply"
    write_mesh(mixed, vertices, np.concatenate([both[0].faces, both[1].faces + len(both[0].vertices)]))
    for words, told in (
        ((mixed, "--components"), "part 2 of 2, at face 320, has genus 1, closed: --cut would map it"),
        ((mixed, "--together"), "part 2 of 2, at face 320, has genus 1, closed: --cut would map it"),
        ((mixed, "--components", "--cut", "--hemisphere"), "part 1 of 2, at face 0, is closed, without a boundary"),
        ((mixed, "--torus"), "only one of genus 1, closed, maps to a torus: --components (with --cut) or --together"),
        ((maps / "ring.ply", "--fill-area", "small"), "has genus 1, closed: --torus or --cut would map it"),
        ((maps / "pretzel.ply", "--torus"), "the surface has genus 2, closed, and only one of genus 1"),
        ((maps / "pretzel.ply", "--torus", "--cut"), "--torus is for whole surfaces: leave --cut, --cut-along and"),
        ((maps / "pretzel.ply", "--torus", "--cut-along", "holes"), "--torus is for whole surfaces: leave --cut"),
        ((maps / "pretzel.ply", "--torus", "--fill-area", "small"), "--torus is for whole surfaces: leave --cut"),
        ((maps / "open.ply", "--torus"), "--hemisphere, --disk, --cap or --fill-area natural or small would map it"),
        ((maps / "closed.ply", "--cap"), "the surface is closed, without a boundary to put on the rim of a cap"),
    ):
        status, out, err = run(capsys, "map", *words, "-o", tmp_path / "m.npz")
        assert status == 1 and told in err and err.count("\n") == 1 and not out, err
        assert not (tmp_path / "m.npz").exists()
