"""The distortion of a whole map: the sum over triangles of original area times (angle + λ area distortion)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from omtwarp.device.arrays import Workspace, empty, sent
from omtwarp.device.policy import HEAVY_LAUNCH, shares_host_memory
from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.device.threads import FIRST_THREAD, Each, computed, each, launch_parts
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal import shape_kernels as kernels
from omtwarp.solvers.triangle import triangle_frames


@dataclass(frozen=True)
class ShapeTerms:
    """The distortion of one map.

    Attributes:
        angle, area: mean distortions of the triangles, weighted by original area, less 2.
        d_volume: what steps keep positive of every triangle, float64, shape [F], on the device.
    """

    angle: float
    area: float
    d_volume: wp.array

    def total(self, weight: float) -> float:
        """Return angle plus ``weight`` times area distortion, and what keeps triangles from turning over."""
        return self.angle + weight * self.area


@dataclass(frozen=True)
class Terms(ShapeTerms):
    """The distortion of a map to the sphere, of which ``d_volume`` is det[s0, s1, s2].

    Attributes:
        scale: what brings the total flat area of the image to 4π.
        inverse_sum: sum of original area over area ratio, before scaling.
        ratio: flat area of the image over original area of every triangle, before scaling, float64, shape [F], on the
            device.
        needle: mean of the needle barrier weighted by original area; 0 for all but needles standing upright.
    """

    scale: float
    inverse_sum: float
    ratio: wp.array
    needle: float

    def total(self, weight: float) -> float:
        """Return angle + λ area less the value of a perfect map, plus the needle barrier."""
        return super().total(weight) + needle_weight(weight) * self.needle


# Relative to the weights of angle and area together. The barrier is zero except on triangles that stand steeply on the
# sphere (omtwarp.optimal.shape_kernels.STEEP_COSINE) and tends to infinity as they flip, so that its weight moves
# minima little.
NEEDLE_SHARE = 0.1


def needle_weight(weight: float) -> float:
    """Return the weight of the needle barrier in the energy angle + λ area."""
    return NEEDLE_SHARE * (1.0 + weight)


class DistortionEnergy:
    """Evaluates maps of one surface on one device.

    Args:
        surface: the original surface, V vertices and F faces.
        device: a Warp device.

    Attributes:
        workspace: on the host, for gradients, Hessians and the fronts of factorisations. On CUDA, where allocations are
            cheap and memory is scarce, memory is allocated for each call.
        frames: of the triangles, on the host, shape [F, 3].
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.surface, self.device = surface, device
        self.areas, self.frames, self.workspace = surface.face_areas, triangle_frames(surface), Workspace()
        mesh = surface.on(device)
        own = wp.array(self.frames, dtype=wp.vec3d, device=device, copy=False)
        self._count, self._rows = surface.face_count, mesh.vertex_corners
        self._mesh = [mesh.faces, own, mesh.face_areas]

    def _scratch(self, rows: int, columns: int) -> wp.array:
        """Return a temporary array from the shared workspace, float64, shape [rows, columns]."""
        if not shares_host_memory(self.device):
            return wp.empty((rows, columns), dtype=wp.float64, device=self.device)
        return sent(self.workspace.numbers(rows * columns).reshape(rows, columns), wp.float64)

    def terms(self, points: wp.array) -> Terms:
        """Return the distortions and per-triangle ratios of a map."""
        reading = Reading(self.device)
        return self.begin(points, reading)(reading.read())

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], Terms]:
        """Begin to compute what :meth:`terms` returns; return what makes it of the numbers that are read."""
        faces, frames, areas = self._mesh
        # Angle distortion less 2, D, det[s0, s1, s2] and needle barrier of every triangle.
        angles, ratio, volume, steepness = measured = [empty(self._count, wp.float64, self.device) for _ in range(4)]
        launch_parts(kernels.triangle_terms, self._count, [points, *each(faces, frames)], each(*measured), self.device)
        place, total = reading.place()
        reading.add(areas, ratio, total)
        excess, inverse = (empty(ratio.size, wp.float64, self.device) for _ in range(2))
        launch_parts(kernels.distortion_summands, ratio.size, [Each(ratio), total], each(excess, inverse), self.device)
        places = [place, *(reading.dot(areas, summand) for summand in (angles, excess, steepness, inverse))]

        def finish(numbers: Floats) -> Terms:
            whole, angle, area, needle, inverse_sum = (float(x) for x in numbers[places])
            angle, area, needle = (total / SPHERE_AREA for total in (angle, area, needle))
            return Terms(angle, area, volume, SPHERE_AREA / whole, inverse_sum, ratio, needle)

        return finish

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient of the energy by the vertices, tangent to the sphere, vec3d, shape [V]."""
        assert isinstance(terms, Terms)
        corners = self._scratch(3 * self._count, 3).view(wp.vec3d)
        inputs = [points, *each(*self._mesh), self.pressures(terms, weight)]
        launch_parts(kernels.triangle_gradient, self._count, inputs, [Each(corners, 3)], self.device, HEAVY_LAUNCH)
        inputs = [points, *self._rows, corners, wp.float64(SPHERE_AREA), FIRST_THREAD]
        return computed(kernels.gather_tangent, inputs, empty(self.surface.vertex_count, wp.vec3d, self.device))

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the Hessian of every triangle in its corners' tangent bases, positive semidefinite, shape [F, 21].

        Of each 6x6 matrix the entries on and above the diagonal, row by row. Valid until the workspace is taken again.
        """
        assert isinstance(terms, Terms)
        inputs = [points, *each(*self._mesh), self.pressures(terms, weight), wp.float64(SPHERE_AREA), False]
        return computed(kernels.triangle_hessian, inputs, self._scratch(self._count, 21), HEAVY_LAUNCH)

    def pressures(self, terms: Terms, weight: float) -> wp.vec3d:
        """Return the factors of D, 1 / D and the needle barrier in the energy linearised by the image's total area."""
        # Σ A (scale D + 1 / (scale D)) = 4π + (Σ A D) (Σ A / D) / 4π: each factor is the other sum over 4π.
        by_ratio, by_inverse = weight * terms.inverse_sum / SPHERE_AREA, weight / terms.scale
        return wp.vec3d(by_ratio, by_inverse, needle_weight(weight))
