"""Operators that join points anywhere on the sphere to the nodes of a hierarchy.

The paper computes at mesh vertices and transforms on a subdivided solid, and does not say how it goes from one to the
other (section 4.3). Here every point is located once, and both directions are then sparse gathers: linear interpolation
at points, and its adjoint, which divided by the mass each node receives is a mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import SparseProduct
from omtwarp.device.threads import FIRST_THREAD, Each, computed, each, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.sphere_hierarchy import SphereHierarchy
from omtwarp.mesh.arrays import Floats, cross, norms, real_numbers, whole_number
from omtwarp.mesh.surface import transposed_rows
from omtwarp.wavelets import kernels


class SphereSampler:
    """Interpolation, its adjoint, and gradients between points and the nodes of one level of a hierarchy.

    Points are found by descent, from the solid's triangles through their children, in float64: exact, deterministic and
    proportional to the number of levels. :meth:`locate` may be called again when the points move; every buffer is kept.
    All sums gather in a fixed order, so the same input gives the same bits.

    Arrays passed to methods may be NumPy (NumPy comes back) or Warp arrays on this device (Warp comes back).

    Args:
        hierarchy: nested triangulations.
        points: unit vectors, shape [P, 3], NumPy or Warp.
        level: level whose nodes are used; the finest where not given.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        density: positive, at the nodes, shape [N]: gradients, and their adjoint, are divided by it there, so
            that the motion p × ∇H / ρ keeps the density ρ. Uniform where not given.

    Attributes:
        point_faces: triangle of each point, Warp int32 [P].
        triangles: nodes, triangles of all levels and where each level starts, as kernels take them.
        coordinates: barycentric coordinates where the ray through the point meets that triangle, Warp vec3d [P].
    """

    def __init__(
        self,
        hierarchy: SphereHierarchy,
        points: Floats | wp.array,
        *,
        level: int | None = None,
        device: str = "auto",
        density: Floats | None = None,
    ) -> None:
        self.hierarchy = hierarchy
        self.level = hierarchy.level if level is None else whole_number(level, "level", most=hierarchy.level)
        self.device = resolve_device(device)
        self.node_count = hierarchy.node_counts[self.level]
        self.face_count = len(hierarchy.level_faces[self.level])
        levels = hierarchy.level_faces[: self.level + 1]
        starts = np.concatenate([[0], np.cumsum([len(faces) for faces in levels])]).astype(np.int32)
        nodes = hierarchy.vertices[: self.node_count]
        self._nodes = sent(nodes, wp.vec3d, self.device)
        all_faces = sent(np.concatenate(levels), wp.int32, self.device)
        self.triangles = [self._nodes, all_faces, sent(starts, wp.int32, self.device)]
        self._faces = sent(levels[-1], wp.int32, self.device)
        offsets, corners = (sent(a, wp.int32, self.device) for a in transposed_rows(levels[-1], self.node_count))
        self._corner_rows = [Each(offsets, more=1), corners]
        first, second, third = (nodes[levels[-1][:, k]] for k in range(3))
        weights = norms(cross(second - first, third - first))
        at_nodes = np.bincount(levels[-1].ravel(), np.repeat(weights, 3), minlength=self.node_count)
        self._weights = sent(at_nodes if density is None else at_nodes * density, wp.float64, self.device)
        self._level_sums: list[wp.array] = []
        self._level_masses: list[wp.array] = []
        self._predictions: list[tuple[SparseProduct, SparseProduct]] = []  # of each level's added nodes, and transposed

        self.point_count = len(points)
        self.point_faces = wp.zeros(self.point_count, dtype=wp.int32, device=self.device)
        self.coordinates = wp.empty(self.point_count, dtype=wp.vec3d, device=self.device)
        # The radix sort of Warp needs a workspace of twice the keys.
        self._keys = wp.empty(2 * self.point_count, dtype=wp.int32, device=self.device)
        self._order = wp.empty(2 * self.point_count, dtype=wp.int32, device=self.device)
        self._numbers = sent(np.arange(self.point_count, dtype=np.int32), wp.int32, self.device)
        self._point_rows = wp.empty(self.face_count + 1, dtype=wp.int32, device=self.device)
        self._face_vectors = wp.empty(self.face_count, dtype=wp.vec3d, device=self.device)
        self._corner_vectors = wp.empty((self.face_count, 3), dtype=wp.vec3d, device=self.device)
        self._node_vectors = wp.empty(self.node_count, dtype=wp.vec3d, device=self.device)
        self.locate(points)

    def _launch(self, kernel: wp.Kernel, size: int, inputs: list[object], outputs: list[object]) -> None:
        wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device)

    def _take(self, array: ArrayLike | wp.array, name: str, count: int, dtype: type) -> tuple[wp.array, bool]:
        if isinstance(array, wp.array):
            return array, False
        shape = (count, 3) if dtype is wp.vec3d else (count,)
        return wp.array(real_numbers(array, name, shape), dtype=dtype, device=self.device), True

    def _output(self, out: wp.array | None, size: int, dtype: type) -> wp.array:
        return wp.empty(size, dtype=dtype, device=self.device) if out is None else out

    def locate(self, points: Floats | wp.array) -> None:
        """Find the triangle and barycentric coordinates of every point, shape [P, 3], and the points of every triangle.

        A Warp array is kept by reference, not copied.
        """
        if not 0 < len(points) == self.point_count:
            raise OmtwarpError(f"the points: expected {self.point_count or 'some'} points, got {len(points)}")
        self.points, _ = self._take(points, "the points", self.point_count, wp.vec3d)
        count = self.point_count
        inputs = [Each(self.points), *self.triangles]
        launch_parts(kernels.locate_points, count, inputs, each(self.point_faces, self.coordinates), self.device)
        wp.copy(self._keys, self.point_faces)
        wp.copy(self._order, self._numbers)
        wp.utils.radix_sort_pairs(self._keys, self._order, count, end_bit=int(self.face_count - 1).bit_length())
        inputs = [self._keys, count, FIRST_THREAD]
        launch_parts(kernels.face_rows, self.face_count + 1, inputs, [self._point_rows], self.device)
        self._level_masses = []

    def interpolate(self, values: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Interpolate a function at the nodes, [N], to points, [P]: linear in each triangle, exact for constants."""
        source, from_numpy = self._take(values, "values", self.node_count, wp.float64)
        out = self._output(out, self.point_count, wp.float64)
        inputs = [self._faces, self.point_faces, self.coordinates, source]
        self._launch(kernels.interpolate_at_points, self.point_count, inputs, [out])
        return out.numpy() if from_numpy else out

    def adjoint(self, at_points: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Apply the transpose of :meth:`interpolate`, [P] -> [N], which keeps the sum."""
        source, from_numpy = self._take(at_points, "at_points", self.point_count, wp.float64)
        out = self._output(out, self.node_count, wp.float64)
        inputs = [Each(self._point_rows, more=1), self._order, self.coordinates, source]
        computed(kernels.gather_scalars_to_faces, inputs, self._face_vectors)
        self._gather_corners(out)
        return out.numpy() if from_numpy else out

    def set_masses(self, masses: ArrayLike | wp.array) -> None:
        """Give the (positive) masses of the points, shape [P], that :meth:`restrict` divides by."""
        source, _ = self._take(masses, "masses", self.point_count, wp.float64)
        if not self._level_sums:
            counts = self.hierarchy.node_counts[: self.level + 1]
            for j in range(self.level):
                added = self.hierarchy.refinement_matrix(j)[counts[j] :]
                self._predictions.append((SparseProduct(added, self.device), SparseProduct(added.T, self.device)))
            self._level_sums = [wp.empty(count, dtype=wp.float64, device=self.device) for count in counts]
        self._level_masses = self._coarsen(self.adjoint(source), [wp.empty_like(a) for a in self._level_sums])

    def restrict(self, sums: ArrayLike | wp.array) -> wp.array:
        """Return a density's means at the nodes from its sums (such as mass times value) at the points, [P] -> [N].

        Each node gets the adjoint's sum over its mass. A node that no point reaches takes the mean of the ends of its
        edge, from the finest level that has points near it, so that the result is defined everywhere; constants are
        exact. Call :meth:`set_masses` first.
        """
        if not self._level_masses:
            raise OmtwarpError("give the points' masses (set_masses) before restricting to the nodes")
        source, from_numpy = self._take(sums, "sums", self.point_count, wp.float64)
        out = wp.zeros(self.node_count, dtype=wp.float64, device=self.device)
        self.adjoint(source, self._level_sums[self.level])
        self._coarsen(self._level_sums[self.level], self._level_sums)
        # Least mass, of a node's mean share of the sphere: with less no point is near it, and the sum is rounding
        smallest = 1e-12 * 4 * np.pi / self.node_count
        for j in range(self.level + 1):
            count = self.hierarchy.node_counts[j]
            if j > 0:
                first = self.hierarchy.node_counts[j - 1]
                self._predictions[j - 1][0].add(out[:first], out[first:count])
            inputs = [self._level_sums[j], self._level_masses[j], smallest]
            self._launch(kernels.mean_values, count, inputs, [out])
        return out.numpy() if from_numpy else out

    def _coarsen(self, finest: wp.array, workspace: list[wp.array]) -> list[wp.array]:
        workspace[self.level] = finest
        for j in reversed(range(self.level)):
            count = self.hierarchy.node_counts[j]
            wp.copy(workspace[j], workspace[j + 1], count=count)
            self._predictions[j][1].add(workspace[j + 1][count:], workspace[j])
        return workspace

    def _gather_corners(self, out: wp.array) -> None:
        """Sum at every node the numbers that its triangles hold for it."""
        inputs = [*self._corner_rows, self._face_vectors]
        computed(kernels.gather_corners_to_nodes, inputs, out)

    def node_gradient(self, values: ArrayLike | wp.array) -> wp.array:
        """Return the area-weighted mean gradients around the nodes, Warp vec3d [N], in their tangent planes.

        The array is the sampler's own and valid until the next call.
        """
        source, _ = self._take(values, "values", self.node_count, wp.float64)
        inputs = [Each(self._faces), self._nodes, source]
        computed(kernels.level_face_gradients, inputs, self._face_vectors)
        inputs = [*self._corner_rows, *each(self._nodes, self._weights), self._face_vectors]
        computed(kernels.mean_node_gradients, inputs, self._node_vectors)
        return self._node_vectors

    def gradient_adjoint(self, field: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Return the sums over the points of a field times the gradients of the nodes' hat functions, [P, 3] -> [N].

        Gradients are :meth:`node_gradient`, linear between the nodes, in the sphere's tangent plane.

        With field = c × y (c the derivative of a cost with respect to the point y) it is that cost's derivative with
        respect to the stream function of a motion dy/dt = y × grad H: the weak curl.
        """
        source, from_numpy = self._take(field, "field", self.point_count, wp.vec3d)
        out = self._output(out, self.node_count, wp.float64)
        inputs = [Each(self._point_rows, more=1), self._order, self.points, self.coordinates, source]
        computed(kernels.gather_corner_vectors, inputs, self._corner_vectors)
        inputs = [*self._corner_rows, *each(self._nodes, self._weights), self._corner_vectors]
        computed(kernels.mean_node_vectors, inputs, self._node_vectors)
        inputs = [Each(self._faces), self._nodes, self._node_vectors]
        computed(kernels.spread_to_faces, inputs, self._face_vectors)
        self._gather_corners(out)
        return out.numpy() if from_numpy else out
