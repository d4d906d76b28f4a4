"""Joining of vertices that a format doubles along the seams of a texture.

GLB, and other formats with one row of attributes for every vertex, hold a vertex twice where two charts of a texture or
two materials meet. The surface is closed nevertheless; only its numbering is not.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.read import MeshFile, read_mesh
from omtwarp.mesh.validate import Topology, components_of

Ints = NDArray[np.int64]

# Formats that double vertices along seams of a texture. In others equal positions that remain open when they are joined
# may be intended.
_DOUBLED = (".glb", ".gltf", ".dae", ".3mf", ".json")


@dataclass(frozen=True)
class JoinedMesh:
    """A mesh file whose copies of vertices along seams are joined.

    Attributes:
        vertices: without copies, in the file's order, float64, shape [V, 3].
        faces: the file's, with the vertices' new numbers, int64, shape [F, 3].
        file: the mesh as the file has it.
        vertex_of_file: the vertex that each of the file's is, shape [N]; None where nothing was joined.
        notes: decisions that were made, in words.
    """

    vertices: NDArray[np.float64]
    faces: Ints
    file: MeshFile
    vertex_of_file: Ints | None
    notes: tuple[str, ...]

    @property
    def origins(self) -> Origins:
        """What vertices and faces are in the file: of copies that were joined, the first."""
        count = len(self.file.vertices)
        first = (
            np.arange(count) if self.vertex_of_file is None else np.unique(self.vertex_of_file, return_index=True)[1]
        )
        return Origins(first, np.arange(len(self.faces)), given=count)


def seam_copies(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> Ints | None:
    """Find vertices of boundaries that lie at the same place.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].

    Returns:
        For every vertex the first one at its place, shape [V]; None where no two are joined.
    """
    single = _boundary_vertices(len(vertices), faces)
    at = np.flatnonzero(single)
    if not len(at):
        return None
    _, first, inverse = np.unique(vertices[at] + 0.0, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(at):
        return None
    number = np.arange(len(vertices))
    number[at] = at[first[inverse.reshape(-1)]]
    return number


def _boundary_vertices(count: int, faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return a mask, shape [V], of the vertices on edges that belong to one triangle only."""
    topology = Topology(faces.astype(np.int64), count)
    boundary = np.zeros(count, dtype=bool)
    boundary[topology.edges[topology.edge_face_count == 1]] = True
    return boundary


def compressed(number: Ints) -> tuple[NDArray[np.bool_], Ints]:
    """Return a mask of the vertices that stay when copies are joined, and every vertex's new number, shape [V] each."""
    stays = number == np.arange(len(number))
    return stays, (np.cumsum(stays) - 1)[number]


def read_joined_mesh(
    path: str | os.PathLike[str], *, together: bool = False, smoothing: int | None = None
) -> JoinedMesh:
    """Read a mesh, and join the copies of vertices that its format makes along seams.

    Several geometries of a scene, a material each, are one mesh where they close one another's boundaries.

    Args:
        path: a file that :func:`omtwarp.read_mesh` reads.
        together: whether geometries that do not belong together are taken too, each a part of the surface.
        smoothing: of the surfaces of a volume's labels, as for :func:`omtwarp.read_mesh`.

    Raises:
        OmtwarpError: the file cannot be read, as for :func:`omtwarp.read_mesh`.
    """
    shared = not Path(path).name.lower().removesuffix(".gz").endswith(_DOUBLED)
    try:
        file, one_mesh = read_mesh(path, together=together, smoothing=smoothing), True
    except OmtwarpError as error:
        if shared:
            raise
        refused = error
        file, one_mesh = read_mesh(path, together=True), False
    number = None
    if file.faces.size and 0 <= file.faces.min() and file.faces.max() < len(file.vertices):
        number = seam_copies(file.vertices, file.faces)
    joined, stays = file.faces, None
    if number is not None:
        stays, of_file = compressed(number)
        joined = of_file[file.faces]
        open_still = bool(_boundary_vertices(len(file.vertices), joined).any())
        if open_still and shared:
            number, joined = None, file.faces
    if not one_mesh and not _in_one_piece(joined):
        raise refused  # the user has to choose among geometries that do not belong together
    if number is None or stays is None:
        return JoinedMesh(file.vertices, file.faces, file, None, file.notes)
    copies = len(stays) - int(stays.sum())
    note = f"joined {copies} {'copy' if copies == 1 else 'copies'} of vertices along seams"
    return JoinedMesh(file.vertices[stays], joined, file, of_file, (*file.notes, note))


def _in_one_piece(faces: Ints) -> bool:
    """Return whether all triangles are connected through their vertices."""
    count = int(faces.max()) + 1 if faces.size else 0
    labels = components_of(count, np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1))[1]
    return len(np.unique(labels[faces])) <= 1
