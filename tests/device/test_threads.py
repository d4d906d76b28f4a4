"""Work on several threads gives the same results as on one."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from omtwarp.conformal import conformal_map
from omtwarp.device import policy, threads
from omtwarp.device.start import wp
from omtwarp.mesh.shapes import blob
from omtwarp.moser import moser_map


def test_every_job_is_done_once_and_in_order():
    assert threads.run_all(lambda job: job * job, list(range(50))) == [k * k for k in range(50)]


def test_an_error_in_a_thread_reaches_the_caller():
    def fail(job):
        raise ValueError(f"job {job}")

    with pytest.raises(ValueError, match="job 0"):
        threads.run_all(fail, [0, 1, 2])


def test_the_number_of_threads_changes_no_bit(monkeypatch):
    surface = blob(seed=3, sphere=20_000)
    start = conformal_map(surface)
    maps = []
    for count in (1, 2, 5):
        monkeypatch.setattr(threads, "core_count", lambda count=count: count)
        maps.append(moser_map(surface, start.sphere, solver=start.solver).sphere)
    np.testing.assert_array_equal(maps[0], maps[1])
    np.testing.assert_array_equal(maps[0], maps[2])


def test_cores_can_be_limited(monkeypatch):
    monkeypatch.setenv("OMTWARP_THREADS", "1")
    assert threads.core_count() == 1
    monkeypatch.setenv("OMTWARP_THREADS", "many")
    assert 1 <= threads.core_count() <= (os.cpu_count() or 1)


def test_parts_cover_all_elements_on_every_device(device):
    from omtwarp.wavelets.kernels import scale_values

    size = 3 * policy.SMALLEST_SHARED_LAUNCH + 1
    factors = wp.array(np.full(size, 3.0), dtype=wp.float64, device=device)
    values = wp.array(np.arange(size, dtype=np.float64), dtype=wp.float64, device=device)
    threads.launch_parts(scale_values, size, threads.each(factors, values), [], device)
    np.testing.assert_array_equal(values.numpy(), 3.0 * np.arange(size))


def test_blas_threads_are_put_back():
    def counts():
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = counts()
    with threads.blas_threads(1):
        assert set(counts()) <= {1}
        with threads.blas_threads(2):
            pass
        assert set(counts()) <= {1}
    assert counts() == before


def test_the_limit_of_blas_lasts_until_the_last_of_several_threads_ends():
    def counts():
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    def first():
        with threads.blas_threads(1):
            both.wait()
        ended.set()

    def second():
        with threads.blas_threads(1):
            both.wait()
            ended.wait()
            within.extend(counts())

    before, within = counts(), []
    both, ended = threading.Barrier(2), threading.Event()
    workers = [threading.Thread(target=work) for work in (first, second)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert set(within) <= {1} and counts() == before


@wp.kernel
def double_kernel(source: wp.array[wp.float64], target: wp.array[wp.float64]):
    i = wp.tid()
    target[i] = source[i] + source[i]


def test_a_kernel_is_compiled_once_for_all_threads(monkeypatch):
    import warp._src.context as context

    built = []
    build = context.Module._compile

    def note(self, *arguments, **named):
        if self is double_kernel.module:
            built.append(threading.current_thread())
        return build(self, *arguments, **named)

    monkeypatch.setattr(context.Module, "_compile", note)
    monkeypatch.setattr(threads, "core_count", lambda: 3)
    source = wp.array(np.arange(10.0), dtype=wp.float64, device="cpu")
    target = wp.zeros(10, dtype=wp.float64, device="cpu")
    threads.launch_parts(double_kernel, 10, threads.each(source), threads.each(target), "cpu", least=1)
    np.testing.assert_array_equal(target.numpy(), 2.0 * np.arange(10.0))
    assert built == [threading.current_thread()]


def test_fronts_are_compiled_before_threads_share_them(tmp_path):
    """With an empty cache of kernels, a first factorisation on several threads compiles before the threads start."""
    program = """
import threading
import warp._src.build as build
import numpy as np
from omtwarp.device import policy, threads
from omtwarp.solvers.cholesky import MultifrontalCholesky, surface_dissection
from omtwarp.mesh.shapes import blob

compiled, made = [], build.build_cpu
build.build_cpu = lambda *a, **k: (compiled.append(threading.current_thread().name), made(*a, **k))[1]
threads.core_count = lambda: 2
surface = blob(seed=1, sphere=20_000)
edges = surface.edges
solver = MultifrontalCholesky(surface_dissection(surface), threads=2)
assert len(solver._jobs) > 1
solver.factorise((np.full(len(surface.vertices), 100.0), np.full(len(edges), -1.0)))
assert set(compiled) == {"MainThread"}, compiled
"""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)
