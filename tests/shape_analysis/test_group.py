"""Groups and distances of shapes against closed forms, and a bump that is known to be there."""

import csv
import json
import os
import sys
import time

import numpy as np
import pytest
from sphere_truths import pushed_north, random_rotation
from trimesh.exchange.ply import load_ply

import omtwarp
from omtwarp.cohort.tables import write_table
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.measures import TargetDensity
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.shapes import hippocampus, icosphere
from omtwarp.mesh.surface import vertex_normals
from omtwarp.shape_analysis import distance
from omtwarp.shape_analysis.distance import coefficient_distance, density_distance, shape_distance
from omtwarp.shape_analysis.group import linear_effects, principal_components, study_group
from omtwarp.spheres import named_grid

SPHERE = icosphere(8)
NAMES = "group_size", "group_t", "group_p", "group_fdr"


def mapped(surface: omtwarp.Surface, until: str = "moser") -> omtwarp.MapResult:
    return omtwarp.map_to_sphere(surface, until=until, device="cpu")


@pytest.fixture(scope="module")
def pair() -> list[omtwarp.MapResult]:
    return [mapped(hippocampus(seed, face_count=800 + 60 * seed)) for seed in (1, 2)]


def test_made_shapes_are_sound_and_differ_by_the_bump_alone():
    plain, swollen = (hippocampus(4, bump, width=0.3) for bump in (0.0, 0.5))
    for one in (plain, swollen):
        assert not omtwarp.check(one.vertices, one.faces)
    assert np.array_equal(plain.faces, swollen.faces)
    moved = np.linalg.norm(swollen.vertices - plain.vertices, axis=1)
    places = plain.vertices[moved > 0.5 * moved.max()]
    assert (places[:, 1] > 0).all()  # at 90 degrees around the centre line, which lies in y = 0
    assert np.median(moved) < 1e-3 * moved.max()
    assert np.array_equal(hippocampus(4).vertices, hippocampus(4).vertices)
    assert not np.array_equal(hippocampus(4).vertices, hippocampus(5).vertices)
    with pytest.raises(ValueError, match="variation"):
        hippocampus(variation=0.5)


