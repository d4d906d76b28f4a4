"""The benchmark measures what it says; no test depends on the speed of the machine."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import benchmark
from benchmark import label, made, main, markdown, parse_sizes, reference_system, run
from benchmark_measure import (
    LISTED,
    PeakMemory,
    copy_bandwidth,
    first_use,
    moved_bytes,
    recorded_launches,
    splu_reference,
    table,
)

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.wavelets.kernels import scale_values


@pytest.fixture(scope="module")
def result():
    return run(
        sizes=(400, 800), meshes=[(icosphere(4).vertices, icosphere(4).faces)], repeats=2, kernels=True, refine="area"
    )


def test_every_stage_of_every_mesh_is_measured(result):
    assert [mesh["name"] for mesh in result["meshes"]][:1] == [f"blob_{result['meshes'][0]['faces']}"]
    assert [mesh["family"] for mesh in result["meshes"]] == ["blob", "blob", "mesh 1"]
    for mesh in result["meshes"]:
        (one,) = mesh["runs"]
        assert [stage["name"] for stage in one["stages"]] == ["conformal", "omt", "refine", "optimality", "other"]
        assert one["device"] == "cpu" and one["flips"] == 0 and one["bijective"]
        assert mesh["splu"]["seconds"] > 0 and one["ratio"] > 0
        assert 3 * mesh["vertices"] == 1.5 * mesh["faces"] + 6
        # Medians of parts need not add up to the median of the whole, but no part is longer than all maps together.
        assert all(stage["seconds"] < 2 * 2 * one["seconds"] for stage in one["stages"])


def test_a_result_is_json_and_markdown(result):
    assert json.loads(json.dumps(result)) == result
    text = markdown(result)
    for heading in ("Seconds on the wall", "one SciPy `splu`", "| CPU / splu |", "a plain copy moves"):
        assert heading in text
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.endswith("|")
    assert "no CUDA device" in text or result["machine"]["gpus"]


def test_kernels_of_all_stages_are_recorded(result):
    (kernels,) = result["kernels"]
    names = {row["name"] for row in kernels["kernels"]}
    assert {
        "moser.integrate_particles",
        "optimal.kernels.transport_gradient",
        "optimal.shape_kernels.triangle_hessian",
    } <= names
    for row in kernels["kernels"]:
        assert row["launches"] > 0
        assert (row["bytes"] > 0) == (f"omtwarp.{row['name']}" not in LISTED)
        assert row["part_of_copy"] == pytest.approx(row["bytes"] / row["seconds"] / kernels["bandwidth"])


def test_the_reference_is_a_factorisation_of_the_same_laplacian():
    surface = blob(seed=0, sphere=320)
    matrix, right = reference_system(surface)
    whole = cotangent_laplacian(surface.scaled_vertices, surface.faces).toarray()
    np.testing.assert_array_equal(matrix.toarray(), whole[1:, 1:])
    wall, cpu = splu_reference(matrix, right)
    assert wall > 0.0 and cpu >= 0.0 and math.isfinite(wall + cpu)


def test_a_clock_that_counted_nothing_gives_no_ratio(monkeypatch):
    monkeypatch.setattr(benchmark, "splu_reference", lambda *_: (1e-3, 0.0))
    ball = icosphere(2)
    (mesh,) = run(sizes=(), meshes=[(ball.vertices, ball.faces)], repeats=1)["meshes"]
    assert mesh["runs"][0]["cpu_ratio"] is None and mesh["runs"][0]["ratio"] > 0.0


def test_moved_bytes_by_hand():
    size = 5000
    factors = wp.zeros(size, dtype=wp.float64, device="cpu")
    points = wp.zeros(100 * size, dtype=wp.vec3d, device="cpu")
    assert moved_bytes(size, [factors, factors, 3, wp.float64(1.0)]) == 8 * size  # the same array counts once
    assert moved_bytes(size, [factors, points]) == 8 * size + 16 * 24 * size  # no more than the threads can touch
    assert moved_bytes(1, [points]) == 24 * 100 * size  # a thread that walks through all of it


def test_recording_changes_no_result_and_ends(device):
    launch = wp.launch
    factors = wp.array(np.full(5000, 2.0), dtype=wp.float64, device=device)
    values = wp.array(np.arange(5000.0), dtype=wp.float64, device=device)
    with recorded_launches(device) as kernels:
        wp.launch(scale_values, dim=5000, inputs=[factors, values], device=device)
        wp.launch(scale_values, dim=5000, inputs=[factors], outputs=[values], device=device)
    assert wp.launch is launch
    np.testing.assert_array_equal(values.numpy(), 4.0 * np.arange(5000.0))
    (record,) = kernels.values()
    assert record.launches == 2 and record.threads == 10_000 and record.bytes == 2 * 2 * 8 * 5000
    assert record.seconds > 0.0
    assert copy_bandwidth(device, megabytes=1) > 0.0


def test_events_are_recorded_on_the_stream_of_the_device_that_is_timed(monkeypatch):
    """Warp's default device may be another one, whose stream knows nothing of the launch."""
    recorded, launched = [], []

    class Timed:
        """A second CUDA device, which this machine need not have."""

        is_cuda = True
        stream = SimpleNamespace(record_event=recorded.append)

    device = Timed()
    monkeypatch.setattr(wp, "launch", lambda *arguments, **options: launched.append(len(recorded)))
    monkeypatch.setattr(wp, "get_device", lambda name: device)
    monkeypatch.setattr(wp, "Event", lambda where, enable_timing: [where])
    monkeypatch.setattr(wp, "synchronize_device", lambda where: None)
    monkeypatch.setattr(wp, "get_event_elapsed_time", lambda begin, end, synchronize: 3000.0)
    with recorded_launches("cuda:1") as kernels:
        wp.launch(scale_values, dim=8, device="cuda:1")
    assert recorded == [[device], [device]] and launched == [1]  # one before the launch, one after it
    (record,) = kernels.values()
    assert record.seconds == 3.0


