"""The pass over a GPU runs without one: on the CPU, with parts that fail or hang, and from wheels in parts."""

import ctypes
import importlib.util
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fake_cudss import FakeCudss

from omtwarp.solvers import cudss

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / ".ci" / "gpu.py"
if not SCRIPT.is_file():
    pytest.skip("the script is not beside the tests", allow_module_level=True)


def load(file: Path):
    """Load a script, which is no module of the package."""
    specification = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(specification)
    sys.modules[file.stem] = module  # where its dataclasses look for their types
    specification.loader.exec_module(module)
    return module


gpu = load(SCRIPT)


def python(*lines: str) -> list[str]:
    return [sys.executable, "-c", "\n".join(lines)]


def test_a_whole_pass_on_the_cpu(tmp_path, capsys, monkeypatch):
    """Every part has a result: the device is the CPU, so that maps are the same.

    Parts run in this process, but for the shortest: a new one takes more than a second to begin.
    """
    run_part, script = gpu.run_part, [sys.executable, "-P", str(SCRIPT)]

    def run_here(part: gpu.Planned, seconds: float) -> dict[str, object]:
        assert part.command[:3] == script
        if part.name == "copies":
            return run_part(part, seconds)
        before = capsys.readouterr().out
        assert gpu.main(part.command[3:]) == 0
        found = capsys.readouterr().out
        print(before, end="")
        return {"seconds": 0.0, "result": gpu.last_record(found.splitlines())}

    monkeypatch.setattr(gpu, "run_part", run_here)
    assert gpu.main(["--device", "cpu", "--sizes", "320,500,600", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out/gpu.json").read_text())
    assert list(found) == [part.name for part in gpu.plan("cpu", (320, 500, 600), None)]
    assert not [name for name, record in found.items() if "error" in record]
    for kind in gpu.VARIANTS:
        record = found["agreement, 320 faces"]["result"][kind]
        assert record["same bits twice"] and record["bijective"] and record["from the CPU, sphere"] == 0.0
    assert found["stages, 600 faces"]["result"]["cpu"].keys() >= {"conformal", "omt", "whole map"}
    page = (tmp_path / "out/gpu.html").read_text()
    assert all(f"<h2>{name} (" in page for name in found)
    assert "written" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_parts_on_the_fake_device(fake):
    """What the parts say of a device that is another one than the CPU."""
    *_, record = gpu.compare("cuda:0", 320)
    assert set(record) == set(gpu.VARIANTS)
    for kind in record.values():
        assert kind["same bits twice"] and 0.0 <= kind["from the CPU, sphere"] < 1e-10
    *_, times = gpu.time_stages("cuda:0", 320)
    assert list(times) == ["cuda:0", "cpu"]
    assert fake.downloads


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_solvers_are_compared_on_cuda_alone(fake, monkeypatch):
    library = FakeCudss()
    monkeypatch.setattr(cudss, "load_library", lambda: library)
    *_, record = gpu.compare_solvers("cuda:0", 320)
    assert list(record) == ["cholesky", "cudss"]
    for kind in record.values():
        assert kind["same bits twice"] and kind["from the default"] < 1e-10
    names = [[part.name for part in gpu.plan(device, (320, 400), None)] for device in ("cpu", "cuda:0")]
    assert set(names[1]) - set(names[0]) == {"solvers, 400 faces"}


def test_a_part_that_fails_hangs_or_crashes_leaves_what_it_had_found():
    found = "print('{\"first\": 1}', flush=True)"
    broken = 'print(\'{"second": 2, "third\', flush=True)'
    failed = gpu.run_part(gpu.Planned("", python(found, broken, "raise SystemExit('no memory')"), 60.0), 60.0)
    assert failed["result"] == {"first": 1} and failed["error"] == "exit status 1: no memory"
    late = gpu.run_part(gpu.Planned("", python(found, "import time", "time.sleep(60)"), 60.0), 2.0)
    assert late["result"] == {"first": 1} and late["error"] == "ended after 2 s"
    crashed = gpu.run_part(gpu.Planned("", python("import os", "os.abort()"), 60.0), 60.0)
    assert crashed["result"] is None and crashed["error"].startswith("exit status -6")
    text = gpu.run_part(gpu.Planned("", python("print('3 passed, 1 skipped in 2 s')"), 60.0), 60.0)
    assert text["result"] == {"output": "3 passed, 1 skipped in 2 s"} and "error" not in text


def test_results_are_written_after_every_part(tmp_path, monkeypatch):
    """One that fails does not end the pass; those without time are named; without a device nothing more is tried."""
    parts = [
        gpu.Planned("one", python('print(\'{"a": {"b": 1.5, "c": true}}\')'), 60.0),
        gpu.Planned("two", python("raise SystemExit('<no> kernel')"), 60.0),
        gpu.Planned("three", python("print(1)"), 60.0),
    ]
    monkeypatch.setattr(gpu, "plan", lambda *_: parts)
    known = []
    written = gpu.write_results
    monkeypatch.setattr(
        gpu, "write_results", lambda folder, results: (written(folder, results), known.append(len(results)))
    )
    assert gpu.main(["--out", str(tmp_path)]) == 1
    assert known == [1, 2, 3]
    page = (tmp_path / "gpu.html").read_text()
    assert "<td>1.5</td><td>yes</td>" in page and "&lt;no&gt; kernel" in page
    assert gpu.main(["--out", str(tmp_path), "--seconds", "1"]) == 1
    record = json.loads((tmp_path / "gpu.json").read_text())
    assert {entry["error"] for entry in record.values()} == {"left out: no time was left"}
    parts[0] = gpu.Planned("device", python("raise SystemExit('no device')"), 60.0)
    assert gpu.main(["--out", str(tmp_path)]) == 1
    assert list(json.loads((tmp_path / "gpu.json").read_text())) == ["device"]


def test_sizes_that_make_no_sense_are_refused(capsys):
    with pytest.raises(SystemExit):
        gpu.main(["--sizes", "2000"])
    assert "two numbers of faces" in capsys.readouterr().err


def test_without_a_card_there_is_one_line_and_a_status():
    module = load(ROOT / "run.py")
    if module.have_card():
        pytest.skip("this machine has a card")
    ended = subprocess.run([sys.executable, ROOT / "run.py", "gpu"], capture_output=True, text=True, check=False)
    assert ended.returncode == module.NO_CARD == 3
    assert ended.stdout == "" and len(ended.stderr.splitlines()) == 1 and "no NVIDIA card" in ended.stderr


@pytest.mark.parametrize(("status", "cards", "there"), [(0, 1, True), (0, 0, False), (100, 1, False)])
def test_a_driver_without_cards_is_no_card(monkeypatch, status, cards, there):
    class Driver:
        """What the driver's library answers."""

        def cuInit(self, flags):
            return status

        def cuDeviceGetCount(self, count):
            count._obj.value = cards
            return 0

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    assert load(ROOT / "run.py").have_card() is there


def test_wheels_are_joined_and_installed_without_a_network(tmp_path, monkeypatch):
    module = load(ROOT / "run.py")
    made = subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], capture_output=True, check=False)
    if made.returncode != 0:
        pytest.skip("this Python cannot make environments")
    inside = module.PYTHON.relative_to(module.VENV)
    monkeypatch.setattr(module, "VENV", tmp_path / "venv")
    monkeypatch.setattr(module, "PYTHON", tmp_path / "venv" / inside)
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    with pytest.raises(module.SetupError, match="no wheels"):
        module.install_wheels(wheels)
    whole = tmp_path / "whole.zip"
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr("answer.py", "number = 42\n")
        about = "answer-1.0.dist-info"
        archive.writestr(
            f"{about}/METADATA", "Metadata-Version: 2.1\nName: answer\nVersion: 1.0\nRequires-Dist: absent\n"
        )
        archive.writestr(
            f"{about}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr(f"{about}/RECORD", "")
    content = whole.read_bytes()
    for number, begin in enumerate(range(0, len(content), 100)):
        (wheels / f"answer-1.0-py3-none-any.whl.part{number:02}").write_bytes(content[begin : begin + 100])
    module.install_wheels(wheels)
    code = "import answer, omtwarp; print(answer.number, omtwarp.__file__)"
    said = subprocess.run([module.PYTHON, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert said.stdout.split() == ["42", str(ROOT / "omtwarp/__init__.py")]
