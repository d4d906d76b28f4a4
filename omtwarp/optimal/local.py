"""Newton steps of the few vertices that limit the steps of the whole map.

Next to needle triangles a few vertices have to move far, and while they do, the factorised matrix of the whole map is
soon out of date. After three or four steps nine tenths of the remaining gain comes from one vertex in a hundred. With
all other vertices fixed, the saddle-point system of these is small, and several steps of it cost less than one of the
whole map: on scans this saves three quarters of the factorisations.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from omtwarp.device.arrays import empty, vectors
from omtwarp.device.start import ONE, wp
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.kernels import (
    area_slopes,
    areas_around,
    cost_metric,
    edge_slopes,
    transport_gradient,
    vertex_costs,
)
from omtwarp.optimal.sphere import GeodesicCost, SphereShape
from omtwarp.refine.energy import Terms, TriangleKernels
from omtwarp.solvers.cholesky import NotPositiveDefinite, part_dissection
from omtwarp.solvers.mesh_factor import saddle_factor
from omtwarp.solvers.triangle_newton.line_search import search_patches
from omtwarp.solvers.triangle_newton.motion_kernels import from_tangent, retract_to_sphere, to_tangent, triangle_trouble
from omtwarp.solvers.triangle_newton.newton_kernels import gather_edge_blocks, gather_vertex_blocks
from omtwarp.untangling.kernels import solid_angles

Numbers = NDArray[np.float64]

# The chosen vertices are the fewest that together have this share of the gains that single vertices could make, at most
# the second number as a share of all vertices. There are no local steps where, with the rings around them that move
# too, they are a larger share than the third. With 0.03, 0.05, 0.08 and 0.1 as the second, five scans of 7,000 to
# 35,000 vertices take 17, 16, 14 and 17 factorisations of the whole map. Without local steps where more would be
# chosen, one of them takes 8, or 4, depending on whether the first step leaves a little more or less than that share.
# With 0.8, 0.85 and 0.9 as the first that scan takes 0.76 to 0.79 s in the mean over eight accuracies of the flow, with
# 0.95 0.84 to 0.89; with 0.9 its exact map gets stuck at long thin triangles in two of three cases.
GAIN_SHARE = 0.8
# No vertex counts for more than this share of what the last step of the whole map was expected to gain. Beside a
# triangle that was flipped a moment ago the gain expected from moving one vertex alone is 1e9 times too large: without
# a limit a scan with 230 such triangles takes steps around one of them alone and 5 to 8 factorisations in place of 4,
# and noise of 1e-12 moves its vertices by up to 0.2 radians in place of 2e-6.
MAX_GAIN_SHARE = 0.1
MAX_CHOSEN_SHARE, MAX_FREED_SHARE = 0.08, 0.5
FREED_RINGS = 3
MAX_STEPS = 8  # Newton steps of the patches after each step of the whole map
MAX_HALVINGS = 12  # of a patch's step before the patch stays where it is
REGULARISATION = 1e-6  # added to the diagonal, relative to each entry, as the second derivative is only semidefinite
LEAST_DAMPING = 1e-3  # least eigenvalue kept of the inverse map's derivative: see cost_metric


def freed_vertices(
    faces: NDArray[np.int32],
    gains: Numbers,
    expected: float,
    share: float = GAIN_SHARE,
) -> NDArray[np.bool_] | None:
    """Choose the vertices that local steps move, as a mask of shape [V], or None where they would be too many or none.

    Args:
        faces: of the surface, shape [F, 3].
        gains: the gain expected from moving each vertex alone, shape [V].
        expected: the gain that was expected from the last step of the whole map, which limits those of single vertices.
        share: of all gains, that of the vertices chosen.
    """
    gains = np.minimum(gains, MAX_GAIN_SHARE * expected)
    order = np.argsort(-gains, kind="stable")
    total = np.cumsum(gains[order])
    count = min(int(np.searchsorted(total, share * total[-1])) + 1, int(MAX_CHOSEN_SHARE * len(gains)))
    if not total[-1] > 0.0 or count == 0:
        return None
    chosen = np.zeros(len(gains), dtype=bool)
    chosen[order[:count]] = True
    freed = grow(faces, chosen, FREED_RINGS)
    return None if freed.mean() > MAX_FREED_SHARE else freed


class LocalSteps:
    """Moves patches of a surface's map, each by steps of its own length, without flipping a triangle.

    Args:
        energy: the energy that is minimised.
        patches: what may move.
        points: the map, vec3d, shape [V], on the device.
        terms: the terms of the map.
        multipliers: p_v, shape [V].
        stiffness: weights of the squared area errors, shape [V].
        constrained: whether steps change the multipliers; with a penalty in place of constraints they do not.
    """

    def __init__(
        self,
        energy: TransportEnergy,
        patches: Patches,
        points: wp.array,
        terms: MapTerms,
        multipliers: Numbers,
        stiffness: Numbers,
        constrained: bool,
    ):
        surface, self._device = energy.surface, energy.device
        assert isinstance(energy.vertex_cost, GeodesicCost) and isinstance(energy.shape, SphereShape)
        assert isinstance(terms.shape, Terms)
        self._energy, self._constrained, self._whole = energy, constrained, points
        self._cost, self._distortion = energy.vertex_cost, energy.shape.distortion
        self._free, self._vertices, faces = patches.free, patches.vertices, patches.faces
        count = len(self._vertices)
        self._points = points.numpy()[self._vertices]
        self._start = self._sent(self._cost.start[self._vertices], wp.vec3d)
        offsets, corners = _corners_around(faces, count)
        self._rows = [self._sent(offsets, wp.int32), self._sent(corners, wp.int32)]
        edges, edge_corners = _edges_of(faces, self._free)
        self._outward = edges[:, 1] >= self._free  # the first end is always freed
        self._edges, self._edge_corners = self._sent(edges, wp.vec2i), self._sent(edge_corners, wp.vec2i)
        graph = sparse.coo_matrix((np.ones(len(edges), dtype=np.int8), edges.T), shape=(count, count))
        self._patch_count, self._patch = connected_components(graph, directed=False)
        self._face_patch = self._patch[faces[:, 0]]
        self._face_corners, self._faces = faces, self._sent(faces, wp.vec3i)
        frames = self._sent(self._distortion.triangles.frames.numpy()[patches.triangles], wp.vec3d)
        self._areas = self._distortion.areas[patches.triangles]
        free_rows = [self._sent(offsets[: self._free + 1], wp.int32), self._rows[1]]
        areas = self._sent(self._areas, wp.float64)
        self._triangles = TriangleKernels(self._faces, frames, areas, free_rows, self._distortion.workspace)
        # Patches are a small part of the map's area, so that its scale is taken as constant.
        self._pressures = self._distortion.pressures(terms.shape, energy.area_weight)
        self.multipliers, self._stiffness = multipliers[self._vertices], stiffness[self._vertices]
        self._wanted = energy.wanted[self._vertices]
        self._outside = np.zeros(count)
        ring, _ = self._rings(self._sent(self._points, wp.vec3d))
        self._outside = terms.areas[self._vertices] - ring
        self._factor = saddle_factor(count, edges, lambda: part_dissection(surface, self._vertices, edges))

    def run(self, enough: float, most: int = MAX_STEPS) -> tuple[wp.array, NDArray[np.intp], Numbers]:
        """Take Newton steps of all patches until the expected gain is small.

        Args:
            enough: end where a step is expected to gain less than this.
            most: largest number of steps.

        Returns:
            The whole map, vec3d, shape [V]; the vertices of the patches, shape [P]; and their multipliers, shape [P].
        """
        points = self._sent(self._points, wp.vec3d)
        for _ in range(most):
            points, gain = self._step(points)
            if not gain > enough:
                break
        whole = self._whole.numpy().copy()
        whole[self._vertices[: self._free]] = points.numpy()[: self._free]
        return vectors(whole, self._device), self._vertices, self.multipliers

    def _sent(self, values: NDArray[np.generic], dtype: type) -> wp.array:
        """Return an array on the device, without a copy where that is possible."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device, copy=False)

    def _sums(self, values: Numbers) -> Numbers:
        """Sum values at the vertices, shape [P], over every patch."""
        return np.bincount(self._patch, values, self._patch_count).astype(np.float64, copy=False)

    def _rings(self, points: wp.array) -> tuple[Numbers, Numbers]:
        """Return the areas around vertices and the costs of moving them from their starts, shape [P] each."""
        count = len(self._vertices)
        solid = empty(len(self._areas), wp.float64, self._device)
        wp.launch(solid_angles, dim=solid.size, inputs=[points, self._faces], outputs=[solid], device=self._device)
        ring, cost = (empty(count, wp.float64, self._device) for _ in range(2))
        wp.launch(areas_around, dim=count, inputs=[solid, *self._rows, 0], outputs=[ring], device=self._device)
        inputs = [self._start, points, self._cost.softness]
        wp.launch(vertex_costs, dim=count, inputs=inputs, outputs=[cost], device=self._device)
        return self._outside + ring.numpy(), cost.numpy()

    def _merits(self, points: wp.array, before: wp.array | None = None) -> tuple[Numbers, Numbers, Numbers, wp.array]:
        """Return the merit of every patch, infinite where a triangle lost too much volume; areas, costs, volumes."""
        device, energy = self._device, self._energy
        ring, cost = self._rings(points)
        missing = ring - self._wanted
        of_vertices = energy.cost_weight / (3.0 * SPHERE_AREA) * ring * cost
        of_vertices += self.multipliers * missing + 0.5 * self._stiffness * missing**2
        outputs = self._triangles.terms(points)
        angle, ratio, _, steepness = (array.numpy() for array in outputs)
        linear, inverse, barrier = (float(number) for number in self._pressures)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            of_faces = self._areas * (angle + linear * ratio + inverse / ratio + barrier * steepness)
        of_faces *= energy.shape_weight / SPHERE_AREA
        if before is not None:
            trouble = empty(len(self._areas), wp.int32, device)
            found = wp.zeros(1, dtype=wp.int32, device=device)
            inputs = [points, self._faces, before]
            wp.launch(triangle_trouble, dim=trouble.size, inputs=inputs, outputs=[trouble, found], device=device)
            of_faces[trouble.numpy() > 0] = np.inf
        of_patches = np.bincount(self._face_patch, of_faces, self._patch_count)
        return self._sums(of_vertices) + of_patches, ring, cost, outputs[2]

    def _step(self, points: wp.array) -> tuple[wp.array, float]:
        """Take one step of all patches; return the map and the sum of the expected gains."""
        device, energy, free, count = self._device, self._energy, self._free, len(self._vertices)
        merits, ring, cost, volume = self._merits(points)
        missing = ring - self._wanted
        potential = self.multipliers + energy.cost_weight / (3.0 * SPHERE_AREA) * cost
        on_triangles = potential[self._face_corners].sum(axis=1)
        masses = self._sent(energy.cost_weight / (3.0 * SPHERE_AREA) * ring, wp.float64)
        gradient = empty(free, wp.vec3d, device)
        mesh = [self._start, points, self._faces, masses, self._sent(on_triangles, wp.float64), *self._rows]
        inputs = [*mesh, self._cost.softness, 0]
        wp.launch(transport_gradient, dim=free, inputs=inputs, outputs=[gradient], device=device)
        total = gradient.numpy() + energy.shape_weight * self._triangles.gradient(points, self._pressures).numpy()
        coordinates = wp.empty((free, 2), dtype=wp.float64, device=device)
        inputs = [points, self._sent(total, wp.vec3d)]
        wp.launch(to_tangent, dim=free, inputs=inputs, outputs=[coordinates], device=device)
        right = np.zeros((count, 2))
        right[:free] = -coordinates.numpy()
        try:
            self._factorise(points, masses)
        except NotPositiveDefinite:
            return points, 0.0
        u, q = self._factor.solve(right, -missing)
        decrements = self._sums((right * u).sum(axis=1) - missing * q + self._stiffness * missing**2)
        vectors = empty(free, wp.vec3d, device)
        inputs = [points, self._sent(u[:free], wp.float64)]
        wp.launch(from_tangent, dim=free, inputs=inputs, outputs=[vectors], device=device)
        reach = np.zeros(self._patch_count)
        np.maximum.at(reach, self._patch[:free], np.linalg.norm(u[:free], axis=1))
        longest = np.where(decrements > 0.0, 1.0, 0.0) / np.maximum(1.0, 2.0 * reach)

        def moved(length: Numbers) -> wp.array:
            out = wp.clone(points)
            share = self._sent(length[self._patch[:free]], wp.float64)
            inputs = [points, vectors, share, ONE]
            wp.launch(retract_to_sphere, dim=free, inputs=inputs, outputs=[out], device=device)
            return out

        points, length = search_patches(
            moved, lambda there: self._merits(there, volume)[0], merits, -decrements, longest, MAX_HALVINGS
        )
        if self._constrained:
            # With its boundary fixed the area of a patch cannot change, so that its multipliers are determined up to a
            # constant, to which the patch's total area error would add at every step.
            constant = self._sums(self._wanted * q) / self._sums(self._wanted)
            self.multipliers = self.multipliers + length[self._patch] * (q - constant[self._patch])
        return points, float((length * decrements).sum())

    def _factorise(self, points: wp.array, masses: wp.array) -> None:
        """Factorise the saddle-point matrix with the neighbours of the freed vertices fixed."""
        device, energy, free, count = self._device, self._energy, self._free, len(self._vertices)
        edges = len(self._edges)
        hessians = self._triangles.hessian(points, self._pressures, 1.0).to("cpu")
        rows, faces = [array.to("cpu") for array in self._rows], self._faces.to("cpu")
        own = wp.empty((count, 4), dtype=wp.float64, device="cpu")
        across = wp.empty((edges, 4), dtype=wp.float64, device="cpu")
        wp.launch(gather_vertex_blocks, dim=count, inputs=[*rows, hessians], outputs=[own], device="cpu")
        inputs = [self._edges.to("cpu"), faces, self._edge_corners.to("cpu"), hessians]
        wp.launch(gather_edge_blocks, dim=edges, inputs=inputs, outputs=[across], device="cpu")
        metric = wp.empty((free, 4), dtype=wp.float64, device=device)
        least = wp.float64(LEAST_DAMPING)
        inputs = [self._start, points, self._faces, masses, *self._rows, least, self._cost.softness, 0]
        wp.launch(cost_metric, dim=free, inputs=inputs, outputs=[metric], device=device)
        diagonal = energy.shape_weight * own.numpy().reshape(-1, 2, 2)
        diagonal[:free] += metric.numpy().reshape(-1, 2, 2)
        entries = diagonal[:free, [0, 1], [0, 1]]
        diagonal[:free, [0, 1], [0, 1]] = (1.0 + REGULARISATION) * entries
        diagonal[free:] = entries.mean() * np.eye(2)
        off_diagonal = energy.shape_weight * across.numpy().reshape(-1, 2, 2)
        off_diagonal[self._outward] = 0.0
        forward, backward = (empty(edges, wp.vec2d, device) for _ in range(2))
        slopes = wp.empty((len(self._areas), 3), dtype=wp.vec2d, device=device)
        inputs = [points, self._faces, 0]
        wp.launch(area_slopes, dim=len(self._areas), inputs=inputs, outputs=[slopes], device=device)
        inputs = [slopes, self._faces, self._edges, self._edge_corners]
        wp.launch(edge_slopes, dim=edges, inputs=inputs, outputs=[forward, backward], device=device)
        gradients = np.stack([forward.numpy(), backward.numpy()])
        gradients[0, self._outward] = 0.0
        self._factor.factorise(diagonal, off_diagonal, gradients, 1.0 / self._stiffness)


def _corners_around(faces: NDArray[np.int32], count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the corners of the triangles around every vertex as compressed rows: offsets, and corners."""
    offsets = np.zeros(count + 1, dtype=np.int32)
    np.cumsum(np.bincount(faces.ravel(), minlength=count), out=offsets[1:])
    return offsets, np.argsort(faces.ravel(), kind="stable").astype(np.int32)


def _edges_of(faces: NDArray[np.int32], free: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the edges with an end among the first ``free`` vertices, that end first, and the two corners opposite."""
    one, other = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    corners = np.flatnonzero((one < free) | (other < free))
    low, high = np.minimum(one, other)[corners], np.maximum(one, other)[corners]
    order = np.lexsort((high, low))
    edges = np.stack([low[order[0::2]], high[order[0::2]]], axis=1)
    return np.ascontiguousarray(edges), corners[order].astype(np.int32).reshape(-1, 2)
