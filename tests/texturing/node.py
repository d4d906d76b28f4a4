"""Readers of glTF by others, Khronos' validator and three.js, as packages of node where they are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# Where `run.py test` puts the packages; NODE_PATH may name another place.
PLACES = [str(ROOT / ".node" / "node_modules"), *filter(None, [os.environ.get("NODE_PATH")])]
NODE = shutil.which("node")
VALIDATE = """
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
validator.validateBytes(bytes, {maxIssues: 100}).then(found => console.log(JSON.stringify(found.issues)));
"""


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    assert NODE is not None
    environment = {**os.environ, "NODE_PATH": os.pathsep.join(PLACES)}
    return subprocess.run(
        [NODE, *words], capture_output=True, text=True, check=False, env=environment, cwd=ROOT, timeout=120
    )


def package(name: str) -> Path | None:
    """Find the folder of a node package; None where node or the package is not installed."""
    if NODE is None:
        return None
    found = _run("-p", f"require.resolve({name!r})")
    if found.returncode != 0:
        return None
    file = Path(found.stdout.strip())
    return next((folder for folder in file.parents if folder.name == name), None)


def validated(path: Path) -> dict[str, Any]:
    """What Khronos' validator has to say about a GLB file: numbers of messages, and the messages."""
    done = _run("-e", VALIDATE, str(path))
    assert done.returncode == 0, done.stderr[-1000:]
    return json.loads(done.stdout)
