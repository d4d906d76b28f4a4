"""The fake device is what the package takes for CUDA: memory of its own, and copies that are counted."""

import numpy as np
import pytest
from fake_device import FakeDevice, install

from omtwarp.device import policy
from omtwarp.device.arrays import empty, vectors
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.wavelets.kernels import scale_values


def test_it_is_cuda_to_the_package_and_another_device_to_warp(fake):
    assert policy.resolve_device("cuda:0") is policy.resolve_device("cuda") is fake
    assert fake != wp.get_device("cpu") and wp.get_device("cpu") != fake and fake == "cuda:0"
    assert not policy.shares_host_memory(fake)
    assert policy.launch_parts_of(fake, 10**6, cores=8) == 1
    with pytest.raises(OmtwarpError, match="does not exist: this machine has 1"):
        policy.resolve_device("cuda:1")


def test_memory_is_apart_and_copies_are_counted(fake):
    numbers = np.arange(6.0).reshape(2, 3)
    array = vectors(numbers, fake)
    numbers[:] = 0.0
    assert sum(fake.uploads.values()) == 1 and not fake.downloads
    back = array.numpy()
    np.testing.assert_array_equal(back, np.arange(6.0).reshape(2, 3))
    back[:] = 0.0
    np.testing.assert_array_equal(array.numpy()[:, 0], [0.0, 3.0])
    assert fake.downloads == {"outside of the package": 2}
    assert empty(3, wp.float64, fake).device is fake


def test_arrays_of_another_device_are_refused(fake):
    here = wp.zeros(2, dtype=wp.float64, device="cpu")
    there = wp.zeros(2, dtype=wp.float64, device=fake)
    with pytest.raises(RuntimeError, match="device"):
        wp.launch(scale_values, dim=2, inputs=[here], outputs=[there], device=fake)


def test_it_is_gone_after_a_test(monkeypatch):
    known = dict(wp.get_device("cpu").runtime.device_map)
    with monkeypatch.context() as context:
        fake = install(context)
        assert isinstance(fake, FakeDevice) and policy.is_cuda(fake)
    assert wp.get_device("cpu").runtime.device_map == known
    assert not policy.is_cuda(fake)


def test_automatic_is_the_cpu_also_where_there_is_cuda(fake):
    assert policy.resolve_device("auto") == policy.resolve_device(None) == wp.get_device("cpu")


@pytest.mark.parametrize(("device", "forks"), [("auto", True), ("cpu", True), ("cuda", False), ("cuda:1", False)])
def test_a_host_of_a_cohort_forks_for_the_cpu_alone(device, forks):
    """A child of a fork cannot use CUDA; and ``auto`` must be the same device in a fork as without."""
    assert policy.asks_for_cuda(device) is not forks
