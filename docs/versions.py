"""Build the documentation of several versions beside one another: ``python docs/versions.py SITE TAG [TAG ...]``.

Every tag is checked out into a folder of its own and built there, with warnings as errors; ``main`` stands for the
newest commit. ``SITE/TAG`` holds a version, ``SITE/versions.json`` names them all, and
``SITE/index.html`` leads to the first.
Versions that are in SITE already and are not named stay as they are.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
INDEX = '<!doctype html><meta charset="utf-8"><title>omtwarp</title><meta http-equiv="refresh" content="0; url={}/">\n'


def main(site: Path, tags: list[str]) -> None:
    """Build the versions and write the list of all that the site has."""
    site.mkdir(parents=True, exist_ok=True)
    for tag in tags:
        with tempfile.TemporaryDirectory() as place:
            source = Path(place) / "source"
            subprocess.run(["git", "-C", str(ROOT), "worktree", "add", "--detach", str(source), tag], check=True)
            try:
                build(source, site / tag)
            finally:
                subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(source)], check=True)
    write_list(site, tags[0])


def build(source: Path, target: Path) -> None:
    """Build a checkout; its own configuration is used, and a warning is an error.

    The pages are built in the checkout, as notebooks leave what they executed beside the folder of the pages.
    """
    pages = source / "site" / "html"
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "-b", "html", "-A", "versions=1"]
    command += [str(source / "docs"), str(pages)]
    subprocess.run(command, check=True)
    if target.exists():
        shutil.rmtree(target)
    shutil.move(pages, target)


def write_list(site: Path, first: str) -> None:
    """Write the list of versions, the newest first, and the page that leads to one of them."""

    def age(name: str) -> tuple[int, list[int]]:
        numbers = [int(word) for word in re.findall(r"\d+", name)]
        return (0 if numbers else 1, numbers)  # what has no number is the newest: main

    folders = [entry.name for entry in site.iterdir() if (entry / "index.html").is_file()]
    names = sorted(folders, key=age, reverse=True)
    listed = [{"name": name, "folder": name} for name in names]
    (site / "versions.json").write_text(json.dumps(listed, indent=1) + "\n", "utf-8")
    (site / "index.html").write_text(INDEX.format(first), "utf-8")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2:])
