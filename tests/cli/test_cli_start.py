"""The start of a command: imports without what no command uses change nothing that a command computes."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMPILED = """
import json, sys
from pathlib import Path
if sys.argv[1] == "short":
    from omtwarp.commands._start import prepare_warp
    prepare_warp()
from omtwarp.device.start import wp
from omtwarp.geometry import edge_weight_kernels
wp.load_module(edge_weight_kernels.__name__, device="cpu")
from warp._src.context import builtin_functions
objects = [file.read_bytes().hex() for file in sorted(Path(wp.config.kernel_cache_dir).rglob("*.o"))]
overloads = sum(len(getattr(found, "overloads", ())) for found in builtin_functions.values())
print(json.dumps({"names": sorted(builtin_functions), "overloads": overloads, "objects": objects}))
"""
DOCUMENTED = """
import sys
from omtwarp.commands._start import import_scipy
import_scipy()
from scipy.spatial import ConvexHull, cKDTree
assert "scipy.spatial.distance" not in sys.modules
from scipy._lib import _array_api
import scipy.spatial
print(_array_api.xp_capabilities.__name__, scipy.spatial.KDTree([[0.0]]).query([[3.0]])[0][0])
import scipy.spatial.distance
print(scipy.spatial.distance.jensenshannon([1.0, 0.0], [1.0, 0.0]), hasattr(scipy.spatial, "nothing"))
"""
LATER = """
import sys
from omtwarp.commands._start import import_scipy
import_scipy()
import numpy as np
from scipy import sparse
from scipy.linalg import cython_blas, cython_lapack
from scipy.sparse import csgraph
two = sparse.csr_matrix([[2.0, 1.0], [1.0, 3.0]])
csgraph.dijkstra(two), csgraph.minimum_spanning_tree(two), csgraph.connected_components(two)
np.unique([1, 1]), np.median([1.0, 2.0])
late = ("numpy.ma", "scipy.linalg._basic", "scipy.sparse.linalg._dsolve", "scipy.sparse.csgraph._laplacian")
assert not [name for name in late if name in sys.modules]
import scipy.linalg
from scipy.sparse.linalg import splu
print(scipy.linalg.det(two.toarray()), splu(two.tocsc()).solve(np.array([2.0, 1.0]))[0])
print(csgraph.laplacian(two).sum(), scipy.linalg.LinAlgError.__name__, hasattr(csgraph, "nothing"))
print(np.ma.masked_array([1, 2], mask=[0, 1]).sum(), np.ma.is_masked(np.ma.masked_array([1], mask=[1])))
import numpy.ma
assert all(name in sys.modules for name in late) and np.ma is sys.modules["numpy.ma"]
"""


def run(code: str, *arguments: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_kernels_are_the_same_with_the_short_list_of_built_in_functions(tmp_path):
    found = {}
    for kind in ("whole", "short"):
        found[kind] = json.loads(run(COMPILED, kind, WARP_CACHE_PATH=str(tmp_path / kind)))
    assert found["short"]["names"] == found["whole"]["names"]
    assert found["short"]["overloads"] < 0.5 * found["whole"]["overloads"]
    assert found["short"]["objects"] == found["whole"]["objects"] != []


def test_scipy_works_as_ever_after_its_shorter_import():
    assert run(DOCUMENTED).split() == ["xp_capabilities", "3.0", "0.0", "False"]


def test_parts_of_scipy_and_numpy_that_were_left_out_work_when_they_are_used():
    assert run(LATER).split() == ["5.0", "1.0", "0.0", "LinAlgError", "False", "1", "True"]
