"""The table of kinds: what can go wrong without a word, and the file that tries it."""

import ast
from pathlib import Path

KINDS = {
    "meshes that are hard to map": "test_hostile_meshes",
    "files that are cut, endless, compressed or in another encoding": "test_inputs",
    "files that announce more than they hold": "test_announced",
    "files that name other files": "test_references",
    "places that cannot be written to, or hold what is the user's": "test_outputs",
    "what a command may replace": "test_replacing",
    "files of the working folder that Python would import": "test_working_folder",
    "what commands open, start and import": "test_audit",
    "streams, terminals, homes and caches": "test_environments",
    "interruptions, folders, damaged maps and limits": "test_commands",
    "jobs in the background": "test_background",
    "values and state files of wrong form": "test_state",
    "text that would become a part of a page": "test_reports",
    "files and options made at random": "test_generated",
}


def test_every_file_of_the_folder_is_a_kind_and_has_tests():
    files = {file.stem: file for file in Path(__file__).parent.glob("test_*.py") if file != Path(__file__)}
    assert set(KINDS.values()) == set(files)
    for file in files.values():
        names = [node.name for node in ast.parse(file.read_text("utf-8")).body if isinstance(node, ast.FunctionDef)]
        assert any(name.startswith("test_") for name in names), file
