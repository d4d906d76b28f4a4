"""Kernels are compiled once: a second map in a process, whatever its mesh and options, finds all of them ready."""

import pytest

from omtwarp.device.prewarm import prewarm
from omtwarp.device.start import wp
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.shapes import blob


def test_a_second_map_makes_no_kernel_and_compiles_none(device, monkeypatch):
    import warp._src.build as build
    import warp._src.context as context

    def options():
        return [{"cost": "squared"}, {"cost": "geodesic", "refine": "balanced"}, {"scheme": "plain", "refine": "none"}]

    prewarm(device)  # also what only some meshes need, such as untangling
    first = blob(seed=1, amplitude=0.5, sphere=500)
    for chosen in options():
        map_to_sphere((first.vertices, first.faces), device=device, **chosen)

    def refuse(*arguments, **named):
        raise AssertionError("a kernel was made or compiled by a second map")

    monkeypatch.setattr(context.Module, "_compile", refuse)
    monkeypatch.setattr(build, "build_cpu", refuse)
    monkeypatch.setattr(build, "build_cuda", refuse)
    monkeypatch.setattr(wp.Kernel, "__init__", refuse)
    second = blob(seed=2, amplitude=0.5, sphere=1300)
    for chosen in options():
        result = map_to_sphere((second.vertices, second.faces), device=device, **chosen)
        assert result.bijective


def test_the_hooks_above_are_those_that_compilation_uses(monkeypatch, tmp_path):
    """The methods that the test above replaces are those that compile: were one renamed, that test could not fail."""
    import importlib.util

    import warp._src.context as context

    source = tmp_path / "fresh_kernel.py"
    source.write_text(
        "import warp as wp\n\n\n@wp.kernel\ndef fresh(values: wp.array[wp.float64]):\n"
        f"    values[wp.tid()] = wp.float64({id(source) % 1_000_003}.0)\n"
    )
    calls = []

    def note(self, *arguments, **named):
        calls.append(self.name)
        raise InterruptedError

    made = wp.Kernel.__init__
    monkeypatch.setattr(context.Module, "_compile", note)
    monkeypatch.setattr(wp.Kernel, "__init__", lambda self, *a, **k: (calls.append("made"), made(self, *a, **k))[1])
    spec = importlib.util.spec_from_file_location("fresh_kernel", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with pytest.raises(InterruptedError):
        wp.launch(module.fresh, dim=1, inputs=[wp.zeros(1, dtype=wp.float64, device="cpu")], device="cpu")
    assert calls[0] == "made" and len(calls) == 2
