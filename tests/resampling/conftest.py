"""The average subject that nilearn ships, and Connectome Workbench where it is installed."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def nilearn_fsaverage5():
    """A function that reads a surface (points, faces) or data of nilearn's fsaverage5 by its name."""
    found = importlib.util.find_spec("nilearn")
    if found is None or found.origin is None:
        pytest.skip("nilearn is not installed, which ships fsaverage5")
    nibabel = pytest.importorskip("nibabel")
    folder = Path(found.origin).parent / "datasets" / "data" / "fsaverage5"

    def read(name: str):
        image = nibabel.load(folder / f"{name}.gii.gz")
        if image.get_arrays_from_intent("pointset"):
            points, faces = image.agg_data("pointset"), image.agg_data("triangle")
            return np.asarray(points, dtype=np.float64), np.asarray(faces)
        return np.asarray(image.agg_data(), dtype=np.float64)

    return read


@pytest.fixture
def workbench():
    """A function that runs wb_command."""
    program = shutil.which("wb_command")
    if program is None:
        pytest.skip("Connectome Workbench is not installed: apt-get install connectome-workbench")

    def run(*words: object) -> str:
        done = subprocess.run([program, *map(str, words)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run
