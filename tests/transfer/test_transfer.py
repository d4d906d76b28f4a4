"""Texture transfer: on the same shape with other triangles, a texture comes back."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.texturing import PaintedMesh, paint, unwrap_uv
from omtwarp.texturing.patterns.checker import Checker
from omtwarp.transfer import transfer_texture

AXES = np.array([1.0, 0.7, 1.3])


def turn(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def pear(directions):
    """Return points of a star-shaped surface without symmetries over unit vectors."""
    x, y, z = directions.T
    return directions * AXES * (1.0 + 0.25 * z * x + 0.2 * y + 0.15 * x * x * y)[:, None]


def meshed(subdivisions, seed):
    """Triangulate the shape in one of many ways; return (vertices, faces, sphere) of its exact map."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions = np.asarray(ball.vertices) @ turn(seed)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return pear(directions), np.asarray(ball.faces, dtype=np.int32), directions


CHECKER = Checker(10, 5)


@pytest.fixture(scope="module")
def painted():
    """The shape with a checker in texture coordinates of its own, and its map."""
    result = meshed(4, 1)
    return paint(result, unwrap_uv(result), pattern=CHECKER, size=768), result


def wrong_places(made, sphere_of):
    """Return the share of random places whose colour is not the checker's there."""
    weights = np.random.default_rng(0).dirichlet((2, 2, 2), len(made.faces))
    uv = np.einsum("fk,fkj->fj", weights, made.uv)
    directions = sphere_of(np.einsum("fk,fkj->fj", weights, made.vertices[made.faces]))
    picture = made.materials[0].picture
    height, width = picture.shape[:2]
    row, column = ((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * width).astype(int)
    return (np.abs(picture[row, column, :3] - 255 * CHECKER(directions)).max(axis=1) > 60).mean()


def back_to_the_sphere(points):
    """Directions whose points on the shape these are, by fixed-point iteration."""
    directions = points / AXES
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions  # the shape is star-shaped: its factor along a direction is a number


@pytest.mark.parametrize("onto_own", [False, True])
def test_a_texture_comes_back_on_other_triangles(painted, onto_own):
    """A transferred texture differs only next to the borders of fields, as much as before the transfer."""
    mesh, result = painted
    other = meshed(4, 2)
    before = wrong_places(mesh, back_to_the_sphere)
    onto = unwrap_uv(other) if onto_own else None
    made = transfer_texture(mesh, result, other, onto=onto, aligned=True, size=768)
    assert before < 0.05
    assert wrong_places(made, back_to_the_sphere) < before + 0.02
    if onto_own:
        np.testing.assert_array_equal(made.uv, onto.uv)


@pytest.mark.parametrize("uv", ["own", "atlas"])
def test_the_mesh_that_gets_the_texture_keeps_its_names_of_objects(painted, uv):
    """Each triangle, cut or not, is in the object that the ray from the middle to it goes through."""
    mesh, result = painted
    vertices, faces, sphere = meshed(2, 2)
    above = (vertices[faces].mean(axis=1)[:, 2] > 0).astype(int)
    onto = replace(unwrap_uv((vertices, faces, sphere)), objects=(("low", ""), ("high", "cap")), face_object=above)
    made = transfer_texture(mesh, result, (vertices, faces, sphere), onto=onto, uv=uv, aligned=True, size=96)
    assert made.objects == onto.objects
    middle = made.vertices[made.faces].mean(axis=1)
    shares = np.einsum("fij,pj->pfi", np.linalg.inv(vertices[faces].transpose(0, 2, 1)), middle)
    np.testing.assert_array_equal(made.face_object, above[shares.min(axis=2).argmax(axis=1)])
    with pytest.raises(OmtwarpError, match="unknown texture coordinates 'new'"):
        transfer_texture(mesh, result, result, onto=mesh, uv="new")


def test_maps_in_different_positions_are_aligned_first(painted):
    """The other map's sphere is turned at random: features of the two shapes turn it back."""
    mesh, result = painted
    vertices, faces, sphere = meshed(4, 2)
    other = (vertices, faces, sphere @ turn(9))
    found = wrong_places(transfer_texture(mesh, result, other, size=768), back_to_the_sphere)
    lost = wrong_places(transfer_texture(mesh, result, other, aligned=True, size=768), back_to_the_sphere)
    assert found < 0.08 and lost > 0.3


def test_colours_at_vertices_are_carried_too():
    result, other = meshed(4, 1), meshed(3, 2)
    colors = np.column_stack([np.rint(127.5 * (result[2] + 1)), np.full(len(result[2]), 255)]).astype(np.uint8)
    mesh = PaintedMesh(result[0], result[1], vertex_colors=colors)
    made = transfer_texture(mesh, result, other, aligned=True, size=384)
    uv = made.uv.mean(axis=1)
    picture = made.materials[0].picture
    row, column = ((1 - uv[:, 1]) * len(picture)).astype(int), (uv[:, 0] * picture.shape[1]).astype(int)
    there = back_to_the_sphere(made.vertices[made.faces].mean(axis=1))
    assert np.abs(picture[row, column] / 127.5 - 1 - there).max() < 0.06


def test_without_colours_there_is_nothing_to_carry():
    result = meshed(2, 1)
    with pytest.raises(OmtwarpError, match="nothing to transfer"):
        transfer_texture(PaintedMesh(result[0], result[1]), result, result)
    mesh = paint(result, unwrap_uv(result), pattern="checker", size=64)
    with pytest.raises(OmtwarpError, match="another mesh"):
        transfer_texture(mesh, (result[0] + 1, *result[1:]), result)


def test_between_two_balls_colours_stay_where_they_are_in_space():
    """Balls have no features to align by: a warning says what was done, and no colour moves."""
    one, other = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.icosphere(subdivisions=4)
    points, places = np.asarray(one.vertices), np.asarray(other.vertices)
    turn = trimesh.transformations.rotation_matrix(1.0, (1.0, 2.0, 0.5))[:3, :3]
    colors = np.column_stack([np.where(points > 0.0, 255, 0), np.full(len(points), 255)]).astype(np.uint8)
    mesh = PaintedMesh(points, np.asarray(one.faces), vertex_colors=colors)
    with pytest.warns(OmtwarpWarning, match="keep their directions in space"):
        made = transfer_texture(
            mesh, (points, one.faces, points @ turn), (places, other.faces, places), size=192, device="cpu"
        )
    middle = made.vertices[made.faces].mean(axis=1)
    height, width = made.materials[0].picture.shape[:2]
    uv = made.uv.mean(axis=1)
    shown = made.materials[0].picture[((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * width).astype(int), :3]
    clear = np.abs(middle).min(axis=1) > 0.15
    assert clear.sum() > 1000
    np.testing.assert_array_equal(shown[clear] > 127, middle[clear] > 0.0)
