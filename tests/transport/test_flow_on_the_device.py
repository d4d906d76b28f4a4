"""The flow decides on the device: an iteration can be recorded, reads nothing back, and repeats to the bit."""

import gc
import weakref
from functools import partial

import numpy as np
import pytest
from sphere_truths import pushed_north, turned, twisted

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.flips.guard import StepGuard
from omtwarp.mesh.shapes import icosphere, random_sphere
from omtwarp.options import Cost
from omtwarp.transport.flow import _Flow, optimal_transport


def flow_of_a_twist(device: str, cost: str = "squared", scheme: str = "default") -> _Flow:
    """From a twist that the guard has to hold back here and there."""
    surface = random_sphere(900, seed=3)
    start, initial = pushed_north(surface.vertices, 0.5), twisted(surface.vertices, 1.6)
    maps = [vectors(points, resolve_device(device)) for points in (start, initial)]
    return _Flow(surface, *maps, cost, scheme, target=None)


@pytest.mark.parametrize("cost", tuple(Cost))
@pytest.mark.parametrize("scheme", ("default", "plain"))
def test_recorded_and_step_by_step_are_the_same_to_the_bit(device, cost, scheme, monkeypatch):
    """The recorded one makes four iterations at a time in nested loops on the device, the other one after the other."""
    monkeypatch.setattr("omtwarp.transport.flow.ITERATIONS_AT_ONCE", 4)
    monkeypatch.setenv("OMTWARP_THREADS", "1")  # a launch cut into parts would be recorded by several threads
    ends = []
    for record in (False, True):
        flow = flow_of_a_twist(device, cost, scheme)
        told: list[int] = []
        tell = partial(lambda told, stage, done, most, details: told.append(done), told)
        converged = flow.run(flow.iterations(record), 23, 1e-4, tell)
        assert told == list(range(len(flow.history)))
        ends.append((flow.points.numpy().copy(), flow.history, converged))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1:] == ends[1][1:]
    assert len(ends[0][1]) > 4
    assert any(record["held"] for record in ends[0][1])


@pytest.mark.parametrize("scheme", ("default", "plain"))
def test_an_iteration_reads_nothing_back_and_allocates_nothing(device, scheme, monkeypatch):
    flow = flow_of_a_twist(device, scheme=scheme)
    flow.iterations()
    flow.prepare(60, 0.0)
    flow.running.fill_(1)
    flow.iterate()  # loads what has to be loaded
    before = flow.points.numpy().copy()

    def refuse(*arguments, **named):
        raise AssertionError("an iteration went to the host, or for memory")

    with monkeypatch.context() as patch:
        for name in ("empty", "zeros", "empty_like", "zeros_like", "clone", "synchronize", "synchronize_device"):
            patch.setattr(wp, name, refuse)
        for name in ("numpy", "list", "assign"):
            patch.setattr(wp.array, name, refuse)
        flow.iterate()
    assert (flow.points.numpy() != before).any()
    assert flow.state.numpy()["iteration"][0] == 2


def test_the_same_flow_can_be_run_again(device):
    """What is left from the first run has no say in the second."""
    flow = flow_of_a_twist(device)
    iterations, initial = flow.iterations(), wp.clone(flow.points)
    ends = []
    for _ in range(2):
        wp.copy(flow.points, initial)
        flow.history.clear()
        flow.run(iterations, 7, 0.0)
        ends.append((flow.points.numpy().copy(), list(flow.history)))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]


@pytest.mark.parametrize("cost", tuple(Cost))
def test_the_same_bits_twice(device, cost):
    surface = turned(icosphere(12))
    start, initial = pushed_north(surface.vertices, 0.3), twisted(surface.vertices, 0.6)
    one, two = (optimal_transport(surface, initial, start=start, cost=cost, device=device) for _ in range(2))
    np.testing.assert_array_equal(one.sphere, two.sphere)
    assert one.history == two.history


def test_memory_is_given_back_at_once(device):
    """Not when Python next looks for cycles: the arrays of a large mesh are large."""
    flow = flow_of_a_twist(device)
    flow.run(flow.iterations(), 2, 0.0)
    there = weakref.ref(flow)
    gc.disable()
    try:
        del flow
        assert there() is None
    finally:
        gc.enable()


def agree(one, two) -> None:
    one, two = np.asarray(one), np.asarray(two)
    np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12 * np.abs(two).max())


@pytest.mark.parametrize("cost", tuple(Cost))
def test_every_kernel_of_an_iteration_agrees_with_the_cpu(device, cost):
    """Each gets the CPU's input, so that nothing adds up."""
    cpu, other = (flow_of_a_twist(where, cost, "plain") for where in ("cpu", device))

    def hand_over(*names: str) -> None:
        for name in names:
            getattr(other, name).assign(getattr(cpu, name).numpy())

    def compare(*names: str) -> None:
        for name in names:
            agree(getattr(other, name).numpy(), getattr(cpu, name).numpy())
        hand_over(*names)

    sums = [flow.measure(flow.points).numpy() for flow in (cpu, other)]
    agree(*sums)
    for flow in (cpu, other):
        flow.prepare(20, 1e-3)
    compare("measured", "turned", "centres")
    for name in flow.state.numpy().dtype.names:
        assert other.state.numpy()[name][0] == pytest.approx(cpu.state.numpy()[name][0], rel=1e-12)
    hand_over("state")
    for step in ("set_gradient", "set_steepest"):
        for flow in (cpu, other):
            getattr(flow, step)()
        compare("gradient" if step == "set_gradient" else "steepest")
    for flow in (cpu, other):
        flow.grid.preconditioner.apply(flow.gradient, out=flow.image)
    compare("image")
    velocities = [flow.grid.sampler.node_gradient(flow.image) for flow in (cpu, other)]
    agree(velocities[1].numpy(), velocities[0].numpy())
    velocities[1].assign(velocities[0].numpy())
    for flow, velocity in zip((cpu, other), velocities, strict=True):
        flow.guarded = False
        flow.search(velocity)
    compare("trial")
    for name in ("cost", "area_error", "step", "slope"):
        assert other.state.numpy()[name][0] == pytest.approx(cpu.state.numpy()[name][0], rel=1e-12)
    for flow in (cpu, other):
        flow.guard.hold(flow.points, flow.trial)
    compare("trial")
    assert other.guard.held.numpy()[0] == cpu.guard.held.numpy()[0]


def test_the_guard_gives_up_after_its_last_round(device):
    """Everything goes back where it was: this step is far too long everywhere for two rounds."""
    surface = random_sphere(300, 5)
    where = resolve_device(device)
    rng = np.random.default_rng(1)
    wanted = surface.vertices + rng.normal(size=surface.vertices.shape)
    wanted /= np.linalg.norm(wanted, axis=1)[:, None]
    old, new = (wp.array(points, dtype=wp.vec3d, device=where) for points in (surface.vertices, wanted))
    guard = StepGuard(surface, where)
    guard.hold(old, new, rounds=2)
    assert guard.held.numpy()[0] == surface.vertex_count
    np.testing.assert_array_equal(new.numpy(), surface.vertices)
