"""The optimal map to a flat torus: least squared distance among the maps that keep the areas around vertices.

The minimisation is that of the sphere (:mod:`omtwarp.optimal.solver`), in the plane (:mod:`omtwarp.optimal.plane`).
"""

from dataclasses import dataclass, replace

from omtwarp.device.policy import resolve_device
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.cells import Cells, MeasuredRings
from omtwarp.optimal.energy import TransportEnergy
from omtwarp.optimal.exact import restore_areas
from omtwarp.optimal.nested import approached, shape_term_by_law
from omtwarp.optimal.plane import Plane, PlaneCost, PlaneShape
from omtwarp.optimal.refinement import MOST_WEIGHT, match_area, refinement_weight
from omtwarp.optimal.solver import GAIN, OptimalMap, minimise
from omtwarp.options import AreaMatch, Progress, Refinement
from omtwarp.solvers.triangle import AREA_WEIGHT
from omtwarp.torus.harmonic import FlatTorus

STEPS = 100  # largest number of steps; a map that needs more reports that it has not converged
REFINED = 1e-4  # least expected gain of a step of a refinement


@dataclass(frozen=True, eq=False)
class TorusMaps:
    """The maps of a surface to one flat torus.

    Attributes:
        surface: of genus 1, V vertices; its areas add up to 4π, as the torus's does, and are the masses.
        conformal: the map from which distances are measured; triangles may be turned over there.
        progress: as of :func:`omtwarp.optimal.solver.minimise`.
        device: where maps are.
    """

    surface: Surface
    conformal: FlatTorus
    progress: Progress | None = None
    device: str | None = "auto"

    def energy(
        self,
        shape_weight: float,
        *,
        cells: Cells | None = None,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
    ) -> TransportEnergy:
        """Return the energy of the maps.

        Args:
            shape_weight, cost_weight, area_weight: as of :class:`omtwarp.optimal.energy.TransportEnergy`.
            cells: whose areas are kept; the triangles around vertices by default.
        """
        plane = Plane(self.surface, self.conformal.shift, resolve_device(self.device))
        cost, shape = PlaneCost(plane, self.conformal.points), PlaneShape(plane)
        return TransportEnergy(plane, cells, cost, shape, shape_weight, cost_weight, area_weight)

    def optimal(self, start: FlatTorus | None = None) -> tuple[OptimalMap, float]:
        """Find the optimal map.

        Args:
            start: a map without flips to begin with; the conformal map by default.

        Returns:
            The map, whose areas are restored as one more record of its history, and the weight of its shape term.

        Raises:
            OmtwarpError: a triangle of the start is turned over.
        """
        energy, y = self._weighed(self.conformal if start is None else start)
        optimal = minimise(energy, y, gain=GAIN, iterations=STEPS, progress=self.progress)
        points, _ = restore_areas(energy, optimal.points)
        after = energy.terms(energy.domain.sent(points))
        last = {**optimal.history[-1], "cost": energy.cost(after)}
        last |= {"ring_rms": energy.area_rms(after), "ring_largest": after.largest}
        last |= {"area": after.shape.area + 2.0, "angle": after.shape.angle + 2.0}
        return replace(optimal, points=points, history=(*optimal.history, last)), energy.shape_weight

    def near(self, start: FlatTorus) -> FlatTorus:
        """Return a map near the optimal one, from one without flips whose areas may be wrong."""
        return start.at(approached(*self._weighed(start)))

    def _weighed(self, start: FlatTorus) -> tuple[TransportEnergy, Floats]:
        """Return the energy, its shape term weighed by the law at a map, and this moved to least cost, shape [V, 2]."""
        energy = self.energy(1.0)
        points = start.points - self.surface.vertex_areas / SPHERE_AREA @ (start.points - self.conformal.points)
        terms = energy.terms(energy.domain.sent(points))
        term = shape_term_by_law(energy.cost(terms) / SPHERE_AREA, terms.shape.angle + 2.0)
        energy.shape_weight, energy.area_weight = term.weight, term.area
        return energy, points

    def refined(self, points: Floats, weight: Refinement | AreaMatch | float) -> tuple[OptimalMap, float]:
        """Move a map to a minimum of angle plus λ times area distortion: see :mod:`omtwarp.optimal.refinement`.

        Args:
            points: a map without flips, shape [V, 2].
            weight: λ, a name of one, or an area distortion to match.

        Returns:
            The minimum, and λ.
        """

        def run(at: Floats, value: float) -> OptimalMap:
            cells = None if value > AREA_WEIGHT else MeasuredRings(self.surface, resolve_device(self.device))
            energy = self.energy(1.0, cells=cells, cost_weight=0.0, area_weight=min(value, AREA_WEIGHT))
            penalty = 2.0 * max(value - AREA_WEIGHT, 0.0)
            return minimise(energy, at, gain=REFINED, iterations=STEPS, penalty=penalty, progress=self.progress)

        if not isinstance(weight, AreaMatch):
            value = refinement_weight(weight)
            return run(points, value), value
        return match_area(
            run(points, MOST_WEIGHT),
            weight.area,
            lambda before, value: run(before.points, value),
            lambda before: before.history[-1]["area"],
        )
