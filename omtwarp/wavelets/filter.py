"""A soft low-pass filter in the wavelet basis: the paper's clearing of fine coefficients, gradual and local."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.geometry.sphere_hierarchy import SphereHierarchy
from omtwarp.wavelets import kernels
from omtwarp.wavelets.transform import SphericalWavelets


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
        self,
        hierarchy: SphereHierarchy,
        factors: NDArray[np.float64],
        *,
        butterfly: bool = False,
        device: str = "auto",
    ) -> None:
        self.wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
        self.device = self.wavelets.device
        kept = np.array(factors, dtype=np.float64)
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
