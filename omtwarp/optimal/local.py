"""Newton steps of the few vertices that limit the steps of the whole map.

Next to needle triangles a few vertices have to move far, and while they do, the matrix of the whole map is soon out of
date. After three or four steps nine tenths of the remaining gain comes from one vertex in a hundred. With all other
vertices fixed, the saddle-point system of these is small, and several steps of it cost less than one of the whole map.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from omtwarp.device.start import wp
from omtwarp.mesh.patches import Patches, grow, sides_of
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.domain import ShapeTerms
from omtwarp.optimal.energy import LEAST_EIGENVALUE, TransportEnergy
from omtwarp.optimal.kernels import Fit
from omtwarp.optimal.patch_kernels import LocalEnergy, LocalScratch, SaddlePatches, settle_small_patches
from omtwarp.optimal.sphere import GeodesicCost, SphereShape
from omtwarp.refine.energy import Terms
from omtwarp.solvers.cholesky.envelope import Envelopes
from omtwarp.solvers.cholesky.saddle import UNKNOWNS
from omtwarp.solvers.triangle_newton.small_patches import launch_patches, shared

Numbers = NDArray[np.float64]

# The chosen vertices are the fewest that together have this share of the gains that single vertices could make.
GAIN_SHARE = 0.8
# No vertex counts for more than this share of what the last step of the whole map was expected to gain. Beside a
# triangle that was flipped a moment ago the gain expected from moving one vertex alone is far too large, and noise in
# the last digits of a mesh would choose the vertices.
MAX_GAIN_SHARE = 0.1
MAX_CHOSEN_SHARE = 0.08  # of all vertices: with more, local steps take longer than they save steps of the whole map
FREED_RINGS = 4  # of vertices around those chosen, which move with them
# Multiplications of the largest patch's factorisation; beyond some 1,800 vertices one thread takes too long.
MAX_OPERATIONS = 2e8
MAX_STEPS = 8  # Newton steps of the patches after each step of the whole map
MAX_HALVINGS = 12  # of a patch's step before the patch stays where it is
REGULARISATION = 1e-6  # added to the diagonal, relative to each entry, as the second derivative is only semidefinite


def freed_vertices(faces: NDArray[np.int32], gains: Numbers, expected: float) -> NDArray[np.bool_] | None:
    """Choose the vertices that local steps move, as a mask of shape [V], or None where none has anything to gain.

    Args:
        faces: of the surface, shape [F, 3].
        gains: the gain expected from moving each vertex alone, shape [V].
        expected: the gain that was expected from the last step of the whole map, which limits those of single vertices.
    """
    gains = np.minimum(gains, MAX_GAIN_SHARE * expected)
    order = np.argsort(-gains, kind="stable")
    total = np.cumsum(gains[order])
    count = min(int(np.searchsorted(total, GAIN_SHARE * total[-1])) + 1, int(MAX_CHOSEN_SHARE * len(gains)))
    if not total[-1] > 0.0 or count == 0:
        return None
    chosen = np.zeros(len(gains), dtype=bool)
    chosen[order[:count]] = True
    return grow(faces, chosen, FREED_RINGS)


class LocalSteps:
    """Moves patches of a surface's map, each by steps of its own length, without flipping a triangle.

    One thread takes all steps of a patch, on the host, wherever the map is.

    Args:
        energy: the energy that is minimised.
        patches: what may move.
        points: the map, shape [V, 3].
        shape: terms of its distortion.
        areas: around the vertices, shape [V].
        multipliers: p_v, shape [V].
        stiffness: weights of the squared area errors, shape [V].
        constrained: whether steps change the multipliers; with a penalty in place of constraints they do not.
    """

    def __init__(
        self,
        energy: TransportEnergy,
        patches: Patches,
        points: Numbers,
        shape: ShapeTerms,
        areas: Numbers,
        multipliers: Numbers,
        stiffness: Numbers,
        constrained: bool,
    ):
        assert isinstance(energy.vertex_cost, GeodesicCost) and isinstance(energy.shape, SphereShape)
        assert isinstance(shape, Terms)
        self._energy, self._whole, self._constrained, self._shape = energy, points, constrained, shape
        self._cost, self._distortion = energy.vertex_cost, energy.shape.distortion
        sides = sides_of(patches.faces)
        sides = sides[(sides[:, 0] < patches.free) | (sides[:, 1] < patches.free)]
        count = len(patches.vertices)
        graph = sparse.coo_matrix((np.ones(len(sides), dtype=np.int8), sides.T), shape=(count, count))
        # Patches that share a fixed neighbour change the area around it together: they are one.
        self._count, patch = connected_components(graph, directed=False)
        self._envelopes = Envelopes.of_edges(sides, patch, self._count)
        order = self._envelopes.order
        place = np.empty(count, dtype=np.int32)
        place[order] = np.arange(count, dtype=np.int32)
        patch_of_face = patch[patches.faces[:, 0]]
        by_patch = np.argsort(patch_of_face, kind="stable")
        self._sizes = np.bincount(patch_of_face, minlength=self._count).astype(np.int32)
        self._faces, self._triangles = place[patches.faces[by_patch]], patches.triangles[by_patch]
        self._vertices, self._free = patches.vertices[order], order < patches.free
        self.multipliers, self._stiffness = multipliers[self._vertices], stiffness[self._vertices]
        self._ring = areas[self._vertices]

    @property
    def worthwhile(self) -> bool:
        """Whether no patch is too large for one thread."""
        # Operations are counted for blocks of two unknowns.
        return float(self._envelopes.operations.max()) * (UNKNOWNS / 2.0) ** 3 <= MAX_OPERATIONS

    def run(self, enough: float, most: int = MAX_STEPS) -> tuple[Numbers, NDArray[np.intp], Numbers]:
        """Take Newton steps of every patch until its expected gain is small.

        Args:
            enough: end where the steps are expected to gain less than this, all together.
            most: largest number of steps.

        Returns:
            The whole map, shape [V, 3]; the vertices of the patches, shape [P]; and their multipliers, shape [P].
        """
        energy = self._energy
        given = LocalEnergy()
        # Patches are a small part of the map's area, so that its scale is taken as constant.
        given.linear, given.inverse, given.barrier = self._distortion.pressures(self._shape, energy.area_weight)
        given.shape_weight, given.softness = energy.shape_weight, self._cost.softness
        given.cost_factor = energy.cost_weight / (3.0 * SPHERE_AREA)
        given.least, given.regularisation, given.enough = LEAST_EIGENVALUE, REGULARISATION, enough / self._count
        given.steps, given.halvings, given.constrained = most, MAX_HALVINGS, self._constrained
        whole = self._whole.copy()
        moved, tried = whole[self._vertices], whole[self._vertices]
        state = [shared(moved, wp.vec3d), shared(tried, wp.vec3d), shared(self.multipliers, wp.float64)]
        launch_patches(settle_small_patches, self._sizes, [self._patches(), given], [*state, self._scratch()])
        whole[self._vertices[self._free]] = moved[self._free]
        return whole, self._vertices, self.multipliers

    def _patches(self) -> SaddlePatches:
        """Return what the kernel reads of the patches."""
        energy, vertices, triangles = self._energy, self._vertices, self._triangles
        face_starts = np.zeros(self._count + 1, dtype=np.int32)
        np.cumsum(self._sizes, out=face_starts[1:])
        patches = SaddlePatches()
        patches.starts, patches.first, patches.rows = self._envelopes.upload()
        patches.face_starts, patches.faces = shared(face_starts, wp.int32), shared(self._faces, wp.vec3i)
        patches.frames = shared(self._distortion.frames[triangles], wp.vec3d)
        patches.areas = shared(self._distortion.areas[triangles], wp.float64)
        patches.free = shared(self._free, wp.bool)
        patches.start = shared(self._cost.start[vertices], wp.vec3d)
        patches.wanted = shared(energy.wanted[vertices], wp.float64)
        patches.whole = shared(self._ring, wp.float64)
        patches.stiffness = shared(self._stiffness, wp.float64)
        return patches

    def _scratch(self) -> LocalScratch:
        """Return memory for one launch."""
        triangles, count = len(self._triangles), len(self._vertices)
        scratch = LocalScratch()
        scratch.blocks, scratch.bends = (shared(np.empty((triangles, n)), wp.float64) for n in (21, 6))
        scratch.outside, scratch.ring, scratch.cost = (shared(np.empty(count), wp.float64) for _ in range(3))
        scratch.fits = shared(np.empty((count, 8)), Fit)
        scratch.pull, scratch.right, scratch.step = (shared(np.empty((count, 3)), wp.vec3d) for _ in range(3))
        diagonal, left = self._envelopes.storage(UNKNOWNS)
        scratch.diagonal, scratch.left = shared(diagonal, wp.mat33d), shared(left, wp.float64)
        return scratch


__all__ = ["LocalSteps", "freed_vertices"]
