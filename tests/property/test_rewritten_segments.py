"""Segments that other MCAP programs have rewritten: recovery keeps at least what the mcap package's
own reader reads, at its offsets, or names `mapfold import`."""

import json
import random
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log.format import ACTIVE, SEALED, SEALED_END, segment_path
from tests.commands import Commands
from tests.fixtures_log import KEY, envelope, read_log
from tests.rewriting import plainly_read, rewrite
from tests.thorough import mostly_slow, stride

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
    "sort, with the names of earlier versions": lambda path: rewrite(path, old_names=True),
    "without our seal": lambda path: rewrite(path, metadata=["mapfold.segment"]),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("which", [0, 1, 2])
def test_every_event_of_a_rewritten_segment_is_kept(log: Path, way: str, which: int) -> None:
    whole = read_log(log)
    path = segment_path(log, which * EACH, SEALED)
    WAYS[way](path)
    made = path.read_bytes()
    assert {f.kind for f in verify_log(log).findings} & {"crc", "chain"}
    report = recover_log(log)
    assert read_log(log) == whole
    assert [(s.kept_events, s.lost_events) for s in report.segments] == [(EACH, 0)]
    assert made in [p.read_bytes() for p in log.iterdir()]
    assert {f.kind for f in verify_log(log).findings} <= {"time", "duplicate"}
    assert recover_log(log).segments == ()


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_events_left_in_a_filtered_segment_with_metadata_are_kept(
    log: Path, which: int
) -> None:
    whole = read_log(log)
    path = segment_path(log, which * EACH, SEALED)
    rewrite(path, keep=lambda topic, _: topic == KEY, in_log_time=False)
    there = {which * EACH + n: event for n, event in plainly_read(path).items()}
    assert 0 < len(there) < EACH
    (segment,) = recover_log(log).segments
    assert segment.lost_events == EACH - len(there)
    for event, was in zip(read_log(log), whole, strict=True):
        if event.offset in there or not which * EACH <= event.offset < (which + 1) * EACH:
            assert event == was
        else:
            assert event.key == LOSS_KEY


def test_messages_numbered_into_the_next_segment_are_left_out(log: Path) -> None:
    """Any number can stand in a message that another program has written."""
    whole = read_log(log)
    path = segment_path(log, EACH, SEALED)
    rewrite(path, renumber=lambda sequence: sequence + 2 * EACH if sequence == 3 else sequence)
    (segment,) = recover_log(log).segments
    assert (segment.kept_events, segment.lost_events) == (EACH - 1, 1)
    found = read_log(log)
    assert found[EACH + 3].key == LOSS_KEY
    assert [e for e in found if e.offset != EACH + 3] == [e for e in whole if e.offset != EACH + 3]


@pytest.mark.parametrize("seed", range(0, 30, stride(3)))
def test_every_event_the_mcap_reader_reads_is_kept(log: Path, seed: int) -> None:
    chance = random.Random(seed)
    which = chance.randrange(COUNT)
    path = segment_path(log, which * EACH, SEALED)
    dropped = {n for n in range(EACH) if chance.random() < 0.2}
    rewrite(
        path,
        keep=lambda _, sequence: sequence not in dropped,
        in_log_time=chance.random() < 0.5,
        chunk_size=chance.choice([100, 1000, 5000, 10**6]),
        compression=chance.choice(list(CompressionType)),
        metadata=chance.choice([["mapfold.segment"], ["mapfold.segment", "mapfold.seal"]]),
    )
    there = {which * EACH + n: event for n, event in plainly_read(path).items()}
    recover_log(log)
    events = read_log(log)
    assert [e.offset for e in events] == list(range(len(events)))
    found = {e.offset: (e.key, e.payload) for e in events}
    assert all(found[offset] == event for offset, event in there.items())
    lost = {e.offset for e in events if e.key == LOSS_KEY}
    assert lost <= {which * EACH + n for n in dropped}


@pytest.mark.parametrize("profile", mostly_slow(["mapfold", ""]))
def test_without_metadata_the_error_names_import_which_works(log: Path, profile: str) -> None:
    """As `mcap filter` leaves it out. Nothing tells which offsets the messages had."""
    run = Commands.in_folder(log.parent)
    path = segment_path(log, EACH, SEALED)
    rewrite(path, metadata=(), profile=profile)
    there = len(plainly_read(path))
    before = {p.name: p.read_bytes() for p in log.glob("*.mcap*")}
    with pytest.raises(LogDamaged, match="does not say which offsets it holds; nothing was ch"):
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


def test_a_rewritten_growing_segment_is_refused_and_recovered(log: Path) -> None:
    """As `mcap recover` leaves a growing segment: indexed, and with no commit mark."""
    whole = read_log(log)
    path = segment_path(log, 2 * EACH, SEALED)
    with LogReader(log) as reader:
        log_id = reader.log_id
    rewrite(path, metadata=(), in_log_time=True)
    made = path.read_bytes()
    from eventsrc.log import mcap_records as _mcap
    from eventsrc.log.format import head_metadata

    header_end = next(iter(_header_ends(made)))
    head = _mcap.encode(head_metadata(log_id, 2 * EACH, {"mark_seed": "00000007"}))
    path.unlink()
    segment_path(log, 2 * EACH, ACTIVE).write_bytes(made[:header_end] + head + made[header_end:])
    with pytest.raises(LogError, match="another program has rewritten it"):
        LogWriter(log)
    recover_log(log)
    assert read_log(log) == whole


def _header_ends(data: bytes) -> Iterable[int]:
    length = int.from_bytes(data[9:17], "little")
    yield 17 + length
