"""An answer about W is the same whatever the log has after W: events that cannot be folded or read,
of another embedding space, conflicting, or that correct the map."""

import json
import os
import re
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.commands import Reembed, UseSettings
from eventsrc.envelope.model import DetId, Offset
from eventsrc.envelope.system_events import COMMAND_KEY, EMBEDDINGS_KEY, MAP_KEY
from eventsrc.log import NEVER, LogReader, LogWriter, Unreadable
from eventsrc.log.reader import follow
from projections.fold.objects import object_id
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope, payload
from tests.support.logs import (
    EVENTS,
    KEY,
    LEFT,
    append_command,
    append_raw,
    command,
    documents,
    forget_run,
    keep_apart,
    write_log,
)
from tests.support.thorough import THOROUGH, mostly_slow, stride

W = 24
"""The events asked about: behind the merge of two rooms, before those of the other run."""
CUP_AT = "--at", str(W)
OBJECT = object_id(DetId("cup-1"))
QUESTION = [detection("cup", [1.0, 0.0, 0.0])]
TRUTH = [
    {"run_id": "run-a", "keyframe_id": n, "room": f"room {n // 7}", "instances": []}
    for n in range(20)
]


def _other_space(log: Path) -> None:
    seen = [detection("cup", [1.0, 0.5], embedding_model="another")]
    write_log(log, [envelope(40 + n, 0.5, 0.0, detections=seen) for n in range(9)])


def _conflict(log: Path) -> None:
    write_log(log, [envelope(n, 9.0, 9.0) for n in range(5)])


def _correction(log: Path) -> None:
    append_command(log, forget_run("run-a"))
    append_command(log, keep_apart(0, 9))
    append_command(log, command(UseSettings, settings={"eps_m": 0.1}))


def _false_vectors(log: Path) -> None:
    append_raw(log, b"no vectors", key=EMBEDDINGS_KEY)
    given = {"space": "another", "dim": 3, "first": EVENTS, "end": EVENTS + 1, "detections": 1}
    append_command(log, command(Reembed, **given, sha256="0" * 64))
    append_command(log, command(UseSettings, settings={"embedding_model": "another"}))


def _newest(log: Path, suffix: str) -> Path:
    return max(log.glob(f"*{suffix}"))


