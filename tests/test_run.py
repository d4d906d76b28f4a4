"""What run.py does of its own: checks side by side, their messages in order, and the exit status."""

from __future__ import annotations

import importlib.util
import subprocess
from pathlib import Path

import pytest

CHECKS = ["lint", "format", "types", "kernels", "dead code"]


@pytest.fixture
def script(monkeypatch):
    """run.py with nothing to set up, and with checks and steps that only are noted, in ``ran``."""
    specification = importlib.util.spec_from_file_location("run", Path(__file__).parent.parent / "run.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    module.ran, module.statuses = [], {}

    def ended(command: list) -> int:
        module.ran.append(" ".join(map(str, command)))
        return next((status for word, status in module.statuses.items() if word in module.ran[-1]), 0)

    def quiet(command, cwd, environment):
        assert "PYTHONDONTWRITEBYTECODE" not in environment
        return subprocess.CompletedProcess(command, ended(command), f"of {command[2]}\n")

    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    for name in ("install", "system_packages", "node_packages"):
        monkeypatch.setattr(module, name, lambda *_: {})
    monkeypatch.setattr(module, "quiet", quiet)
    monkeypatch.setattr(module, "run", lambda step, environment: ended(step))
    return module


def headings(said: str) -> list[str]:
    return [line.split(":")[1].strip() for line in said.splitlines() if line.count(":") > 1]


def test_every_check_is_made_and_said_in_order(script, capsys):
    assert script.test(["-x"]) == 0
    out, err = capsys.readouterr()
    assert headings(err) == [*CHECKS, "tests", "size"] and err.endswith("run.py: all green\n")
    assert out.splitlines() == ["of ruff", "of ruff", "of mypy", "of omtwarp.device.prewarm", "of vulture"]
    assert any("pytest" in command and command.endswith(" -x") for command in script.ran)


def test_later_steps_run_after_one_that_failed(script, capsys):
    script.statuses = {"mypy": 2, "pytest": 1}
    assert script.test([]) == 2
    assert capsys.readouterr().err.endswith("run.py: failed: types, tests\n")
    assert len(script.ran) == len(CHECKS) + 2


@pytest.mark.parametrize(("word", "status", "last"), [("mypy", -2, "vulture"), ("pytest", 143, "pytest")])
def test_an_interruption_ends_all(script, word, status, last):
    script.statuses = {word: status}
    assert script.test([]) == abs(status) % 256 + 128 * (status < 0)
    assert all("count.py" not in command for command in script.ran) and any(last in command for command in script.ran)


def test_a_set_up_that_fails_is_one_line(script, monkeypatch, capsys):
    def fails(extras):
        raise script.SetupError("there is no network")

    monkeypatch.setattr(script, "install", fails)
    monkeypatch.setattr(script, "make_environment", lambda: None)
    assert script.main(["test"]) == 1
    assert capsys.readouterr().err == "run.py: error: there is no network\n" and not script.ran
