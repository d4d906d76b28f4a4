"""Surfaces of labels in volumes: balls, tori and noise, written by nibabel."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import triangle_areas
from omtwarp.mesh.validate import check
from omtwarp.mesh.volumes import ROUNDS, smoothed, surface_of
from omtwarp.topology.kind import MAPPABLE, parts_of

GRID = np.moveaxis(np.indices((32, 30, 28)), 0, -1).astype(float)


def ball(centre, radius):
    return ((GRID - centre) ** 2).sum(axis=-1) < radius**2


def enclosed(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


@pytest.mark.parametrize("radius", [5.0, 8.0, 11.0])
def test_the_surface_of_a_ball_is_a_sphere_of_its_size(radius):
    """Closed and seen from outside, of the voxels' volume before and after smoothing, and then of the ball's area."""
    inside = ball([15.0, 14.0, 13.0], radius)
    vertices, faces = surface_of(inside)
    assert check(vertices, faces) == []
    assert enclosed(vertices, faces) == pytest.approx(inside.sum(), rel=0.02)
    smooth = smoothed(vertices, faces, ROUNDS)
    assert check(smooth, faces) == []
    assert enclosed(smooth, faces) == pytest.approx(inside.sum(), rel=0.03)
    whole = (36.0 * np.pi * inside.sum() ** 2) ** (1.0 / 3.0)  # the area of a ball of that volume
    before, after = (triangle_areas(each, faces).sum() / whole for each in (vertices, smooth))
    assert 1.0 < after < 1.12 < 1.2 < before
    np.testing.assert_allclose(smooth.mean(axis=0), [15.0, 14.0, 13.0], atol=0.05)


def test_a_ring_has_a_handle_and_a_label_at_the_side_of_the_volume_is_closed():
    around = np.hypot(GRID[..., 0] - 15.0, GRID[..., 1] - 14.0)
    (part,) = parts_of(*surface_of((around - 9.0) ** 2 + (GRID[..., 2] - 13.0) ** 2 < 16.0))
    assert part.is_torus
    (part,) = parts_of(*surface_of(np.ones((3, 2, 4), dtype=bool)))
    assert part.is_sphere


@settings(max_examples=50, deadline=None)
@given(some.integers(0, 2**32 - 1), some.floats(0.02, 0.98))
def test_any_voxels_have_a_closed_surface(seed, share):
    """Nothing but several parts and handles is wrong with it, and it encloses what is inside and a half around it."""
    inside = np.random.default_rng(seed).random((7, 6, 5)) < share
    if inside.any():
        vertices, faces = surface_of(inside)
        assert {defect.kind for defect in check(vertices, faces)} <= set(MAPPABLE) - {"open-boundary"}
        assert enclosed(vertices, faces) > 0.0


def written(path, labels, affine):
    nibabel = pytest.importorskip("nibabel")
    kinds = {".nii": nibabel.Nifti1Image, ".nii.gz": nibabel.Nifti2Image}
    kind = next((made for end, made in kinds.items() if path.name.endswith(end)), nibabel.freesurfer.MGHImage)
    nibabel.save(kind(labels.astype(np.int16), affine), path)
    return path


@pytest.mark.parametrize("name", ["aseg.nii", "aseg.nii.gz", "aseg.mgz", "aseg.mgh"])
def test_every_label_of_a_volume_is_a_part_in_millimetres(tmp_path, name):
    """Where the axes of the volume are left-handed too."""
    labels = 17 * ball([10.0, 10.0, 10.0], 5.0) + 53 * ball([21.0, 20.0, 17.0], 6.0)
    affine = np.array([[-2.0, 0, 0, 40.0], [0, 0, 2.0, -7.0], [0, -2.0, 0, 5.0], [0, 0, 0, 1.0]])
    affine[0, 0] *= -1 if name.endswith("gz") else 1
    mesh = read_mesh(written(tmp_path / name, labels, affine))
    assert mesh.notes == (
        "took the surfaces of 2 labels (17, 53) together",
        f"smoothed them by {ROUNDS} rounds of Taubin's filter",
    )
    first, second = parts_of(mesh.vertices, mesh.faces)
    for part, label, centre in ((first, 17, [10.0, 10.0, 10.0]), (second, 53, [21.0, 20.0, 17.0])):
        np.testing.assert_allclose(part.vertices.mean(axis=0), (affine @ [*centre, 1.0])[:3], atol=0.1)
        assert enclosed(part.vertices, part.faces) == pytest.approx(8.0 * (labels == label).sum(), rel=0.03)
    result = omtwarp.map_surface((mesh.vertices, mesh.faces), until="moser", device="cpu")
    assert result.bijective


def test_volumes_that_hold_no_labels_are_one_line(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    grey = np.random.default_rng(0).normal(size=(8, 8, 8)).astype(np.float32)
    for name, numbers, words in (
        ("grey.nii", grey, "grey values, not of labels"),
        ("many.nii", np.arange(2000.0).reshape(10, 10, 20), "grey values, not of labels"),
        ("none.nii", np.zeros((4, 4, 4)), "without a label"),
        ("series.nii", np.ones((4, 4, 4, 3)), "no volume of three dimensions: 4 x 4 x 4 x 3"),
        ("flat.nii", np.ones((4, 4, 1)), "no volume of three dimensions"),
    ):
        nibabel.save(nibabel.Nifti1Image(numbers, np.eye(4)), tmp_path / name)
        with pytest.raises(OmtwarpError, match=words):
            read_mesh(tmp_path / name)
    whole = (tmp_path / "none.nii").read_bytes()
    for name, content in (("cut.nii", whole[:400]), ("cut.nii.gz", gzip.compress(whole[:100])), ("no.mgz", b"content")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(OmtwarpError) as caught:
            read_mesh(tmp_path / name)
        assert "\n" not in str(caught.value)
