"""Every kernel compiles for CUDA, which needs Warp's compiler but no device."""

import importlib
import re

import pytest
import warp._src.context as context

from omtwarp.device.prewarm import kernel_modules
from omtwarp.device.start import wp


@pytest.mark.skipif(not context.runtime.nvrtc_supported_archs, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("name", kernel_modules())
def test_kernels_compile_for_cuda(name, tmp_path):
    module = importlib.import_module(name)
    (ptx,) = wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    text = ptx.read_text()
    assert ".visible .entry" in text
    # Sums of floating point numbers in the order of arrival would differ from run to run.
    assert not re.findall(r"\b(?:atom|red)\.\S*add\S*\.f\d+.*", text)
