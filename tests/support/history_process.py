"""A process of its own that asks a log for its history, for tests that limit or kill it."""

import json
import os
import resource
import signal
import sys
import zipfile
from pathlib import Path
from unittest.mock import patch

from projections.fold.settings import Settings
from projections.history import Timeline
from projections.history.merges import merge_document
from projections.map.digest import map_digest

RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)
FILE_BYTES = 20_000
"""What a file may take at most for a process whose disk is full."""


def answers(log: Path, notes: list[str]) -> str:
    """Some answers as text; the history is kept however short it is."""
    with (
        patch("projections.store.timeline_cache.MIN_EVENTS", 1),
        Timeline(log, RULES, note=notes.append) as timeline,
    ):
        history = timeline.history
        merges = [merge_document(history, merge) for merge in timeline.merges()]
        digests = [map_digest(timeline.at(end)) for end in range(0, timeline.end, 60)]
    return json.dumps([merges, digests])


def main() -> None:
    """Print the answers of a log to stdout and the notes to stderr. ``full`` limits the size of
    files, ``killed N`` ends this process by SIGKILL when it writes the N-th array."""
    log, how = Path(sys.argv[1]), sys.argv[2]
    if how == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
    if how == "killed":
        _die_at_array(int(sys.argv[3]))
    notes: list[str] = []
    sys.stdout.write(answers(log, notes))
    sys.stderr.write("\n".join(notes))


def _die_at_array(number: int) -> None:
    write, written = zipfile.ZipFile.writestr, [0]

    def count(archive: zipfile.ZipFile, name: zipfile.ZipInfo, content: bytes) -> None:
        written[0] += 1
        write(archive, name, content)
        if written[0] == number:
            os.kill(os.getpid(), signal.SIGKILL)

    patch.object(zipfile.ZipFile, "writestr", count).start()
