"""Surfaces of labels in volumes: balls, tori and noise, written by nibabel."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from hypothesis import given, settings, strategies as some
from PIL import Image

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import triangle_areas
from omtwarp.mesh.validate import check
from omtwarp.mesh.volumes import ROUNDS, smoothed, surface_of
from omtwarp.mesh.write import write_mesh
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


def write_stack(path, labels, kind="uint8", **more):
    """Write a volume [X, Y, Z] as the pages of a TIFF."""
    first, *rest = (Image.fromarray(page) for page in labels.transpose(2, 1, 0).astype(kind))
    first.save(path, save_all=True, append_images=rest, **more)
    return path


@pytest.mark.parametrize(
    ("name", "kind", "packed"),
    [("a.tif", "uint8", "raw"), ("a.TIFF", "uint16", "tiff_lzw"), ("a.tif.gz", "int32", "raw"), ("a.tif", "f4", "raw")],
)
def test_a_stack_of_pages_is_read_as_the_volume_that_it_is(tmp_path, name, kind, packed):
    """Axes of right and down, the pages above each other; what nibabel reads of the same numbers is the same mesh."""
    labels = 3 * ball([10.0, 10.0, 10.0], 5.0) + 200 * ball([21.0, 20.0, 17.0], 6.0)
    path = write_stack(tmp_path / name.removesuffix(".gz"), labels, kind, compression=packed)
    if name.endswith(".gz"):
        (tmp_path / name).write_bytes(gzip.compress(path.read_bytes()))
    mesh, same = read_mesh(tmp_path / name), read_mesh(written(tmp_path / "a.nii", labels, np.eye(4)))
    np.testing.assert_array_equal(mesh.vertices, same.vertices)
    np.testing.assert_array_equal(mesh.faces, same.faces)
    assert mesh.notes == same.notes


def test_a_stack_of_imagej_has_the_sides_of_its_voxels(tmp_path):
    labels = ball([15.0, 14.0, 13.0], 8.0)
    about = {270: "ImageJ=1.53\nimages=28\nslices=28\nunit=micron\nspacing=2.5\n", 282: 4.0, 283: 2.0}
    mesh = read_mesh(write_stack(tmp_path / "a.tif", labels, tiffinfo=about))
    plain = read_mesh(write_stack(tmp_path / "b.tif", labels, tiffinfo={282: 72.0, 283: 72.0}))
    np.testing.assert_allclose(mesh.vertices, plain.vertices * [0.25, 0.5, 2.5], rtol=1e-6)


def test_the_amount_of_smoothing_is_chosen_and_said(tmp_path, capsys):
    """None leaves the voxels' stairs, more takes away more area; the command's output says how much."""
    labels = ball([15.0, 14.0, 13.0], 8.0)
    path, areas = write_stack(tmp_path / "a.tif", labels), []
    for rounds in (0, 5, 20, 60):
        mesh = read_mesh(path, smoothing=rounds)
        areas.append(triangle_areas(mesh.vertices, mesh.faces).sum())
        assert mesh.notes[1] == f"smoothed them by {rounds} rounds of Taubin's filter"
    assert areas == sorted(areas, reverse=True)
    for words, said in ([], "smoothed them by 20 rounds"), (["--smoothing", "1"], "smoothed them by 1 round of"):
        with pytest.raises(SystemExit) as ended:
            main(["map", str(path), "-o", str(tmp_path / "a.npz"), "--until", "conformal", *words])
        assert not ended.value.code and said in capsys.readouterr().err
    with pytest.raises(OmtwarpError, match="smoothing: must be a whole number from 0 to 1000, not -1"):
        read_mesh(path, smoothing=-1)
    write_mesh(tmp_path / "a.ply", *surface_of(labels))
    with pytest.raises(OmtwarpError, match="smoothing is for the surfaces of a volume's labels"):
        read_mesh(tmp_path / "a.ply", smoothing=3)


def test_pictures_that_hold_no_labels_are_one_line(tmp_path, monkeypatch):
    labels = ball([15.0, 14.0, 13.0], 8.0)
    whole = write_stack(tmp_path / "whole.tif", labels).read_bytes()
    color = Image.fromarray(np.zeros((4, 4, 3), np.uint8))
    color.save(tmp_path / "colour.tif", save_all=True, append_images=[color])
    Image.fromarray(labels[0].astype(np.uint8)).save(tmp_path / "page.tif")
    small, large = (Image.fromarray(np.ones((side, side), np.uint8)) for side in (4, 5))
    small.save(tmp_path / "sizes.tif", save_all=True, append_images=[large])
    small.save(tmp_path / "png.tif", format="png")
    (tmp_path / "cut.tif").write_bytes(whole[:600])
    (tmp_path / "damaged.tif").write_bytes(whole[:8] + bytes(100) + whole[108:])
    about = {270: "ImageJ=1.53\nimages=28\nchannels=2\n"}
    write_stack(tmp_path / "channels.tif", labels, tiffinfo=about)
    for name, words in (
        ("colour.tif", r"pages of colours \(RGB\), not of labels"),
        ("page.tif", "no volume of three dimensions"),
        ("sizes.tif", "page 1 is of another size than the first"),
        ("png.tif", "cannot be read as tif"),
        ("cut.tif", "cannot be read as tif"),
        ("damaged.tif", "."),
        ("channels.tif", "a volume of several channels"),
    ):
        with pytest.raises(OmtwarpError, match=words) as caught:
            read_mesh(tmp_path / name)
        assert "\n" not in str(caught.value)
    monkeypatch.setattr("omtwarp.files.inputs.MOST_TEXELS", 5 * 32 * 30)
    with pytest.raises(OmtwarpError, match="million voxels, which is the most"):
        read_mesh(tmp_path / "whole.tif")
