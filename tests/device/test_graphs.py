"""Work recorded and replayed does what the same work does step by step."""

import numpy as np
import pytest

from omtwarp.device import threads
from omtwarp.device.start import wp
from omtwarp.device.threads import MAX_GRAPHS, Graph, GraphsByArray, step_by_step
from omtwarp.wavelets.kernels import scale_values


class Doubling:
    """Doubles a vector, counted by hand: how often the work was called by Python."""

    def __init__(self, device: str, record: bool | None):
        self.calls = 0
        self.device = device
        self.factors = wp.full(4, 2.0, dtype=wp.float64, device=device)
        self.values = wp.array(np.arange(1.0, 5.0), dtype=wp.float64, device=device)
        self.graph = Graph(self.work, device, record)

    def work(self) -> None:
        self.calls += 1
        wp.launch(scale_values, dim=4, inputs=[self.factors, self.values], device=self.device)


@pytest.mark.parametrize("record", [False, True])
def test_work_is_done_as_often_as_asked_for(device, record):
    doubling = Doubling(device, record)
    for _ in range(5):
        doubling.graph()
    np.testing.assert_array_equal(doubling.values.numpy(), 32.0 * np.arange(1.0, 5.0))
    assert doubling.calls == (1 if doubling.graph.recorded else 5)


def test_nothing_is_recorded_on_the_cpu_unless_asked_for():
    assert not Graph(lambda: None, "cpu").recorded
    assert Graph(lambda: None, "cpu", record=True).recorded


def test_step_by_step_records_nothing_and_ends(device):
    doubling = Doubling(device, record=True)
    with step_by_step():
        doubling.graph()
        doubling.graph()
    assert doubling.calls == 2
    doubling.graph()
    doubling.graph()
    assert doubling.calls == 3
    np.testing.assert_array_equal(doubling.values.numpy(), 16.0 * np.arange(1.0, 5.0))


def test_a_graph_inside_of_a_graph_becomes_a_part_of_it(device):
    inner = Doubling(device, record=True)

    def twice() -> None:
        inner.graph()
        inner.graph()

    outer = Graph(twice, device, record=True)
    for _ in range(3):
        outer()
    assert inner.calls == 2
    np.testing.assert_array_equal(inner.values.numpy(), 64.0 * np.arange(1.0, 5.0))


def test_graphs_belong_to_arrays(device, monkeypatch):
    monkeypatch.setattr(threads, "records_graphs", lambda device: True)
    graphs = GraphsByArray(device)
    factors = wp.full(3, 3.0, dtype=wp.float64, device=device)
    calls = []

    def triple(values) -> None:
        calls.append("triple")
        wp.launch(scale_values, dim=3, inputs=[factors, values], device=device)

    def clear(values) -> None:
        calls.append("clear")
        values[1:].zero_()

    arrays = [wp.ones(3, dtype=wp.float64, device=device) for _ in range(MAX_GRAPHS + 2)]
    for array in arrays:
        for _ in range(2):
            graphs(triple, array)
            graphs(clear, array)
    assert calls == ["triple", "clear"] * len(arrays)
    for array in arrays:
        np.testing.assert_array_equal(array.numpy(), [9.0, 0.0, 0.0])
    assert len(graphs._graphs) <= MAX_GRAPHS
