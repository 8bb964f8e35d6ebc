"""Segments that other MCAP programs have rewritten are refused; `mapfold import` reads them."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log.format import ACTIVE, SEALED, SEALED_END, head_metadata, segment_path
from eventsrc.record.importers.run import import_files
from tests.support.commands import Commands
from tests.support.fixtures_log import KEY, envelope, read_log
from tests.support.rewriting import plainly_read, rewrite
from tests.support.thorough import mostly_slow

EACH = 20
COUNT = 3
EVENTS = EACH * COUNT


@pytest.fixture
def log(quick_path: Path) -> Path:
    """Three segments of two keys, logged in no order of time."""
    chance = random.Random(7)
    path = quick_path / "log"
    with LogWriter(path, fsync=ALWAYS, rotate_events=EACH) as writer:
        for number in range(EVENTS):
            key = chance.choice([KEY, "other/key"])
            logged_ns = 1000 + chance.randrange(100)
            writer.append(key, envelope(number), logged_ns=logged_ns, stamp_ns=number)
    return path


WAYS: dict[str, Callable[[Path], None]] = {
    "sort": rewrite,
    "sort to one chunk": lambda path: rewrite(path, chunk_size=10**7),
    "sort to lz4": lambda path: rewrite(path, compression=CompressionType.LZ4),
    "decompress": lambda path: rewrite(path, compression=CompressionType.NONE, in_log_time=False),
    "unchunked": lambda path: rewrite(path, chunked=False),
    "without our seal": lambda path: rewrite(path, metadata=["mapfold.segment"]),
    "filter": lambda path: rewrite(path, metadata=(), profile=""),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_rewritten_segment_is_refused_and_imported(log: Path, way: str, which: int) -> None:
    whole = read_log(log)
    path = segment_path(log, which * EACH, SEALED)
    WAYS[way](path)
    before = {p.name: p.read_bytes() for p in log.glob("*.mcap*")}
    with pytest.raises(LogError, match=r"another program.*mapfold import LOG"):
        read_log(log)
    assert {f.kind for f in verify_log(log).findings} & {"crc", "chain"}
    with pytest.raises(LogDamaged, match=r"another program.*nothing was changed"):
        recover_log(log)
    assert {p.name: p.read_bytes() for p in log.glob("*.mcap*")} == before
    new = log.parent / "new"
    with LogWriter(new) as writer:
        import_files(writer, [str(path)])
    mine = [(e.key, e.payload) for e in whole[which * EACH :][:EACH]]
    assert sorted((e.key, e.payload) for e in read_log(new)) == sorted(mine)


@pytest.mark.parametrize("profile", mostly_slow(["mapfold", ""]))
def test_without_metadata_the_error_names_import_which_works(log: Path, profile: str) -> None:
    """As `mcap filter` leaves it out. Nothing tells which offsets the messages had."""
    run = Commands.in_folder(log.parent)
    path = segment_path(log, EACH, SEALED)
    rewrite(path, metadata=(), profile=profile)
    there = len(plainly_read(path))
    before = {p.name: p.read_bytes() for p in log.glob("*.mcap*")}
    with pytest.raises(LogDamaged, match=r"another program.*nothing was changed"):
        recover_log(log)
    said = run("log", "recover", "log", code=1)
    assert said.err.count("\n") == 1
    assert "mapfold import log FILE" in said.err
    assert {p.name: p.read_bytes() for p in log.glob("*.mcap*")} == before
    path.rename(log.parent / "moved.mcap")
    run("log", "recover", "log", code=3)
    run("import", "log", "moved.mcap")
    assert json.loads(run("log", "info", "log", "--json").out)["events"] == EVENTS + there


def test_a_folder_of_foreign_files_only_is_not_changed(log: Path) -> None:
    run = Commands.in_folder(log.parent)
    for base in (EACH, 2 * EACH):
        segment_path(log, base, SEALED).unlink()
    (log / SEALED_END).unlink()
    path = segment_path(log, 0, SEALED)
    rewrite(path, metadata=())
    there = len(plainly_read(path))
    run("log", "recover", "log", code=1)
    path.rename(log.parent / "moved.mcap")
    run("import", "log", "moved.mcap")
    assert json.loads(run("log", "info", "log", "--json").out)["events"] == there


def test_a_rewritten_growing_segment_is_refused(log: Path) -> None:
    """As `mcap recover` leaves a growing segment: indexed, and with no commit mark."""
    path = segment_path(log, 2 * EACH, SEALED)
    with LogReader(log) as reader:
        log_id = reader.log_id
    rewrite(path, metadata=(), in_log_time=True)
    made = path.read_bytes()
    header_end = 17 + int.from_bytes(made[9:17], "little")
    head = _mcap.encode(head_metadata(log_id, 2 * EACH, {"mark_seed": "00000007"}))
    path.unlink()
    growing = segment_path(log, 2 * EACH, ACTIVE)
    growing.write_bytes(made[:header_end] + head + made[header_end:])
    for use in (LogWriter, recover_log, read_log):
        with pytest.raises(LogError, match="another program"):
            use(log)
    assert growing.exists()
