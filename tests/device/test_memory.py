"""The host memory of a map, and shared workspaces."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omtwarp.device.arrays import Workspace

# In a process of its own: what other tests have freed, and what they keep, is no part of a map.
MEASURE = """
import sys
sys.path.insert(0, sys.argv[1])
from benchmark import made, measure_map
from omtwarp.solvers.cholesky.dissection import surface_dissection
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky
from omtwarp.solvers.cholesky.saddle import expand
measure_map(made("blob", 2000), "cpu", "none")
surface = made("blob", 20_000)
peak = measure_map(surface, "cpu", "none")["peak_bytes"]
factor = MultifrontalCholesky(expand(surface_dissection(surface))[0], single=True)  # the largest
print((peak - 8 * len(factor._factor) - 4 * factor._length) / surface.vertex_count)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a process what it held at most")
def test_a_map_takes_six_kilobytes_per_vertex_beside_its_largest_factor():
    command = [sys.executable, "-c", MEASURE, str(Path(__file__).parents[2] / "examples")]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    # Less than what one array of nine numbers per vertex takes is no measurement.
    assert 72 < float(out) < 6000  # 3,800 with the order of the saddle-point unknowns and the matrices themselves


def test_room_is_shared_and_grows():
    workspace = Workspace()
    first = workspace.numbers(10)
    first[:] = np.arange(10)
    assert np.shares_memory(first, workspace.numbers(4))
    np.testing.assert_array_equal(workspace.numbers(4), [0, 1, 2, 3])
    larger = workspace.numbers(1000)
    assert larger.shape == (1000,) and larger.dtype == np.float64
    assert not np.shares_memory(first, larger)
    np.testing.assert_array_equal(first, np.arange(10))  # whoever still has it may read it
    assert np.shares_memory(larger, workspace.numbers(10))
