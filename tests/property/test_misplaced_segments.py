"""Segments under wrong names, of other logs, twice, or out of a backup: the log id and the base in
their heads decide which offsets they hold, and recovery deletes nothing."""

import itertools
import json
import random
import shutil
import zlib
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log.format import ACTIVE, SEALED, SEALED_END, file_head, head_metadata, segment_path
from eventsrc.log.mcap_records import encode_mark, encode_message_head, encode_plain_chunk_head
from eventsrc.log.recover import TooManyLosses
from tests.support.commands import Commands
from tests.support.fixtures_log import KEY, envelope, read_log, read_with_gaps, write_log
from tests.support.thorough import stride

EACH = 3
COUNT = 5
EVENTS = EACH * COUNT


def make(path: Path, name: str, *, each: int = EACH, events: int = EVENTS) -> list[bytes]:
    """A log of sealed segments of ``each`` events."""
    payloads = [envelope(number, name) for number in range(events)]
    write_log(path, payloads, fsync=ALWAYS, rotate_events=each)
    return payloads


def leave_active(path: Path, base: int) -> Path:
    """Make the last sealed segment a growing one again, as a killed writer leaves it."""
    (path / SEALED_END).unlink(missing_ok=True)
    events = [e.payload for e in read_log(path, base)]
    with LogReader(path) as reader:
        log_id = reader.log_id
    segment_path(path, base, SEALED).unlink()
    from eventsrc.log.active_segment import ActiveSegment
    from eventsrc.log.event import NewEvent

    active = ActiveSegment(path, log_id, base, ALWAYS)
    active.create()
    for number, payload in enumerate(events, start=base):
        active.add([NewEvent(KEY, payload, 1000 + number, number)], 0)
        active.commit()
    active.close()
    return segment_path(path, base, ACTIVE)


def files(path: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in path.iterdir() if ".mcap" in p.name}


def payloads_of(path: Path) -> list[bytes | None]:
    """What the log holds by offset, None for a loss."""
    return [None if e.key == LOSS_KEY else e.payload for e in read_log(path)]


def test_a_sealed_segment_of_another_log_over_the_growing_one(quick_path: Path) -> None:
    ours = make(quick_path / "a", "a")
    make(quick_path / "b", "b", each=58, events=58)
    log = quick_path / "a"
    active = leave_active(log, EVENTS - EACH)
    foreign = (quick_path / "b" / "00000000000000000000.mcap").read_bytes()
    active.write_bytes(foreign)
    assert {f.kind for f in verify_log(log).findings} == {"chain"}
    with pytest.raises(LogDamaged, match="as the segment at offset 0, not 12; run `mapfold"):
        read_log(log)
    with pytest.raises(LogDamaged, match="mapfold log recover"):
        LogWriter(log)
    before = files(log)
    report = recover_log(log)
    (moved,) = report.moved
    assert (moved.name, moved.now.partition("-")[0]) == (active.name, active.name + ".foreign")
    assert report.findings
    assert payloads_of(log) == ours[: EVENTS - EACH]
    assert set(before.values()) == set(files(log).values())
    assert verify_log(log).findings == ()
    assert recover_log(log).moved == ()
    with LogWriter(log) as writer:
        assert writer.next_offset == EVENTS - EACH


@pytest.mark.parametrize(("one", "other"), [(0, 3), (3, 6), (6, 12), (0, 12)])
@pytest.mark.parametrize("growing", [False, True])
def test_exchanged_names_are_detected_and_corrected(
    quick_path: Path, one: int, other: int, growing: bool
) -> None:
    log = quick_path / "log"
    payloads = make(log, "a")
    if growing:
        leave_active(log, EVENTS - EACH)
    whole = files(log)
    a, b = (next(p for p in log.iterdir() if p.name[:20] == f"{n:020d}") for n in (one, other))
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    assert "chain" in {f.kind for f in verify_log(log).findings}
    with pytest.raises(LogError):
        read_log(log)
    with pytest.raises(LogDamaged, match="log recover"):
        LogWriter(log)
    try:
        shown, _ = read_with_gaps(log)
    except LogError:
        shown = []
    assert all(event.payload == payloads[event.offset] for event in shown)
    report = recover_log(log)
    assert len(report.moved) == 2
    assert payloads_of(log) == payloads
    if not growing:
        assert files(log) == whole
        assert report.segments == ()
    assert verify_log(log).findings == ()
    assert recover_log(log).moved == ()


