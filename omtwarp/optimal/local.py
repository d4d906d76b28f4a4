"""Newton steps of the few vertices that limit the steps of the whole map.

Next to needle triangles a few vertices have to move far, and while they do, the matrix of the whole map is soon out of
date. After three or four steps nine tenths of the remaining gain comes from one vertex in a hundred. With all other
vertices fixed, the saddle-point system of these is small, and several steps of it cost less than one of the whole map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.start import wp
from omtwarp.device.threads import core_count, load, run_all
from omtwarp.mesh.arrays import Floats, Ints, marked
from omtwarp.mesh.patches import Patches, grow, sides_of
from omtwarp.mesh.surface import SPHERE_AREA, transposed_rows
from omtwarp.mesh.validate import components_of
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.patch_kernels import LocalProblem, settle_small_patches
from omtwarp.optimal.shape import DistortionEnergy, Terms
from omtwarp.optimal.sphere import GeodesicCost, Sphere
from omtwarp.solvers.cholesky.envelope import Envelopes

# The chosen vertices are the fewest that together have this share of the gains that single vertices could make: more
# are chosen, and move longer, for the same areas, angles and time in the mean.
GAIN_SHARE = 0.8
# No vertex counts for more than this share of what the last step of the whole map was expected to gain. Beside a
# triangle that was flipped a moment ago the gain expected from moving one vertex alone is far too large, and noise in
# the last digits of a mesh would choose the vertices.
MAX_GAIN_SHARE = 0.1
MAX_CHOSEN_SHARE = 0.08  # of all vertices: with more, local steps take longer than they save steps of the whole map
# Of vertices around those chosen, which move with them. Areas and angles of 60 made surfaces are the same in the mean
# with 2 and 6: more leave the steps more room, and take longer.
FREED_RINGS = 4
# Multiplications of the largest patch's factorisation. With twice as many 13 scans and 90 made surfaces take as many
# steps, and a creature of 1M faces a fifth more time and 1.6 times the memory.
MAX_OPERATIONS = 1e8
MIN_SHARED_TRIANGLES = 500  # with fewer a second thread costs more than it saves
BLOCK = 256  # threads of a block: Warp's own number, for which modules are compiled
MAX_STEPS = 8  # Newton steps of the patches after each step of the whole map


def freed_vertices(faces: Ints, gains: Floats, expected: float, part: float = 1.0) -> NDArray[np.bool_]:
    """Choose the vertices that local steps move, as a mask of shape [V]: none where none has anything to gain.

    Args:
        faces: of the surface, shape [F, 3].
        gains: the gain expected from moving each vertex alone, shape [V].
        expected: the gain that was expected from the last step of the whole map, which limits those of single vertices.
        part: of the vertices that are chosen, those with the most to gain.
    """
    gains = np.minimum(gains, MAX_GAIN_SHARE * expected)
    order = np.argsort(-gains, kind="stable")
    total = np.cumsum(gains[order])
    count = min(int(np.searchsorted(total, GAIN_SHARE * total[-1])) + 1, int(MAX_CHOSEN_SHARE * len(gains)))
    chosen = order[: int(part * count)] if total[-1] > 0.0 else order[:0]
    return grow(faces, marked(len(gains), chosen), FREED_RINGS)


def local_steps(
    energy: TransportEnergy, gains: Floats, expected: float, stiffness: Floats, constrained: bool
) -> tuple[LocalSteps, int] | None:
    """Return the steps of the vertices with the most to gain, and how many these are; None where there are none.

    Patches that are too large for the threads that share one stay as they are; where that leaves none, half as many
    vertices are chosen: without any, maps take more steps.

    Args:
        energy, stiffness, constrained: as of :class:`LocalSteps`.
        gains, expected: as of :func:`freed_vertices`.
    """
    surface, domain, part = energy.surface, energy.domain, 1.0
    assert isinstance(domain, Sphere)
    while (freed := domain.joined(freed_vertices(surface.faces, gains, expected, part))).any():
        while freed.any():
            steps = LocalSteps(energy, Patches.of_vertices(surface.faces, freed), stiffness, constrained)
            if steps.worthwhile:
                return steps, int(freed.sum())
            freed[steps.in_large_patches] = False
        part *= 0.5
    return None


class LocalSteps:
    """Moves patches of a surface's map, each by steps of its own length, without flipping a triangle.

    The threads of a patch take all its steps in one launch: a block of a GPU, or one thread of the host.

    Attributes:
        in_large_patches: vertices of patches that are too large for the threads that share one, of the surface.

    Args:
        energy: the energy that is minimised.
        patches: what may move.
        stiffness: weights of the squared area errors, shape [V].
        constrained: whether steps change the multipliers; with a penalty in place of constraints they do not.
    """

    def __init__(self, energy: TransportEnergy, patches: Patches, stiffness: Floats, constrained: bool):
        assert isinstance(energy.vertex_cost, GeodesicCost) and isinstance(energy.shape, DistortionEnergy)
        assert isinstance(energy.domain, Sphere)
        self._energy, self._device, self._constrained = energy, energy.device, constrained
        self._domain, self._cost, self._distortion = energy.domain, energy.vertex_cost, energy.shape
        sides = sides_of(patches.faces)
        sides = sides[(sides[:, 0] < patches.free) | (sides[:, 1] < patches.free)]
        # Patches that share a fixed neighbour change the area around it together: they are one.
        self._count, patch = components_of(len(patches.vertices), sides)
        self._envelopes = Envelopes.of_edges(sides, patch, self._count)
        order = self._envelopes.order
        place = np.argsort(order).astype(np.int32)
        patch_of_face = patch[patches.faces[:, 0]]
        by_patch = np.argsort(patch_of_face, kind="stable")
        self._sizes = np.bincount(patch_of_face, minlength=self._count).astype(np.int32)
        self._faces, self._triangles = place[patches.faces[by_patch]], patches.triangles[by_patch]
        self._vertices, self._free = patches.vertices[order], order < patches.free
        self._stiffness = stiffness[self._vertices]
        self.in_large_patches = self._vertices[(self._envelopes.operations > MAX_OPERATIONS)[patch[order]]]

    @property
    def worthwhile(self) -> bool:
        """Whether no patch is too large for the threads that share it."""
        return len(self.in_large_patches) == 0

    def run(
        self, points: wp.array, terms: MapTerms, multipliers: wp.array, enough: float, most: int = MAX_STEPS
    ) -> tuple[wp.array, wp.array]:
        """Take Newton steps of every patch until its expected gain is small.

        Args:
            points: the map, vec3d, shape [V].
            terms: its terms.
            multipliers: p_v, float64, shape [V].
            enough: end where the steps are expected to gain less than this, all together.
            most: largest number of steps.

        Returns:
            The map and the multipliers afterwards.
        """
        assert isinstance(terms.shape, Terms)
        energy, device, lanes = self._energy, self._device, lanes_on(self._device)
        vertices = sent(self._vertices.astype(np.int32), wp.int32, device)
        here = self._problem(lanes)
        here.points, here.tried = (points[vertices].contiguous() for _ in range(2))
        here.whole, here.multipliers = (numbers[vertices].contiguous() for numbers in (terms.areas, multipliers))
        # Patches are a small part of the map's area, so that its scale is taken as constant.
        here.pressures = self._distortion.pressures(terms.shape, energy.area_weight)
        here.shape_weight, here.softness = energy.shape_weight, self._cost.softness
        here.cost_factor = energy.cost_weight / (3.0 * SPHERE_AREA)
        here.start = self._cost.start[vertices].contiguous()
        here.steps, here.enough, here.constrained = most, enough / self._count, self._constrained
        launch_patches(settle_small_patches, self._sizes, [0, lanes], [here], device)
        after = [wp.clone(points), wp.clone(multipliers)]
        for whole, part in zip(after, (here.points, here.multipliers), strict=True):
            wp.copy(whole[vertices], part)
        return self._domain.completed(*after)

    def _problem(self, lanes: int) -> LocalProblem:
        """Return what the kernel reads of the patches themselves, and memory."""
        energy, vertices, triangles, device = self._energy, self._vertices, self._triangles, self._device
        face_starts = np.concatenate([[0], np.cumsum(self._sizes)]).astype(np.int32)
        offsets, corners = transposed_rows(self._faces, len(vertices))
        here = LocalProblem()
        here.matrix = self._envelopes.upload(device)
        here.face_starts, here.faces = sent(face_starts, wp.int32, device), sent(self._faces, wp.vec3i, device)
        here.offsets, here.corners = sent(offsets, wp.int32, device), sent(corners, wp.int32, device)
        here.frames = sent(self._distortion.frames[triangles], wp.vec3d, device)
        here.areas = sent(self._distortion.areas[triangles], wp.float64, device)
        here.free = sent(self._free, wp.bool, device)
        here.wanted = sent(energy.wanted[vertices], wp.float64, device)
        here.stiffness = sent(self._stiffness, wp.float64, device)

        def numbers(*shape: int) -> wp.array:
            return wp.empty(shape, dtype=wp.float64, device=device)

        faces, count = len(triangles), len(vertices)
        here.gates = wp.zeros(self._count * lanes, dtype=wp.int32, device=device)
        here.numbers, here.shape, here.solid = numbers(self._count, 4), numbers(faces), numbers(faces)
        here.blocks = numbers(faces, 21)
        here.bends, here.pulls = (wp.empty((faces, 3), dtype=kind, device=device) for kind in (wp.vec2d, wp.vec3d))
        here.outside, here.ring, here.cost, here.worth = (numbers(count) for _ in range(4))
        here.right, here.step = (wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2))
        here.diagonal = wp.empty(count, dtype=wp.mat33d, device=device)
        return here


def lanes_on(device: wp.Device) -> int:
    """Return how many threads share a patch: a block of a GPU, one thread of the host."""
    return BLOCK if device.is_cuda else 1


def launch_patches(
    kernel: wp.Kernel, sizes: Ints, inputs: list[object], outputs: list[object], device: wp.Device
) -> None:
    """Launch a kernel over all patches: a block of a GPU for each, or a thread, on all cores of the host.

    Args:
        kernel: takes a list of patches, the inputs and the outputs; its first index is a place in the list, its second
            the lane.
        sizes: triangles of each patch, shape [count]: every core gets about as many.
        inputs, outputs: further arguments.
        device: where these are.
    """
    lanes = lanes_on(device)
    order = np.argsort(-sizes, kind="stable").astype(np.int32)
    cores = 1 if lanes > 1 or sizes.sum() < MIN_SHARED_TRIANGLES else min(core_count(), len(sizes))
    load(kernel, device)

    def run(group: Ints) -> None:
        arguments = [sent(group, wp.int32, device), *inputs]
        grid = (len(group), lanes)
        wp.launch(kernel, dim=grid, inputs=arguments, outputs=outputs, device=device, block_dim=BLOCK)

    run_all(run, [order[k::cores] for k in range(cores)])


__all__ = ["LocalSteps", "local_steps"]
