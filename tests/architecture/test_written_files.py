"""Files for users are written by `eventsrc.base.user_files` alone."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
OWN_WAY = {
    "eventsrc/envelope/grey_images.py": "into memory",
    "eventsrc/log/log_identity.py": "caches, renamed when they are whole",
    "eventsrc/log/away.py": "a segment of an archive, into a temporary folder",
    "eventsrc/log/archived_history.py": "a packed file, into a temporary folder; parts of caches",
    "eventsrc/log/durable_files.py": "copies of a log's own files",
    "eventsrc/record/importers/bag_files.py": "a bag, unpacked into a temporary folder",
    "projections/adapters/rerun/rrd_recording.py": "into a pipe",
    "projections/localize/evaluate/evaluation.py": "into memory",
    "projections/adapters/drawing/sheet.py": "into memory",
    "projections/adapters/drawing/merge_picture.py": "by Sheet",
    "projections/adapters/drawing/map_picture.py": "by Sheet",
    "projections/store/kept_files.py": "members of an archive that log_identity.py opened",
    "projections/postgres/embedded.py": "locks and the server's log",
    "projections/postgres/server_user.py": "renamed when it is whole",
    "projections/surfaces/cli/program.py": "/dev/null",
    "projections/surfaces/demo/recorded_run.py": "a lock, and what a running child process says",
}
"""Modules that write otherwise, and what."""
_WRITERS = {"write_text", "write_bytes", "savefig", "imwrite", "tofile", "save", "savez"}
_WRITING = re.compile(r"[rb+]*[wxa][wxabt+]*")


def _writes(source: str) -> Iterator[str]:
    if not any(name in source for name in ("open", *_WRITERS)):  # parsing takes time
        return
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        modes = [*node.args, *(each.value for each in node.keywords if each.arg == "mode")]
        texts = [each.value for each in modes if isinstance(each, ast.Constant)]
        opens = name in ("open", "fdopen", "NamedTemporaryFile")
        if name in _WRITERS or (
            opens and any(isinstance(text, str) and _WRITING.fullmatch(text) for text in texts)
        ):
            yield name


def test_writes_are_found() -> None:
    source = """
path.write_text("")
open(path, "w")
path.open(mode="ab")
path.open("rb")
file.write(data)
"""
    assert [*_writes(source)] == ["write_text", "open", "open"]


def test_no_other_module_writes_files() -> None:
    files = [
        path for folder in ("eventsrc", "projections") for path in (ROOT / folder).rglob("*.py")
    ]
    assert len(files) > 300
    writing = {
        str(path.relative_to(ROOT)) for path in files if any(_writes(path.read_text("utf-8")))
    }
    assert writing == {*OWN_WAY}, "use written_whole or write_files, or say above what it writes"