def test_peak_memory_sees_what_was_there_for_a_moment():
    memory = PeakMemory()
    block = np.ones(8_000_000)
    del block
    peak = memory.read()
    if peak is None:
        pytest.skip("this system does not let a process forget its peak")
    assert 60e6 < peak < 200e6


@pytest.mark.parametrize(("marks", "peak"), [((100, 150), 150), ((150, 150), None), ((0, 0), None)])
def test_the_mark_of_a_memory_pool_counts_for_the_map_that_raises_it(monkeypatch, marks, peak):
    found = iter(marks)
    monkeypatch.setattr(benchmark, "most_used", lambda device: next(found))
    surface = icosphere(2)
    assert benchmark.measure_map(surface, "cpu", None)["device_bytes"] == peak


@pytest.mark.parametrize("shape", ["blob", "creature", "sphere"])
def test_made_shapes_have_about_the_faces_asked_for(shape):
    assert made(shape, 3000).face_count == pytest.approx(3000, rel=0.35)


def test_what_cannot_be_measured_is_refused():
    for wrong in ({"sizes": (10,)}, {"repeats": 0}, {"sizes": ()}, {"shapes": ("cube",)}, {"devices": ("tpu",)}):
        with pytest.raises(OmtwarpError):
            run(**({"sizes": (400,)} | wrong))


def test_first_use_runs_in_processes_of_its_own(monkeypatch):
    commands = []

    def fake(arguments, environment):
        commands.append((tuple(arguments), environment.get("WARP_CACHE_PATH")))
        return float(len(commands)), 0.5

    monkeypatch.setattr("benchmark_measure._run", fake)
    measured = first_use("cpu")
    assert measured["compile_seconds"] == 1.0 and measured["load_seconds"] == 2.0
    assert commands[0][0] == commands[1][0]
    assert commands[0][0][1] == "-P" and commands[0][0][-1] == "cpu"
    assert commands[0][1] == commands[1][1] != commands[2][1]


def test_labels_sizes_and_tables():
    assert [label(n) for n in (320, 5_120, 1_000_000, 1_310_720)] == ["320", "5k", "1M", "1.3M"]
    assert parse_sizes("5000, 20k,1.5M") == (5000, 20_000, 1_500_000)
    assert parse_sizes("none") == ()
    assert table(["a", "b"], [["1", "2"]]) == "| a | b |\n|:--|--:|\n| 1 | 2 |"


def test_the_command_writes_both_files(tmp_path, capsys):
    files = tmp_path / "b.json", tmp_path / "b.md"
    main(["--sizes", "400", "--repeats", "1", "--device", "cpu", "--json", str(files[0]), "-o", str(files[1])])
    assert json.loads(files[0].read_text())["meshes"][0]["runs"][0]["flips"] == 0
    assert files[1].read_text().startswith(json.loads(files[0].read_text())["machine"]["processor"])
    for wrong in (["--sizes", "many"], ["--sizes", "400", "--device", "tpu"]):
        with pytest.raises(SystemExit, match="2"):
            main(wrong)
    assert "not a number of faces" in capsys.readouterr().err
