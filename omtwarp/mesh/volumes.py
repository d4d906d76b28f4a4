"""Surfaces of the labels of a volume, as segmentations hold them: NIfTI and FreeSurfer's MGH, and stacks in TIFF.

Every cell of eight neighbouring voxels is cut into six tetrahedra along its diagonal, and each tetrahedron with corners
in the label and outside by the triangle or the quadrilateral through the middles of its edges [1]_. The tetrahedra of
neighbouring cells meet in the same triangles, so that every surface is closed and a manifold, whatever the voxels.

.. [1] A. Doi, A. Koide, "An efficient method of triangulating equi-valued surfaces by using tetrahedral cells",
   IEICE Trans. Inf. Syst. E74 (1991).
"""

import io

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import read_stack
from omtwarp.mesh.arrays import Floats, Indices
from omtwarp.mesh.neuro import nibabel_module
from omtwarp.mesh.polygons import taken_together
from omtwarp.mesh.shapes import crossed_edges

VOLUMES = ("nii", "mgh", "mgz", "tif", "tiff")  # suffixes
# Of smoothing: the area of a ball of 8 voxels goes from 1.30 to 1.07 times that of the sphere, its volume from 1.010 to
# 1.014.
ROUNDS = 20
MOST_ROUNDS = 1000  # a wave of 100 edges is gone by then


def label_surfaces(data: bytes, suffix: str, rounds: int = ROUNDS) -> tuple[Floats, Indices, list[str]]:
    """Extract and smooth the surface of every label of a volume, in the volume's own space.

    Args:
        data: the file.
        suffix: one of :data:`VOLUMES`.
        rounds: of smoothing.

    Returns:
        Vertices [V, 3] in the volume's units (millimetres, of a stack the unit of its voxels' sides) and faces [F, 3],
        those of a label together, in the order of the labels, and what was done in words.

    Raises:
        OmtwarpError: no volume of three dimensions, numbers that are not labels, or no label but 0.
        Exception: what nibabel or Pillow raises on a damaged file.
    """
    # Labels of a volume: more are grey values
    most_labels = 1000
    volume, affine = _volume(data, suffix)
    labels = np.unique(volume)
    if not np.isfinite(labels).all() or (labels != np.floor(labels)).any() or len(labels) > most_labels:
        raise OmtwarpError("a volume of grey values, not of labels: segment it first, and save the labels")
    labels = labels[labels != 0]
    if not len(labels):
        raise OmtwarpError("a volume without a label: all of it is 0")
    surfaces = [surface_of(volume == label) for label in labels]
    placed = [(smoothed(*one, rounds) @ affine[:3, :3].T + affine[:3, 3], one[1]) for one in surfaces]
    vertices, corners = taken_together(placed)
    corners = corners[:, ::-1] if np.linalg.det(affine[:3, :3]) < 0.0 else corners
    shown = ", ".join(f"{label:.0f}" for label in labels[:8]) + (", ..." if len(labels) > 8 else "")
    notes = [f"took the surfaces of {len(labels)} label{'s' * (len(labels) > 1)} ({shown}) together"]
    notes += [f"smoothed them by {rounds} round{'s' * (rounds != 1)} of Taubin's filter"]
    return vertices, corners, notes


def _volume(data: bytes, suffix: str) -> tuple[NDArray[np.generic], Floats]:
    """Return the numbers of a volume, shape [X, Y, Z], and the matrix from voxels to the volume's space, [4, 4]."""
    if suffix in ("tif", "tiff"):
        stack, sides = read_stack(io.BytesIO(data))
        if min(stack.shape) < 2:
            raise OmtwarpError(f"no volume of three dimensions: {' x '.join(map(str, stack.shape))} numbers")
        return stack, np.diag([*sides, 1.0])
    nibabel = nibabel_module()
    if suffix == "nii":
        second = int.from_bytes(data[:4], "little") in (540, int.from_bytes((540).to_bytes(4, "big"), "little"))
        image = (nibabel.Nifti2Image if second else nibabel.Nifti1Image).from_bytes(data)
    else:
        image = nibabel.freesurfer.MGHImage.from_bytes(data)
    shape = image.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3 or min(shape) < 2:
        raise OmtwarpError(f"no volume of three dimensions: {' x '.join(map(str, image.shape))} numbers")
    return np.asanyarray(image.dataobj).reshape(shape), np.asarray(image.affine, dtype=np.float64)


def surface_of(inside: NDArray[np.bool_]) -> tuple[Floats, Indices]:
    """Return the surface between voxels inside and outside, closed at the sides of the volume too.

    Args:
        inside: shape [X, Y, Z], with a voxel inside.

    Returns:
        Vertices in voxels, shape [V, 3], and faces seen from outside, shape [F, 3].
    """
    used = [np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    box = np.pad(inside[tuple(slice(own[0], own[-1] + 1) for own in used)], 1)
    edges, faces = crossed_edges(box)
    ends = np.stack(np.unravel_index(edges, box.shape), axis=2)  # places of the grid points, shape [V, 2, 3]
    return ends.mean(axis=1) + (np.array([own[0] for own in used]) - 1.0), faces


def smoothed(vertices: Floats, faces: Indices, rounds: int) -> Floats:
    """Smooth a closed mesh by Taubin's filter, which does not shrink it [1]_.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        rounds: each a step towards the mean of the neighbours, and one back.

    .. [1] G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995.
    """
    # Shares of the way to the mean there and back; they keep waves of more than 1 / 0.1 edges
    there, back = 0.5, -0.5 / (1.0 - 0.1 * 0.5)
    count = len(vertices)
    sides = faces[:, [0, 1, 2, 1, 2, 0]].reshape(-1), faces[:, [1, 2, 0, 0, 1, 2]].reshape(-1)
    neighbours = sparse.csr_matrix((np.ones(len(sides[0])), sides), shape=(count, count)).sign()
    valence = np.asarray(neighbours.sum(axis=1))
    for _ in range(rounds):
        for share in (there, back):
            vertices = vertices + share * (neighbours @ vertices / valence - vertices)
    return vertices