@pytest.mark.parametrize("steps", range(7))
def test_an_interrupted_renaming_is_finished(
    quick_path: Path, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = quick_path / "log"
    payloads = make(log, "a")
    a, b, c = (segment_path(log, n, SEALED) for n in (0, 3, 6))
    contents = [p.read_bytes() for p in (a, b, c)]
    for path, content in zip((b, c, a), contents, strict=True):
        path.write_bytes(content)
    real, left = Path.rename, itertools.count()

    def rename(path: Path, target: Path) -> Path:
        if next(left) == steps:
            raise OSError(5, "Input/output error")
        return real(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        if steps < 6:
            with pytest.raises(LogError, match="Input/output error"):
                recover_log(log)
        else:
            recover_log(log)
    if list(log.glob("*.misnamed")):
        with pytest.raises(LogDamaged, match="recovery was interrupted; run `mapfold log recover"):
            LogWriter(log)
    recover_log(log)
    assert payloads_of(log) == payloads
    assert [p.read_bytes() for p in (a, b, c)] == contents


def test_the_same_segment_under_two_names(quick_path: Path) -> None:
    log = quick_path / "log"
    payloads = make(log, "a")
    again = segment_path(log, 100, SEALED)
    shutil.copy(segment_path(log, 3, SEALED), again)
    report = recover_log(log)
    assert [(m.name, m.now) for m in report.moved] == [(again.name, again.name + ".duplicate")]
    assert payloads_of(log) == payloads
    assert verify_log(log).findings == ()


@pytest.mark.parametrize("base", [0, 3, 12])
def test_an_older_backup_copy_is_set_aside(quick_path: Path, base: int) -> None:
    """A segment as it was when it held fewer events, under the name of a growing one."""
    log = quick_path / "log"
    payloads = make(log, "a")
    shutil.copytree(log, quick_path / "copy")
    for later in range(base + EACH, EVENTS, EACH):
        segment_path(quick_path / "copy", later, SEALED).unlink()
    active = leave_active(quick_path / "copy", base)
    content = active.read_bytes()
    (log / active.name).write_bytes(content[: len(content) - 100])
    recover_log(log)
    assert payloads_of(log) == payloads


@pytest.mark.parametrize("tail_gone", [False, True])
def test_events_only_in_an_overlapping_backup_are_kept(quick_path: Path, tail_gone: bool) -> None:
    """The same events in other segments: what only the backup holds is kept, at its offsets."""
    log = quick_path / "log"
    payloads = make(log, "a")
    backup = leave_active(log, EVENTS - EACH)
    backup.unlink()
    with LogReader(log) as reader:
        log_id = reader.log_id
    base = 4
    body = [(n - base, payloads[n]) for n in range(base, EVENTS)]
    segment_path(log, base, ACTIVE).write_bytes(by_hand(log_id, base, body))
    if tail_gone:
        segment_path(log, 9, SEALED).unlink()
    before = set(files(log).values())
    report = recover_log(log)
    assert payloads_of(log) == payloads
    assert any(m.now.endswith(".duplicate") for m in report.moved)
    assert before <= set(files(log).values())
    assert report.events == EVENTS
    assert {f.kind for f in verify_log(log).findings} <= {"time"}
    assert recover_log(log).segments == ()


def by_hand(log_id: str, base: int, messages: list[tuple[int, bytes]]) -> bytes:
    from eventsrc.log.channels import key_channel
    from eventsrc.log.mcap_records import encode

    body = encode(key_channel(1, 0, KEY, ENVELOPE_VERSION))
    body += b"".join(encode_message_head(1, s, 5, 5, len(p)) + p for s, p in messages)
    crc = zlib.crc32(body)
    first, last = messages[0][0], messages[-1][0]
    chunk = encode_plain_chunk_head(len(body), crc, 5, 5) + body
    head = file_head(head_metadata(log_id, base, {"mark_seed": "0"}))
    return head + chunk + encode_mark(base + first, base + last + 1, 0)


@pytest.mark.parametrize("seed", range(0, 40, stride(4)))
def test_any_permutation_of_names_keeps_every_event_at_its_offset(
    quick_path: Path, seed: int
) -> None:
    chance = random.Random(seed)
    log = quick_path / "log"
    payloads = make(log, "a")
    make(quick_path / "b", "b", events=EACH)
    if chance.random() < 0.5:
        leave_active(log, EVENTS - EACH)
    contents = list(files(log).values())
    names = [p.name for p in log.iterdir() if ".mcap" in p.name]
    if chance.random() < 0.5:
        contents.append(chance.choice(contents))
        names.append(f"{chance.randrange(200):020d}{chance.choice([SEALED, ACTIVE])}")
    if chance.random() < 0.5:
        contents += files(quick_path / "b").values()
        names.append(f"{chance.randrange(200):020d}{chance.choice([SEALED, ACTIVE])}")
    if len(set(names)) < len(names):
        return
    for name in names:
        (log / name).unlink(missing_ok=True)
    chance.shuffle(contents)
    for name, content in zip(names, contents, strict=True):
        (log / name).write_bytes(content)
    report = recover_log(log)
    assert payloads_of(log) == payloads
    kept = set(files(log).values())
    rewritten = {segment.name for segment in report.segments}
    assert all(c in kept for c in contents) or all(name.endswith(ACTIVE) for name in rewritten)
    assert verify_log(log).findings == ()
    assert not recover_log(log).findings


@pytest.mark.parametrize("noted", [True, False])
@pytest.mark.parametrize("which", [0, EACH])
def test_of_two_logs_in_equal_number_one_is_set_aside(
    quick_path: Path, which: int, noted: bool
) -> None:
    """The other than `sealed_end` names; without it, the one that does not begin at offset 0."""
    ours = make(quick_path / "a", "a", events=2 * EACH)
    theirs = make(quick_path / "b", "b", events=2 * EACH)
    ids = {name: verify_log(quick_path / name).log_id for name in "ab"}
    log = quick_path / "a"
    shutil.copy(segment_path(quick_path / "b", which, SEALED), segment_path(log, which, SEALED))
    if not noted:
        (log / SEALED_END).unlink()
    own = "a" if noted or which else "b"
    before = files(log)
    assert verify_log(log).log_id == ids[own]
    (moved,) = recover_log(log).moved
    foreign = "b" if own == "a" else "a"
    assert moved.now == f"{moved.name}.foreign-{ids[foreign]}"
    assert f"it belongs to log {ids[foreign]}, not {ids[own]}" in moved.reason
    assert set(before.values()) <= set(files(log).values())
    kept = [*(theirs if own == "b" else ours)[:EACH], *[None] * EACH]
    if own == "a":
        kept = [None if number // EACH == which // EACH else p for number, p in enumerate(ours)]
    assert payloads_of(log) == kept[: len(payloads_of(log))]
    assert len(payloads_of(log)) == (2 * EACH if noted else EACH)
    assert {f.kind for f in verify_log(log).findings} <= {"loss"}


def test_very_many_losses_need_confirmation(tmp_path: Path) -> None:
    """A segment whose head names a base far behind everything else."""
    run = Commands.in_folder(tmp_path)
    log = tmp_path / "L"
    payloads = make(log, "a")
    with LogReader(log) as reader:
        log_id = reader.log_id
    far, too_far = 300_000, 10**15
    for base in (far, too_far):
        late = segment_path(log, base, ACTIVE)
        late.write_bytes(by_hand(log_id, base, [(0, envelope(99))]))
        before = files(log)
        with pytest.raises(TooManyLosses, match=f"{base - EVENTS:,} events from offset {EVENTS}"):
            recover_log(log)
        assert files(log) == before
        said = run("log", "recover", "L", code=1)
        assert said.err.count("\n") == 1
        assert "move the file that is wrong" in said.err
        if base == too_far:
            run("log", "recover", "L", "--yes", code=1)
            assert files(log) == before
        late.unlink()
    assert payloads_of(log) == payloads
    base = 100_500
    segment_path(log, base, ACTIVE).write_bytes(by_hand(log_id, base, [(0, envelope(99))]))
    run("log", "recover", "L", code=1)
    assert "--yes" in run("log", "recover", "L", code=1).err
    report = json.loads(run("log", "recover", "L", "--yes", "--json", code=3).out)
    assert report["events"] == base + 1
    assert [e.payload for e in read_log(log, base)] == [envelope(99)]
