"""Templates of groups: features on a sphere, which maps are registered to, and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError, naming
from omtwarp.files.inputs import holds_array, open_input, read_arrays, write_arrays
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.mesh.arrays import Floats, real_numbers, whole_numbers
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid

ARRAYS = ("template_points", "template_faces", "template_features", "template_names")  # of its file


@dataclass(frozen=True, eq=False)
class Template:
    """Features on a triangulated sphere.

    Attributes:
        points: unit vectors, float64, shape [N, 3].
        faces: int32, shape [F, 3].
        features: float64, shape [N, K].
        names: of the features.
        origin: digest of what it was made from.
    """

    points: Floats
    faces: NDArray[np.int32]
    features: Floats
    names: tuple[str, ...]
    origin: str = ""

    def by_name(self) -> dict[str, Floats]:
        """Return the features by name, shape [N] each."""
        return dict(zip(self.names, self.features.T, strict=True))

    def sphere(self) -> SpherePoints:
        """Return the sphere, which has no surface.

        Raises:
            OmtwarpError: the triangles do not cover the sphere once.
        """
        return SpherePoints(mesh_grid(self.points, self.faces, "the template"))

    def content(self) -> bytes:
        """Return what tells a template from others."""
        arrays = self.points, self.faces, self.features
        return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays) + repr(self.names).encode()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the template as ``.npz``.

        Raises:
            OmtwarpError: the file cannot be written.
        """
        arrays = self.points, self.faces, self.features, np.array(self.names)
        write_arrays(path, {**dict(zip(ARRAYS, arrays, strict=True)), "origin": np.array(self.origin)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Template:
        """Read a template that :meth:`save` wrote.

        Raises:
            OmtwarpError: the file is missing, or is no template.
        """
        with open_input(path, LARGEST_MESH_FILE, "template") as stream, naming(f"'{path}' is not a template"):
            arrays = read_arrays(stream, (*ARRAYS, "origin"))
            if missing := [name for name in ARRAYS if name not in arrays]:
                raise OmtwarpError(f"it has no '{missing[0]}'")
            points = real_numbers(arrays[ARRAYS[0]], "its points", (None, 3))
            faces = whole_numbers(arrays[ARRAYS[1]], "its faces", (None, 3), below=len(points))
            names = tuple(str(name) for name in np.atleast_1d(arrays[ARRAYS[3]]))
            features = real_numbers(arrays[ARRAYS[2]], "its features", (len(points), len(names)))
        return cls(points, faces.astype(np.int32), features, names, str(arrays.get("origin", "")))


def is_template(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a template's."""
    return holds_array(path, *ARRAYS)
