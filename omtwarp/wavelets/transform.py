"""Lifted second-generation biorthogonal wavelets on the sphere (paper, sections 2.4 and 3.1).

Source: P. Schröder and W. Sweldens, "Spherical wavelets: efficiently representing functions on the sphere", SIGGRAPH
1995; W. Sweldens, "The lifting scheme", SIAM J. Math. Anal. 29, 1998.

One level of analysis of values at K(j + 1), in place:

    predict   gamma(j, m)  = lambda(j + 1, m) - sum over k of h(k, m) lambda(j + 1, k)
    update    lambda(j, k) = lambda(j + 1, k) + sum over m of s(j, m, k) gamma(j, m)

with s(j, m, k) = I(j + 1, m) / (2 I(j, k)) at the two ends of the edge that m halves, so that
psi(j, m) = phi(j + 1, m) - sum s phi(j, k) has integral zero (the paper's formula in section 3.1). The I integrate the
scaling functions. Departure, for integrals that vanish to round-off: they are not computed separately at each level
but carried down from the node areas of the finest level by the refinement relation,
I(j, k) = I(j + 1, k) + sum over m of h(k, m) I(j + 1, m).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import SparseProduct
from omtwarp.device.threads import GraphsByArray
from omtwarp.geometry import cotangent_laplacian
from omtwarp.geometry.sphere_hierarchy import SphereHierarchy
from omtwarp.mesh.arrays import Floats, real_numbers, whole_number
from omtwarp.wavelets import kernels

# A step of lifting: values at some nodes, multiplied by a matrix and a factor, are added to those at others.
Step: TypeAlias = tuple[SparseProduct, slice, slice, float]


class SphericalWavelets:
    """Forward and inverse transforms of functions on the nodes of a hierarchy's finest level.

    A transformed array holds the scaling coefficients lambda(0, k) at the solid's nodes and gamma(j, m) at the nodes of
    M(j). Two kernel launches per level, work linear in the number of nodes. The Warp methods work in place on a float64
    array of shape [N], and on CUDA the launches are recorded once for each array; :meth:`forward` and :meth:`inverse`
    do the same for NumPy arrays and return a new one.

    Args:
        hierarchy: the nested triangulations.
        butterfly: predict with the eight-point butterfly rule (smooth scaling functions) instead of the hat functions.
        lifted: make every wavelet's integral vanish; without it the basis is the plain interpolating one.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Attributes:
        level_integrals: I(j, k), one array [|K(j)|] per level; those of a level sum to 4π.
    """

    def __init__(
        self, hierarchy: SphereHierarchy, *, butterfly: bool = False, lifted: bool = True, device: str = "auto"
    ) -> None:
        self.hierarchy, self.butterfly, self.lifted = hierarchy, butterfly, lifted
        self.device = resolve_device(device)
        self._run = GraphsByArray(self.device)
        integrals = [hierarchy.node_areas]
        for j in reversed(range(hierarchy.level)):
            integrals.insert(0, hierarchy.refinement_matrix(j, butterfly=butterfly).T @ integrals[0])
        self.level_integrals = tuple(integrals)

        analysis: list[Step] = []
        adjoint: list[Step] = []  # of the synthesis
        for j in reversed(range(hierarchy.level)):
            coarse, fine = hierarchy.node_counts[j : j + 2]
            nodes, added = slice(coarse), slice(coarse, fine)
            predict, update = hierarchy.refinement_matrix(j, butterfly=butterfly)[coarse:], self.lift(j)
            for matrix, source, target, factor in ((predict, nodes, added, -1.0), (update, added, nodes, 1.0)):
                analysis.append((SparseProduct(matrix, self.device), source, target, factor))
                adjoint.append((SparseProduct(matrix.T, self.device), target, source, -factor))
        self._analyse, self._synthesise = partial(_take, analysis), partial(_take, _taken_back(analysis))
        self._synthesise_adjoint, self._analyse_adjoint = partial(_take, adjoint), partial(_take, _taken_back(adjoint))

    def lift(self, level: int) -> sparse.csr_matrix:
        """Return the matrix of the s(j, m, k), shape [|K(j)|, |M(j)|]; of zeros where wavelets are not lifted."""
        parents, coarse = self.hierarchy.level_parents[level], self.hierarchy.node_counts[level]
        shape = coarse, len(parents)
        if not self.lifted:
            return sparse.csr_matrix(shape)
        share = self.level_integrals[level + 1][coarse:, None] / (2 * self.level_integrals[level][parents])
        return sparse.csr_matrix((share.ravel(), (parents.ravel(), np.repeat(np.arange(len(parents)), 2))), shape=shape)

    def analyse(self, values: wp.array) -> None:
        """Transform values at nodes to coefficients in place: SWfwd of Algorithm 1."""
        self._run(self._analyse, values)

    def synthesise(self, values: wp.array) -> None:
        """Transform coefficients to values at nodes in place: SWbak of Algorithm 1."""
        self._run(self._synthesise, values)

    def synthesise_adjoint(self, values: wp.array) -> None:
        """Apply the transpose of :meth:`synthesise` in place: entry (j, m) becomes Σ values times psi(j, m)."""
        self._run(self._synthesise_adjoint, values)

    def analyse_adjoint(self, values: wp.array) -> None:
        """Apply the transpose of :meth:`analyse` in place."""
        self._run(self._analyse_adjoint, values)

    def truncate(self, coefficients: wp.array, resolution: int) -> None:
        """Clear the coefficients of levels j > ``resolution``, in place (Algorithm 1, lines 11 to 13).

        The result is a function of the nodes K(resolution + 1); -1 leaves the solid's scaling functions alone.
        """
        first = self.hierarchy.node_counts[min(max(int(resolution) + 1, 0), self.hierarchy.level)]
        if first < self.hierarchy.node_count:
            coefficients[first:].zero_()

    def _on_copy(self, values: ArrayLike, transform: Callable[[wp.array], None]) -> Floats:
        array = real_numbers(values, "one value per node", (self.hierarchy.node_count,), finite=False)
        on_device = wp.array(array, device=self.device)
        transform(on_device)
        return np.asarray(on_device.numpy())

    def forward(self, values: ArrayLike) -> Floats:
        """Apply :meth:`analyse` to a NumPy array, shape [N] -> [N]."""
        return self._on_copy(values, self._analyse)

    def inverse(self, coefficients: ArrayLike) -> Floats:
        """Apply :meth:`synthesise` to a NumPy array, shape [N] -> [N]."""
        return self._on_copy(coefficients, self._synthesise)

    def wavelet(self, node: int) -> Floats:
        """Return the wavelet of a node, evaluated at the finest nodes, shape [N].

        It is psi(j, m), or phi(0, k) at the solid's nodes.
        """
        unit = np.zeros(self.hierarchy.node_count)
        unit[whole_number(node, "node", most=len(unit) - 1)] = 1.0
        return self.inverse(unit)

    def scaling_function(self, level: int, node: int) -> Floats:
        """Return the scaling function phi(level, node), evaluated at the finest nodes, shape [N].

        It is the subdivision of a unit value at one node of K(level).
        """
        values = np.zeros(self.hierarchy.node_counts[whole_number(level, "level", most=self.hierarchy.level)])
        values[whole_number(node, "node", most=len(values) - 1)] = 1.0
        for j in range(level, self.hierarchy.level):
            values = self.hierarchy.refinement_matrix(j, butterfly=self.butterfly) @ values
        return values


def _take(steps: list[Step], values: wp.array) -> None:
    for product, source, target, factor in steps:
        product.add(values[source], values[target], factor)


def _taken_back(steps: list[Step]) -> list[Step]:
    """Return the steps that undo others: the last one first, each with the opposite factor."""
    return [(product, source, target, -factor) for product, source, target, factor in reversed(steps)]


class WaveletFilter:
    """F = S D S⁻¹: analysis, a factor for every coefficient, synthesis (Algorithm 1, lines 10 to 14).

    The paper's factors are one up to a level and zero above. Here each wavelet has its own, so that detail can be kept
    where a mesh is fine and left out where it is coarse. F and its transpose make F A⁻¹ Fᵀ of a diagonal A symmetric
    and positive: steepest descent among the functions that the filter lets through.

    Args:
        hierarchy: nested triangulations; values live on the finest level.
        factors: a factor for every wavelet, shape [N]; the solid's nodes, which hold no wavelets, keep their values.
        butterfly: use the butterfly wavelets.
        device: ``auto``, ``cpu`` or ``cuda:N``.
    """

    def __init__(
        self, hierarchy: SphereHierarchy, factors: Floats, *, butterfly: bool = False, device: str = "auto"
    ) -> None:
        self.wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
        self.device = self.wavelets.device
        kept = real_numbers(factors, "factors", (hierarchy.node_count,)).copy()
        kept[: hierarchy.node_counts[0]] = 1.0
        self._factors = wp.array(kept, device=self.device)

    def apply(self, values: wp.array) -> None:
        """Apply F in place to a Warp array of one value per node."""
        self.wavelets.analyse(values)
        self._scale(values)
        self.wavelets.synthesise(values)

    def apply_adjoint(self, values: wp.array) -> None:
        """Apply the transpose of F in place."""
        self.wavelets.synthesise_adjoint(values)
        self._scale(values)
        self.wavelets.analyse_adjoint(values)

    def _scale(self, values: wp.array) -> None:
        wp.launch(kernels.scale_values, dim=len(values), inputs=[self._factors, values], device=self.device)


def wavelet_energies(hierarchy: SphereHierarchy, wavelets: SphericalWavelets) -> Floats:
    """Return the Dirichlet energy ∫ |grad psi|^2 of every wavelet, shape [N]; zero at the solid's nodes.

    Measured with the cotangent Laplacian of the level on which the wavelet is linear.
    """
    energies = np.zeros(hierarchy.node_count)
    for j in range(hierarchy.level):
        coarse, fine = hierarchy.node_counts[j], hierarchy.node_counts[j + 1]
        laplacian = cotangent_laplacian(hierarchy.vertices[:fine], hierarchy.level_faces[j + 1])
        functions = sparse.eye(fine, fine - coarse, k=-coarse, format="csr")
        functions = functions - hierarchy.refinement_matrix(j, butterfly=wavelets.butterfly) @ wavelets.lift(j)
        energies[coarse:fine] = np.asarray(functions.multiply(laplacian @ functions).sum(axis=0)).ravel()
    return energies


# Hierarchies are shared between maps, and so is what depends on them alone.
_energies: WeakKeyDictionary[SphereHierarchy, dict[tuple[bool, bool], Floats]] = WeakKeyDictionary()


class WaveletPreconditioner:
    """H = S D S^T r: a symmetric approximate inverse of the Laplacian on a hierarchy's finest level.

    S is the synthesis of the wavelets and D divides each coefficient by the wavelet's Dirichlet energy; at the solid's
    few nodes it solves exactly. S^T r is the sum of r psi: 4^-j times the wavelet coefficient of the function whose
    weak form is r. So this is the paper's H with coefficients of level j scaled by 4^-j, in the form that makes it
    symmetric and positive: r · H > 0, hence minus H is always a direction in which a cost whose gradient is r falls.
    One step then serves all levels alike, where Algorithm 2 visits them in turn.

    Args:
        hierarchy: nested triangulations; the right-hand side lives on the finest level.
        butterfly: use the butterfly wavelets.
        damping: a factor for every wavelet, shape [N] (entries of the solid's nodes are not used), to keep wavelets out
            of H that are too fine for what moves with it.
        device: ``auto``, ``cpu`` or ``cuda:N``.
    """

    def __init__(
        self,
        hierarchy: SphereHierarchy,
        *,
        butterfly: bool = False,
        damping: Floats | None = None,
        device: str = "auto",
    ) -> None:
        self.hierarchy = hierarchy
        self.wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
        self.device = self.wavelets.device
        kept, kind = _energies.setdefault(hierarchy, {}), (self.wavelets.butterfly, self.wavelets.lifted)
        if kind not in kept:
            kept[kind] = wavelet_energies(hierarchy, self.wavelets)
        solid = hierarchy.node_counts[0]
        factors = np.zeros(hierarchy.node_count)
        factors[solid:] = 1 / kept[kind][solid:]
        if damping is not None:
            factors[solid:] *= real_numbers(damping, "damping", (hierarchy.node_count,))[solid:]
        coarse = cotangent_laplacian(hierarchy.vertices[:solid], hierarchy.level_faces[0]).toarray()
        self._factors = wp.array(factors, device=self.device)
        # Rank, relative, of eigenvalues that are zero but for rounding: that of the constants, of the solid's few nodes
        self._coarse_inverse = SparseProduct(np.linalg.pinv(coarse, rcond=1e-10, hermitian=True), self.device)
        self._coarse: wp.array = wp.empty(solid, dtype=wp.float64, device=self.device)  # so that no step allocates

    def apply(self, right_hand_side: wp.array, out: wp.array | None = None) -> wp.array:
        """Apply the approximate inverse to a right-hand side (weak form), shape [N] -> [N], NumPy or Warp as given.

        The constant part of the right-hand side is ignored, and H is defined up to a constant. With Warp arrays, H can
        be written to ``out``.
        """
        from_numpy = not isinstance(right_hand_side, wp.array)
        if from_numpy:
            given = real_numbers(right_hand_side, "right_hand_side", (len(self._factors),))
            values = wp.array(given, device=self.device)
        else:
            values = wp.empty_like(right_hand_side) if out is None else out
            wp.copy(values, right_hand_side)
        self.wavelets.synthesise_adjoint(values)
        self._coarse.zero_()
        self._coarse_inverse.add(values, self._coarse)
        wp.launch(kernels.scale_values, dim=len(values), inputs=[self._factors, values], device=self.device)
        wp.copy(values, self._coarse, count=len(self._coarse))
        self.wavelets.synthesise(values)
        return np.asarray(values.numpy()) if from_numpy else values