def test_the_bump_is_found_at_its_place():
    """Sixteen shapes on different meshes, half of them with the bump.

    ``OMTWARP_SHAPES=100 pytest -s -k bump_is_found tests/shape_analysis`` takes as many, and prints its CPU time.
    """
    count, bump, begun = int(os.environ.get("OMTWARP_SHAPES", "16")), 0.5, time.process_time()
    known = {"width": 0.4, "variation": 0.05}
    shapes = [hippocampus(s, bump * (s % 2), face_count=700 + 14 * (s % 5), **known) for s in range(count)]
    maps = [mapped(one) for one in shapes]
    mapping = time.process_time() - begun
    study = study_group(maps, ["control", "patient"] * (count // 2), grid="ico3", degree=8, device="cpu")
    found = study.effects["group"]
    print(f"{count} shapes: {mapping:.1f} CPU s of maps, {time.process_time() - begun - mapping:.1f} of statistics")
    plain, swollen = (hippocampus(0, b, face_count=700, **known).vertices for b in (0.0, bump))
    truth = np.argmax(np.linalg.norm(swollen - plain, axis=1))
    place = maps[0].sphere[truth] @ study.alignment.rotations[0].T
    nearest = np.argmax(named_grid("ico3").points @ place)
    peak = np.argmax(found.statistic)
    middle = study.alignment.mean
    off = np.linalg.norm(middle[peak] - middle[nearest])
    print(
        f"largest t {found.statistic[peak]:.1f}, {off:.2f} from the bump's middle, p {found.p_values[nearest]:g} there"
    )
    assert off < known["width"]
    assert found.p_values[nearest] <= 0.01
    assert found.statistic.max() > 3 * -found.statistic.min()  # a bump, and no dent elsewhere
    assert found.p_values.min() <= 0.01
    assert found.levels == ("control", "patient")
    assert found.size[peak] > 0.05
    # Nobody is told apart by labels that have nothing to do with the shapes.
    labels = ["ab"[k % 4 < 2] for k in range(count)]
    heights = np.einsum("nvd,vd->nv", study.alignment.surfaces, vertex_normals(middle, study.alignment.faces))
    assert linear_effects(heights, {"group": labels})["group"].p_values.min() > 0.05


def test_components_of_shapes_that_vary_in_two_directions():
    rng = np.random.default_rng(2)
    shares = SPHERE.vertex_areas / SPHERE.vertex_areas.sum()
    ways = np.stack([SPHERE.vertices * [1, 0, 0], SPHERE.vertices * [0, 1, 0]]) * np.sqrt(3.0)  # root mean square 1
    factors = rng.normal(size=(10, 2)) * [0.3, 0.1]
    factors -= factors.mean(axis=0)
    found = principal_components(np.einsum("nk,kvd->nvd", factors, ways), shares, 5)
    wanted = np.sqrt(np.linalg.eigvalsh(np.cov(factors.T))[::-1])
    np.testing.assert_allclose(found.deviations, [*wanted, 0, 0, 0], rtol=1e-3, atol=1e-9)
    assert found.explained[:2].sum() == pytest.approx(1.0)
    np.testing.assert_allclose(found.scores.std(axis=0, ddof=1)[:2], 1.0, rtol=1e-6)


def test_mean_of_two_ellipsoids():
    """Spheres stretched along the same axes: with correspondence by radius, their mean lies between them."""
    axes = np.array([[1.0, 0.7, 0.5], [1.2, 0.8, 0.6]])
    maps = [mapped(omtwarp.Surface(SPHERE.vertices * one, SPHERE.faces)) for one in axes]
    study = study_group(maps, grid="ico3", degree=6, device="cpu")
    middle = study.alignment.mean
    _, frame = np.linalg.eigh(middle.T @ middle)
    np.testing.assert_allclose(np.abs(middle @ frame[:, ::-1]).max(axis=0), axes.mean(axis=0), atol=0.03)
    for sign in (-1, 1):  # two shapes lie on the line through them
        ends = study.along(0, sign / np.sqrt(2)).vertices
        assert min(np.abs(ends - one).max() for one in study.alignment.surfaces) < 1e-9
    assert (vertex_normals(middle, study.alignment.faces) * middle).sum(axis=1).min() > 0


def test_distance_is_none_to_itself_and_to_a_turned_copy_and_symmetric(pair):
    one = pair[0]
    surface = omtwarp.Surface(one.vertices @ random_rotation(5).T + [3.0, 1.0, 0.0], one.faces)
    same, turned = (shape_distance(one, b, degree=8, device="cpu") for b in (one, mapped(surface)))
    there, back = (shape_distance(*ends, degree=8, device="cpu") for ends in (pair, pair[::-1]))
    assert same.coefficients < 1e-6
    assert turned.coefficients < 0.02 * there.coefficients
    assert max(same.there, same.back) < 1e-12  # the same densities, to rounding
    assert max(turned.there, turned.back) < 1e-9
    assert there.coefficients == pytest.approx(back.coefficients, rel=1e-4)
    assert there.transport == pytest.approx(back.transport, rel=1e-2)
    assert there.there == pytest.approx(there.back, rel=0.5)


def test_a_group_has_the_transport_distances_of_its_pairs(pair):
    maps, told = [*pair, pair[0]], []
    study = study_group(
        maps, grid="ico2", degree=6, transport=True, device="cpu", progress=lambda *what: told.append(what)
    )
    apart = shape_distance(*pair, degree=6, device="cpu")
    assert study.transport[0, 1] == pytest.approx(apart.transport, rel=1e-2)
    assert study.transport[1, 2] == study.transport[0, 1]
    assert study.transport[0, 2] < 1e-12 < apart.transport  # of a shape to itself
    assert np.array_equal(study.transport, study.transport.T)
    assert told[-1] == ("transport", 3, 3, {})
    assert study_group(pair, grid="ico2", degree=6, device="cpu").transport is None


def test_coefficient_distance_of_ellipsoids_is_that_of_their_axes():
    """x = a X: the root of Σ (a - b)² / 3, whatever rotation is between them."""
    from omtwarp.shape_analysis.expansion import expand

    a, b = np.array([3.0, 2.0, 1.0]), np.array([3.2, 1.9, 1.3])
    one, other = (expand(SPHERE.vertices, SPHERE.vertices * axes, 4).coefficients[1:] for axes in (a, b))
    wanted = np.sqrt(((a - b) ** 2).sum() / 3)
    assert coefficient_distance(one, other @ random_rotation(2)) == pytest.approx(wanted, rel=1e-9)


def test_transport_distance_to_a_known_density():
    """From the uniform sphere to 1 / (1 - a z): the optimal map moves along meridians, in closed form."""
    amount, sphere = 0.5, icosphere(16)
    # The image of z is z + a (1 - z²) / 2; the density of the image at w is dz / dw.
    target = TargetDensity(lambda y: 1.0 / np.sqrt(1.0 + amount**2 - 2.0 * amount * y[:, 2]))
    found = density_distance(sphere, sphere.vertices, target, device="cpu")
    moved = np.arccos(np.clip((pushed_north(sphere.vertices, amount) * sphere.vertices).sum(axis=1), -1, 1))
    wanted = np.sqrt(sphere.vertex_areas @ moved**2 / sphere.vertex_areas.sum())
    assert found == pytest.approx(wanted, rel=0.02)


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return ended.value.code or 0


def read_elsewhere(folder):
    """Compare VTK, by its own rules, and GIFTI, by nibabel, with the PLY that trimesh reads."""
    with open(folder / "mean.ply", "rb") as stream:
        wanted = load_ply(stream)["metadata"]["_ply_raw"]["vertex"]["data"]
    places = np.column_stack([wanted[name] for name in "xyz"])
    content = (folder / "mean.vtk").read_bytes()
    points = np.frombuffer(content, ">f8", places.size, content.index(b" double\n") + len(b" double\n"))
    np.testing.assert_array_equal(points.reshape(-1, 3), places)
    at = content.index(f"POINT_DATA {len(places)}\nFIELD FieldData 4\n".encode())
    for name in NAMES:
        head = f"{name} 1 {len(places)} double\n".encode()
        at = content.index(head, at) + len(head)
        np.testing.assert_array_equal(np.frombuffer(content, ">f8", len(places), at), wanted[name])
    assert content[at + 8 * len(places) :] == b"\n"
    np.testing.assert_array_equal(
        read_mesh(folder / "component_1_plus.vtk").faces, read_mesh(folder / "mean.vtk").faces
    )
    nibabel = pytest.importorskip("nibabel")
    surface, data = (nibabel.load(folder / f"mean.{kind}.gii") for kind in ("surf", "shape"))
    np.testing.assert_allclose(surface.agg_data("pointset"), places, atol=1e-6 * np.abs(places).max())
    assert [array.meta["Name"] for array in data.darrays] == list(NAMES)
    np.testing.assert_allclose(data.darrays[2].data, wanted["group_p"], rtol=1e-6)


def test_commands_write_what_they_say(tmp_path, monkeypatch, capsys, pair, small_pictures):
    monkeypatch.chdir(tmp_path)
    rows = ["path,group"]
    for k in range(6):
        pair[k % 2].save(f"m{k}.npz")
        rows.append(f"m{k}.npz,{'ab'[k % 2]}")
    (tmp_path / "subjects.csv").write_text("\n".join(rows))
    options = ["--grid", "ico2", "--degree", "6", "--components", "1", "--permutations", "20"]
    assert run("group", "m0.npz", "m1.npz", "-o", "two", *options, "--transport", "--json") == 0
    assert "transport.csv" in json.loads(capsys.readouterr().out)["files"]
    apart = list(csv.DictReader((tmp_path / "two" / "transport.csv").open()))
    assert run("group", "subjects.csv", "-o", "study", *options, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["shapes"] == 6
    assert told["explained"][0] == pytest.approx(1.0, abs=1e-6)  # two different shapes
    written = {file.name for file in (tmp_path / "study").iterdir()} - {".omtwarp.json"}
    assert written == set(told["files"])
    table = list(csv.DictReader((tmp_path / "study" / "table.csv").open()))
    assert [row["group"] for row in table] == list("ababab")
    assert float(table[0]["score_1"]) == pytest.approx(-float(table[1]["score_1"]))
    page = (tmp_path / "study" / "report.html").read_text()
    assert page.count("<img") == 2 + 6 + 2
    assert "Where a and b differ" in page
    first = (tmp_path / "study" / "mean.ply").read_bytes()
    assert run("group", *(f"m{k}.npz" for k in range(6)), "-o", "again", *options, "-q") == 0
    assert capsys.readouterr().out == ""
    assert run("group", "subjects.csv", "-o", "study", *options, "-q") == 0
    assert (tmp_path / "study" / "mean.ply").read_bytes() == first
    read_elsewhere(tmp_path / "study")
    assert run("distance", "m0.npz", "m1.npz", "--degree", "6", "--json") == 0
    between = json.loads(capsys.readouterr().out)
    assert between["coefficients"] > 0.01
    assert float(apart[0]["m1"]) == pytest.approx(between["transport"])


@pytest.mark.parametrize("parquet", [True, False], ids=["parquet", "csv"])
def test_group_reads_what_a_cohort_wrote(tmp_path, monkeypatch, capsys, pair, small_pictures, parquet):
    monkeypatch.chdir(tmp_path)
    if parquet:
        pytest.importorskip("pyarrow.parquet")
    else:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "done" / "maps").mkdir(parents=True)
    rows = []
    for k in range(6):
        pair[k % 2].save(f"done/maps/s{k}.npz")
        rows.append({"id": f"s{k}", "path": f"elsewhere/s{k}.ply", "status": "ok", "group": "ab"[k % 2]})
        rows[-1] |= {"age": str(50 + k * k), "site": "north" if k < 3 else "south"}
    failed = {"id": "s4", "path": "elsewhere/s4.ply", "status": "error", "group": "a"}
    table = write_table([*rows, failed], tmp_path / "done")
    assert table.suffix == (".parquet" if parquet else ".csv")
    options = ["--grid", "ico2", "--degree", "3", "--components", "1", "--permutations", "20", "--json"]
    for source in ("done", str(table.relative_to(tmp_path))):
        assert run("group", source, "-o", "study", *options) == 0
        assert json.loads(capsys.readouterr().out)["shapes"] == 6
    listed = list(csv.DictReader((tmp_path / "study" / "table.csv").open()))
    assert [(row["id"], row["group"]) for row in listed] == [(row["id"], row["group"]) for row in rows]
    assert run("group", "done", "-o", "more", *options, "--covariate", "age", "--covariate", "site") == 0
    told = json.loads(capsys.readouterr().out)
    assert set(told["smallest_p"]) == {"group", "age", "site"}
    listed = list(csv.DictReader((tmp_path / "more" / "table.csv").open()))
    assert [(row["age"], row["site"]) for row in listed] == [(row["age"], row["site"]) for row in rows]
    assert "What goes with age" in (tmp_path / "more" / "report.html").read_text()
    assert run("group", "done", "-o", "none", *options, "--covariate", "wing") == 1
    assert "no column 'wing'" in capsys.readouterr().err
    table.write_bytes(b"PAR1\ntorn")
    assert run("group", str(table), "-o", "study", *options) != 0
    assert "cannot be read as a cohort's table" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["group", "a.npz", "-o", "out"], "at least two"),
        (["group", "one.csv", "-o", "out"], "explains no difference"),
        (["group", "few.csv", "-o", "out"], "too few shapes"),
        (["group", "a.npz", "none.npz", "-o", "out"], "none.npz"),
        (["group", "a.npz", "b.npz", "-o", "out", "--degree", "60"], "do not determine"),
        (["group", "a.npz", "b.npz", "-o", "out", "--grid", "ico99"], "ico99"),
        (["distance", "a.npz", "one.csv"], "one.csv"),
        (["distance", "a.npz", "b.npz", "--degree", "60"], "do not determine"),
    ],
)
def test_requests_that_cannot_be_met(tmp_path, monkeypatch, capsys, pair, words, message):
    monkeypatch.chdir(tmp_path)
    for name, one in zip("ab", pair, strict=True):
        one.save(f"{name}.npz")
    (tmp_path / "one.csv").write_text("path,group\na.npz,x\nb.npz,x\n")
    (tmp_path / "few.csv").write_text("path,group\na.npz,x\nb.npz,y\n")
    assert run(*words) == 1
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_transport_distance_of_coarse_shapes_is_near_that_between_their_vertices(monkeypatch):
    """Independently, by POT; of these two one way's flow ends far from the optimum."""
    ot = pytest.importorskip("ot")
    shapes = [hippocampus(seed, bump=bump, variation=0.05, face_count=900) for seed, bump in ((5, 0.0), (6, 0.5))]
    maps = [omtwarp.map_to_sphere(shape, device="cpu", optimality=False) for shape in shapes]
    turns = []

    def noted(*arguments, **options):
        turns.append(omtwarp.align(*arguments, **options))
        return turns[-1]

    monkeypatch.setattr(distance, "align", noted)
    found = shape_distance(*maps, device="cpu")
    angles = np.arccos(np.clip(maps[0].conformal @ turns[1].rotation.T @ maps[1].conformal.T, -1.0, 1.0))
    masses = [omtwarp.Surface(one.vertices, one.faces).vertex_areas / (4.0 * np.pi) for one in maps]
    best = np.sqrt(ot.emd2(*masses, angles**2, numItermax=10_000_000))
    assert found.transport == min(found.there, found.back) == pytest.approx(best, rel=0.2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"maps": 3}, "maps: must be a list"),
        ({"labels": 3}, "column 'group': must be a list of values"),
        ({"covariates": [1, 2]}, "covariates: must be a dictionary"),
        ({"labels": ["a", "b"], "covariates": {"group": [1, 2]}}, "'group' is the column of groups already"),
    ],
)
def test_groups_that_are_no_lists_are_one_line(given, words):
    with pytest.raises(OmtwarpError, match=words):
        study_group(**{"maps": [], **given})