def _torn(log: Path) -> None:
    with LogWriter(log, fsync=NEVER) as writer:
        for number in range(60, 90):
            writer.append(KEY, payload(envelope(number, 0.5)))
            writer.sync()
        growing = _newest(log, ".active")
        torn = growing.read_bytes()
    sealed = _newest(log, ".mcap")
    sealed.unlink()
    growing.write_bytes(torn[: len(torn) * 2 // 3])


def _rotten(log: Path) -> None:
    """A segment between others of which bytes have changed."""
    for first in (60, 70):
        write_log(log, [envelope(number, 0.5) for number in range(first, first + 10)])
    middle = sorted(log.glob("*.mcap"))[-2]
    content = bytearray(middle.read_bytes())
    content[len(content) // 8 : len(content) // 2] = os.urandom(
        len(content) // 2 - len(content) // 8
    )
    middle.write_bytes(content)


def _lost(log: Path) -> None:
    """A segment between others is not there."""
    for first in (60, 70):
        write_log(log, [envelope(number, 0.5) for number in range(first, first + 10)])
    sorted(log.glob("*.mcap"))[-2].unlink()


def _last_sealed(log: Path) -> Path:
    """A segment with events behind those that the log had."""
    write_log(log, [envelope(number, 0.5) for number in range(60, 70)])
    return _newest(log, ".mcap")


def _cut(log: Path) -> None:
    last = _last_sealed(log)
    os.truncate(last, last.stat().st_size * 2 // 3)


def _emptied(log: Path) -> None:
    os.truncate(_last_sealed(log), 0)


def _garbage(log: Path) -> None:
    last = _last_sealed(log)
    last.write_bytes(os.urandom(last.stat().st_size))


def _index_rotten(log: Path) -> None:
    last = _last_sealed(log)
    content = bytearray(last.read_bytes())
    content[-60] ^= 0xFF
    last.write_bytes(content)


def _last_lost(log: Path) -> None:
    """`.sealed.json` says that there was another segment behind."""
    _last_sealed(log).unlink()


def _two_cut(log: Path) -> None:
    for first in (60, 70):
        write_log(log, [envelope(number, 0.5) for number in range(first, first + 10)])
    for segment in sorted(log.glob("*.mcap"))[-2:]:
        os.truncate(segment, segment.stat().st_size * 2 // 3)


UNREADABLE_ENDS: dict[str, Callable[[Path], None]] = {
    "cut": _cut,
    "last lost": _last_lost,
    "emptied": _emptied,
    "garbage": _garbage,
    "index rotten": _index_rotten,
    "two cut": _two_cut,
}
"""What makes the end of a log unreadable: the last segment that was sealed."""

HINDRANCES: dict[str, tuple[Callable[[Path], None], bool]] = {
    "unfoldable": (lambda log: append_raw(log, b'{"run_id": "broken"}'), True),
    "torn": (_torn, True),
    "no map": (lambda log: append_raw(log, b"{}", key=MAP_KEY), True),
    "other space": (_other_space, True),
    "conflict": (_conflict, True),
    "rotten": (_rotten, False),
    "lost": (_lost, False),
    "no command": (lambda log: append_raw(log, b'{"kind": "later"}', key=COMMAND_KEY), False),
    "correction": (_correction, False),
    "false vectors": (_false_vectors, False),
    **{name: (spoil, False) for name, spoil in UNREADABLE_ENDS.items()},
}
"""What comes after W, and whether the commands behind it can be read."""

QUESTIONS: dict[str, tuple[str, ...]] = {
    "state": ("state", "log", *CUP_AT, "--json"),
    "state, keyframe": ("state", "log", "--at", "run-a:23", "--json"),
    "draw": ("draw", "log", *CUP_AT, "--out", "out/map.svg"),
    "merges": ("merges", "log", *CUP_AT, "--json"),
    "merges, text": ("merges", "log", *CUP_AT),
    "one merge": ("merges", "log", *CUP_AT, "--show", "1"),
    "drawn merge": ("merges", "log", *CUP_AT, "--draw", "1", "--out", "out/merge.svg"),
    "refused": ("merges", "log", *CUP_AT, "--refused", "--json"),
    "objects": ("merges", "log", *CUP_AT, "--objects", "--json"),
    "why a place": ("why", "log", LEFT, *CUP_AT, "--json"),
    "why an object": ("why", "log", OBJECT, *CUP_AT, "--json"),
    "why the same": ("why", "log", "run-a:0", "run-a:9", *CUP_AT, "--json"),
    "why unknown": ("why", "log", "run-x_p9", *CUP_AT),
    "diff": ("diff", "log", "9", str(W), "--json"),
    "bisect": ("bisect", "log", "merged('run-a_p1')", "--to", str(W), "--json"),
    "bisect, unknown": ("bisect", "log", "size('run-x_p9') > 1", "--to", str(W)),
    "whatif": ("whatif", "log", *CUP_AT, "--set", "eps_m=0.6", "--json"),
    "export": ("export", "log", *CUP_AT, "--graphml", "out/map.graphml", "--csv", "out/csv"),
    "foxglove": ("export", "log", *CUP_AT, "--foxglove", "out/map.mcap"),
    "rerun": ("export", "log", *CUP_AT, "--rerun", "out/map.rrd"),
    "room": ("room", "log", LEFT, *CUP_AT, "--json"),
    "relocalize": ("relocalize", "question.json", "--log", "log", "--as-of", str(W), "--json"),
    "evaluate": ("evaluate", "--map", "log", *CUP_AT, "--truth", "truth.jsonl", "--json"),
    "cat": ("log", "cat", "log", "--to", str(W), "--json"),
}
if not THOROUGH:
    del QUESTIONS["rerun"]  # its library takes a second to import
KNOWN_LATER = ["state", "draw", "merges", "why a place", "diff", "bisect", "whatif", "export"]
KNOWN_LATER = KNOWN_LATER[:: stride(4)]


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log that ends shortly after W."""
    folder = tmp_path_factory.mktemp("before")
    write_log(folder / "log", documents())
    (folder / "question.json").write_text(json.dumps(QUESTION))
    (folder / "truth.jsonl").write_text("\n".join(map(json.dumps, TRUTH)))
    return folder


def _said(folder: Path, name: str, *more: str) -> tuple[int, Any, dict[str, bytes]]:
    """Exit code, what a command in ``folder`` prints, without times, and the files it writes."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    said = Commands.in_folder(folder)(*QUESTIONS[name], *more, code=None)
    shown: Any = said.out if said.code == 0 else said.out + said.err
    if name == "evaluate" and said.code == 0:  # what it asks is of the whole log's rooms
        shown = {part: said.json[part] for part in ("places", "objects")}
    elif name == "whatif":
        shown = re.sub(r'seconds": [0-9.e-]+', "", shown)
    files = {
        str(path.relative_to(folder)): b"" if path.suffix == ".rrd" else path.read_bytes()
        for path in sorted((folder / "out").rglob("*.*"))
    }
    return said.code, shown, files


@pytest.mark.seconds
@pytest.mark.parametrize("hindrance", mostly_slow(list(HINDRANCES)))
def test_an_answer_does_not_depend_on_later_events(
    before: Path, tmp_path: Path, hindrance: str
) -> None:
    hinder, readable = HINDRANCES[hindrance]
    shutil.copytree(before, tmp_path, dirs_exist_ok=True)
    hinder(tmp_path / "log")
    with LogReader(tmp_path / "log") as reader:
        last = reader.readable_end
    assert last >= EVENTS
    differing = []
    for name in QUESTIONS:
        expected = _said(before, name)
        if "unknown" not in name:
            assert expected[0] == 0, expected[1]
        later = [["--known-at", str(last)]] if readable and name in KNOWN_LATER else []
        differing += [
            (name, *more, found[1])
            for more in ([], *later)
            if (found := _said(tmp_path, name, *more)) != expected
        ]
    assert not differing


@pytest.mark.parametrize(
    "hindrance", mostly_slow(["no command", "unfoldable", "rotten", "cut", "last lost"])
)
def test_a_replay_to_w_does_not_depend_on_later_events(
    before: Path, tmp_path: Path, hindrance: str, one_database: Targets
) -> None:
    log = shutil.copytree(before / "log", tmp_path / "log")
    expected = rebuild(log, one_database, Settings(), until=Offset(W), workers=0).digest
    HINDRANCES[hindrance][0](log)
    assert rebuild(log, one_database, Settings(), until=Offset(W), workers=0).digest == expected


@pytest.mark.parametrize("spoil", mostly_slow(UNREADABLE_ENDS.values()))
def test_the_end_of_a_log_that_cannot_be_read_is_refused(
    before: Path, tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    log = shutil.copytree(before / "log", tmp_path / "log")
    spoil(log)
    with LogReader(log) as reader:
        assert reader.readable_end == reader.end_for(Offset(EVENTS)) == EVENTS
        gaps: list[Unreadable] = []
        assert len(list(reader.read(on_gap=gaps.append))) == EVENTS
        assert [gap.first for gap in gaps] == [EVENTS]
        assert gaps[0].last == EVENTS + (19 if spoil is _two_cut else 9)
        for ask in (
            lambda: reader.next_offset,
            lambda: reader.end_for(None),
            lambda: reader.end_for(Offset(EVENTS + 1)),
            lambda: list(reader.read()),
            lambda: list(reader.read(end=Offset(EVENTS + 1))),
            reader.refresh,
            reader.check_end,
            lambda: next(follow(log, Offset(EVENTS), stop=threading.Event())),
            lambda: LogWriter(log, fsync=NEVER),
        ):
            with pytest.raises((LogDamaged, NotALog)):
                ask()
    run = Commands.in_folder(tmp_path)
    for name in ("state", "merges"):
        assert _said(tmp_path, name) == _said(before, name)
    for command_line in ("state log", "merges log", "diff log 9 end", "log info log"):
        said = run(*command_line.split(), code=None)
        assert said.code in (1, 2)
        assert (said.out, "log recover" in said.err) == ("", True)
