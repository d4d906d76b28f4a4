"""Generated shapes are closed, of genus 0, outward, without triangles of zero area, and the same every time."""

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.validate import check

SHAPES = {
    "icosahedron": lambda: shapes.icosphere(1),
    "icosphere 5": lambda: shapes.icosphere(5),
    "icosphere 20": lambda: shapes.icosphere(20),
    "tetrahedron": lambda: shapes.fibonacci_sphere(4),
    "fibonacci": lambda: shapes.fibonacci_sphere(998),
    "random": lambda: shapes.random_sphere(1000, seed=3),
    "clustered": lambda: shapes.random_sphere(1000, seed=3, clustering=3.0),
    "uv": lambda: shapes.uv_sphere(12, 24),
    "uv slivers": lambda: shapes.uv_sphere(3, 200),
    "uv least": lambda: shapes.uv_sphere(1, 3),
    "ellipsoid": lambda: shapes.ellipsoid((3, 2, 1), 1000),
    "needle": lambda: shapes.needle(200.0, 1000),
    "plate": lambda: shapes.plate(face_count=1000),
    "blob": lambda: shapes.blob(seed=4, sphere=1000),
    "irregular blob": lambda: shapes.blob(seed=5, amplitude=0.6, degree=12, sphere=shapes.random_sphere(1000, seed=1)),
    "limbs": lambda: shapes.limbs(sphere=1000),
    "tube": lambda: shapes.tube(face_count=1000),
    "bent tube": lambda: shapes.tube(8.0, 1.0, bend=4.0, taper=0.3, face_count=1000),
    "creature": lambda: shapes.demo_shape(4000),
    "noisy": lambda: shapes.noisy(shapes.blob(sphere=1000), 0.3, seed=1),
    "flipped": lambda: shapes.flip_edges(shapes.blob(sphere=1000), rounds=20, seed=1),
    "shuffled": lambda: shapes.shuffled(shapes.blob(sphere=1000), seed=1),
}


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_sound_and_repeatable(name):
    """No defect is found, and a second call gives the same bits."""
    surface, again = SHAPES[name](), SHAPES[name]()
    assert [str(defect) for defect in check(surface.vertices, surface.faces)] == []
    assert surface.faces.shape == (2 * surface.vertex_count - 4, 3)
    np.testing.assert_array_equal(surface.vertices, again.vertices)
    np.testing.assert_array_equal(surface.faces, again.faces)


@pytest.mark.parametrize("frequency", [1, 2, 3, 7])
def test_icosphere_has_the_counts_and_symmetry_of_its_frequency(frequency):
    """20 n² faces, all points on the unit sphere, and a centroid that symmetry puts at the centre."""
    sphere = shapes.icosphere(frequency)
    assert (sphere.vertex_count, sphere.face_count) == (10 * frequency**2 + 2, 20 * frequency**2)
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(sphere.vertices.sum(axis=0), 0.0, atol=1e-12 * sphere.vertex_count)


@pytest.mark.parametrize("face_count", [4, 6, 8, 1000, 2022])
def test_fibonacci_sphere_has_exactly_the_faces_asked_for(face_count):
    assert shapes.fibonacci_sphere(face_count).face_count == face_count


def test_tube_has_the_area_of_a_capsule_bent_or_not():
    """Pappus: bending a tube of even girth about its axis keeps its area."""
    exact = np.pi * 1.0 * 6.0 + np.pi * 1.0**2
    for bend in (0.0, 2.0, -2.0):
        tube = shapes.tube(6.0, 1.0, bend=bend, face_count=20000)
        p = tube.vertices[tube.faces]
        area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum()
        assert area == pytest.approx(exact, rel=2e-3)


def test_tube_refuses_a_bend_that_would_cut_into_itself():
    with pytest.raises(ValueError, match="less than 2 radians"):
        shapes.tube(length=1.0, girth=1.0, bend=2.5)


def test_implicit_surface_of_a_sphere_lies_on_the_sphere():
    ball = shapes.implicit_surface(lambda x: np.linalg.norm(x, axis=1) - 1.0, [-1.3] * 3, [1.3] * 3, cell=0.2)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 1.0, atol=1e-6)
    assert check(ball.vertices, ball.faces) == []


