"""The soft low-pass filter against truncation, its own transpose, and functions that it must not change."""

import numpy as np
import pytest

from omtwarp.device.start import wp
from omtwarp.wavelets import SphericalWavelets, sphere_hierarchy
from omtwarp.wavelets.transform import WaveletFilter


def filtered(values: np.ndarray, filter_: WaveletFilter, device: str, adjoint: bool = False) -> np.ndarray:
    array = wp.array(values, dtype=wp.float64, device=device)
    (filter_.apply_adjoint if adjoint else filter_.apply)(array)
    return array.numpy()


@pytest.mark.parametrize("butterfly", [False, True])
def test_factors_of_one_and_zero_are_the_papers_truncation(device, butterfly):
    hierarchy = sphere_hierarchy(4)
    values = np.random.default_rng(0).normal(size=hierarchy.node_count)
    factors = (np.arange(hierarchy.node_count) < hierarchy.node_counts[2]).astype(float)
    soft = filtered(values, WaveletFilter(hierarchy, factors, butterfly=butterfly, device=device), device)
    wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
    truncated = wp.array(values, dtype=wp.float64, device=device)
    wavelets.analyse(truncated)
    wavelets.truncate(truncated, 1)
    wavelets.synthesise(truncated)
    np.testing.assert_allclose(soft, truncated.numpy(), atol=1e-13)


def test_transpose_constants_and_identity(device):
    hierarchy = sphere_hierarchy(3)
    random = np.random.default_rng(1)
    factors = random.uniform(size=hierarchy.node_count)
    filter_ = WaveletFilter(hierarchy, factors, butterfly=True, device=device)
    u, v = random.normal(size=(2, hierarchy.node_count))
    assert u @ filtered(v, filter_, device) == pytest.approx(filtered(u, filter_, device, adjoint=True) @ v, rel=1e-11)
    np.testing.assert_allclose(filtered(np.ones_like(u), filter_, device), 1.0, atol=1e-13)
    everything = WaveletFilter(hierarchy, np.ones_like(u), butterfly=True, device=device)
    np.testing.assert_allclose(filtered(u, everything, device), u, atol=1e-12)
