"""Sums whose order depends on the number of terms alone."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from omtwarp.device.policy import shares_host_memory
from omtwarp.device.start import wp
from omtwarp.device.sums import MAX_PARTIAL_ROWS, DeviceSum, HostSum, Reading, RowSums

LENGTHS = [1, 64, 65, 4096, 4097, 20_000, 300_000]


@given(rows=st.integers(1, 40_000), columns=st.integers(1, 4), seed=st.integers(0, 1000))
def test_sums_of_rows(rows, columns, seed):
    values = np.random.default_rng(seed).normal(size=(rows, columns))
    parts = RowSums(rows, columns, "cpu")(wp.array(values, dtype=wp.float64, device="cpu")).numpy()
    assert len(parts) <= MAX_PARTIAL_ROWS
    np.testing.assert_allclose(parts.sum(axis=0), values.sum(axis=0), rtol=0, atol=1e-12 * np.sqrt(rows))
    whole = wp.array(np.arange(float(rows * columns)).reshape(rows, columns), dtype=wp.float64, device="cpu")
    total = RowSums(rows, columns, "cpu")(whole).numpy().sum(axis=0)
    np.testing.assert_array_equal(total, whole.numpy().sum(axis=0))  # whole numbers: exact, every row once


def test_sums_agree_between_devices(device):
    values = np.random.default_rng(0).normal(size=(300_000, 2))
    one, two = (
        RowSums(len(values), 2, where)(wp.array(values, dtype=wp.float64, device=where)).numpy()
        for where in ("cpu", device)
    )
    np.testing.assert_array_equal(one, two)  # additions alone, in the same order


@pytest.mark.parametrize("count", LENGTHS)
def test_sums_of_numbers_and_products(device, count):
    a, b = np.random.default_rng(count).normal(size=(2, count))
    one, other = (wp.array(v, dtype=wp.float64, device=device) for v in (a, b))
    adders = [DeviceSum(wp.get_device(device))]
    if shares_host_memory(wp.get_device(device)):
        adders.append(HostSum())
    for adder in adders:
        out = wp.empty(3, dtype=wp.float64, device=device)
        adder.dot(one, other, out)
        adder.total(one, out[1:])
        adder.largest(one, out[2:])
        product, total, largest = out.numpy()
        assert product == pytest.approx(a @ b, abs=1e-12 * np.abs(a * b).sum())
        assert total == pytest.approx(a.sum(), abs=1e-12 * np.abs(a).sum())
        assert largest == np.abs(a).max()


def test_a_reading_brings_all_numbers_at_once_and_begins_anew(device):
    reading = Reading(wp.get_device(device))
    a, b = (wp.array(v, dtype=wp.float64, device=device) for v in ([1.0, -2.0, 3.0], [2.0, 2.0, 2.0]))
    for _ in range(2):
        places = reading.dot(a, b), reading.largest(a), reading.place()[0], reading.dot(b, b)
        assert reading.read()[list(places)].tolist() == [4.0, 3.0, 0.0, 12.0]


def test_one_adder_for_arrays_of_any_length(device):
    """One adder sums arrays of several lengths in turn; its workspace is allocated once for each length."""
    adder, out = DeviceSum(wp.get_device(device)), wp.empty(1, dtype=wp.float64, device=device)
    for count in (5000, 100, 70_000, 100, 5000):
        adder.total(wp.full(count, 2.0, dtype=wp.float64, device=device), out)
        assert out.numpy()[0] == 2.0 * count
        ones = wp.full(count, 1.0, dtype=wp.float64, device=device)
        adder.dot(ones, ones, out)
        assert out.numpy()[0] == count
