"""An inverse Laplacian in the wavelet basis: a diagonal scaling in place of a Poisson solve."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.device.start import wp
from omtwarp.geometry import cotangent_laplacian
from omtwarp.geometry.sphere_hierarchy import SphereHierarchy
from omtwarp.wavelets import kernels
from omtwarp.wavelets.transform import SphericalWavelets


def wavelet_energies(hierarchy: SphereHierarchy, wavelets: SphericalWavelets) -> NDArray[np.float64]:
    """Return the Dirichlet energy ∫ |grad psi|^2 of every wavelet, shape [N]; zero at the solid's nodes.

    Measured with the cotangent Laplacian of the level on which the wavelet is linear.
    """
    energies = np.zeros(hierarchy.node_count)
    for j in range(hierarchy.level):
        coarse, fine = hierarchy.node_counts[j], hierarchy.node_counts[j + 1]
        laplacian = cotangent_laplacian(hierarchy.vertices[:fine], hierarchy.level_faces[j + 1])
        columns = np.arange(fine - coarse)
        functions = sparse.csr_matrix(
            (np.ones(fine - coarse), (coarse + columns, columns)), shape=(fine, fine - coarse)
        )
        if wavelets.lifted:
            parents = hierarchy.level_parents[j]
            share = wavelets.level_integrals[j + 1][coarse:, None] / (2 * wavelets.level_integrals[j][parents])
            lift = sparse.csr_matrix(
                (share.ravel(), (parents.ravel(), np.repeat(columns, 2))), shape=(coarse, fine - coarse)
            )
            functions = functions - hierarchy.refinement_matrix(j, butterfly=wavelets.butterfly) @ lift
        energies[coarse:fine] = np.asarray(functions.multiply(laplacian @ functions).sum(axis=0)).ravel()
    return energies


# Hierarchies are shared between maps, and so is what depends on them alone.
_energies: WeakKeyDictionary[SphereHierarchy, dict[tuple[bool, bool], NDArray[np.float64]]] = WeakKeyDictionary()


def _kept_energies(hierarchy: SphereHierarchy, wavelets: SphericalWavelets) -> NDArray[np.float64]:
    kept = _energies.setdefault(hierarchy, {})
    kind = (wavelets.butterfly, wavelets.lifted)
    if kind not in kept:
        kept[kind] = wavelet_energies(hierarchy, wavelets)
    return kept[kind]


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
        damping: NDArray[np.float64] | None = None,
        device: str = "auto",
    ) -> None:
        self.hierarchy = hierarchy
        self.wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
        self.device = self.wavelets.device
        energies = _kept_energies(hierarchy, self.wavelets)
        solid = hierarchy.node_counts[0]
        factors = np.zeros(hierarchy.node_count)
        factors[solid:] = 1 / energies[solid:]
        if damping is not None:
            factors[solid:] *= damping[solid:]
        coarse = cotangent_laplacian(hierarchy.vertices[:solid], hierarchy.level_faces[0]).toarray()
        self._factors = wp.array(factors, device=self.device)
        # Rank, relative, of eigenvalues that are zero but for rounding: that of the constants, of the solid's few nodes
        self._coarse_inverse = wp.array(np.linalg.pinv(coarse, rcond=1e-10, hermitian=True), device=self.device)
        self._coarse = wp.empty(solid, dtype=wp.float64, device=self.device)

    def apply(self, right_hand_side: wp.array, out: wp.array | None = None) -> wp.array:
        """Apply the approximate inverse to a right-hand side (weak form), shape [N] -> [N], NumPy or Warp as given.

        The constant part of the right-hand side is ignored, and H is defined up to a constant. With Warp arrays, H can
        be written to ``out``.
        """
        from_numpy = not isinstance(right_hand_side, wp.array)
        values: wp.array
        if from_numpy:
            values = wp.array(np.array(right_hand_side, dtype=np.float64), device=self.device)
        else:
            values = wp.empty_like(right_hand_side) if out is None else out
            wp.copy(values, right_hand_side)
        self.wavelets.synthesise_adjoint(values)
        inputs = [self._coarse_inverse, values]
        wp.launch(
            kernels.dense_product,
            dim=len(self._coarse),
            inputs=inputs,
            outputs=[self._coarse],
            device=self.device,
        )
        wp.launch(kernels.scale_values, dim=len(values), inputs=[self._factors, values], device=self.device)
        wp.copy(values, self._coarse, count=len(self._coarse))
        self.wavelets.synthesise(values)
        return np.asarray(values.numpy()) if from_numpy else values
