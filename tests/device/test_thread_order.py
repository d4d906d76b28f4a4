"""Maps are the same bits whichever thread of a launch runs first.

Warp's CPU runs the threads of a launch one after the other, first to last. Here another process runs them last to
first, with kernels compiled for that: what depends on the order is a race on a GPU.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FORWARDS = "for (size_t task_index = 0; task_index < dim->size; ++task_index)\n    {{\n"
BACKWARDS = (
    "for (size_t turn = 0; turn < dim->size; ++turn)\n    {{\n        const size_t task_index = dim->size - 1 - turn;\n"
)
VARIANTS = ({"refine": "balanced"}, {"exact": True}, {"scheme": "plain"}, {"scheme": "paper"})


def digests() -> list[str]:
    """Hashes of all stages of maps on the fake device."""
    from fake_device import install

    from omtwarp.mapping.pipeline import map_to_sphere
    from omtwarp.mesh.shapes import blob

    surface = blob(seed=11, amplitude=0.4, sphere=1500)
    with pytest.MonkeyPatch.context() as monkeypatch:
        install(monkeypatch)
        maps = [map_to_sphere(surface, device="cuda:0", **options) for options in VARIANTS]
    stages = (getattr(result, name) for result in maps for name in ("conformal", "transported", "sphere"))
    return [hashlib.sha256(np.ascontiguousarray(stage).tobytes()).hexdigest() for stage in stages]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_maps_do_not_depend_on_the_order_of_threads():
    environment = os.environ | {
        "WARP_CACHE_PATH": str(ROOT / ".warp" / "backwards"),
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
    }
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", __file__], capture_output=True, text=True, env=environment, check=False
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert ended.stdout.split() == digests()


if __name__ == "__main__":
    import warp._src.codegen as codegen

    assert codegen.cpu_module_template_forward.count(FORWARDS) == 1
    codegen.cpu_module_template_forward = codegen.cpu_module_template_forward.replace(FORWARDS, BACKWARDS)
    print("\n".join(digests()))