def test_flipping_edges_keeps_the_vertices_and_lengthens_the_thinnest_triangle():
    blob = shapes.blob(sphere=1000)
    flipped = shapes.flip_edges(blob, rounds=20, seed=2)
    np.testing.assert_array_equal(flipped.vertices, blob.vertices)
    assert flipped.face_areas.min() < 0.5 * blob.face_areas.min()


def test_shuffling_keeps_the_surface():
    blob = shapes.blob(sphere=500)
    mixed = shapes.shuffled(blob, seed=9)
    np.testing.assert_allclose(np.sort(mixed.face_areas), np.sort(blob.face_areas), rtol=1e-12)


def test_a_creature_of_too_few_faces_is_refused():
    """A creature of so few faces that its limbs would merge into handles is refused."""
    with pytest.raises(OmtwarpError, match="ask for 2,000 or more"):
        shapes.demo_shape(320)


def radius(points):
    return 1.0 + 0.1 * points[:, 0]


ARGUMENTS = {
    "icosphere": {"frequency": 2},
    "icosphere_near": {"face_count": 80},
    "sphere_from_directions": {"directions": shapes.icosphere(1).vertices},
    "fibonacci_sphere": {"face_count": 40},
    "random_sphere": {"face_count": 40, "seed": 0, "clustering": 0.5},
    "uv_sphere": {"rings": 3, "segments": 4},
    "ellipsoid": {"axes": (1, 2, 3), "face_count": 80},
    "needle": {"length": 3, "face_count": 80},
    "plate": {"width": 1, "depth": 2, "thickness": 1, "face_count": 80},
    "star_shape": {"radius": radius, "sphere": 80},
    "blob": {"seed": 0, "amplitude": 0.2, "degree": 3, "sphere": 80},
    "limbs": {"directions": np.eye(3), "length": 1, "sharpness": 9, "sphere": 80},
    "tube": {"length": 6, "girth": 1, "bend": 0, "taper": 1, "face_count": 200},
    "hippocampus": {"seed": 0, "bump": 0, "width": 0.5, "variation": 0.1, "face_count": 200},
    "implicit_surface": {"value": lambda p: p @ p.T.mean(axis=1), "low": [-1] * 3, "high": [1] * 3, "cell": 0.5},
    "rings": {"count": 1, "tube": 0.5, "cell": 0.4},
    "metaballs": {"spheres": [[0, 0, 0, 1, 1, 0, 0, 1]], "blend": 0.1},
    "demo_shape": {"face_count": 2000},
    "noisy": {"surface": shapes.icosphere(2), "amount": 0.1, "seed": 0},
    "flip_edges": {"surface": shapes.icosphere(2), "rounds": 1, "seed": 0},
    "shuffled": {"surface": shapes.icosphere(2), "seed": 0},
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_of_no_use_are_one_line(name):
    """Text, complex numbers, NaN, lists of another length, and nothing, where nothing has no meaning."""
    for argument, default in ARGUMENTS[name].items():
        for wrong in ("many", 1j, np.nan, [1, 2], {}, *([] if argument in ("seed", "directions") else [None])):
            if argument == "seed" and wrong == [1, 2]:  # which NumPy takes
                continue
            with pytest.raises(OmtwarpError) as caught:
                getattr(shapes, name)(**(ARGUMENTS[name] | {argument: wrong}))
            assert "\n" not in str(caught.value), default


def test_arguments_out_of_range_are_refused():
    for made in (
        lambda: shapes.icosphere(0),
        lambda: shapes.uv_sphere(3, 2),
        lambda: shapes.blob(degree=0),
        lambda: shapes.blob(seed=-1),
        lambda: shapes.ellipsoid((1, 1, 0)),
        lambda: shapes.plate(thickness=-1),
        lambda: shapes.star_shape(lambda x: x[:, 0]),
        lambda: shapes.tube(length=0),
        lambda: shapes.hippocampus(bump=-1.0),
        lambda: shapes.implicit_surface(radius, [0] * 3, [0] * 3, 0.1),
        lambda: shapes.rings(cell=0),
        lambda: shapes.sphere_from_directions(np.eye(3)),
    ):
        with pytest.raises(OmtwarpError):
            made()
