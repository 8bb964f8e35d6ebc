"""A segment file that is deleted, renamed, replaced, cut short or lengthened under its writer."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import SeekingReader

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import active_segment as _active
from eventsrc.log import mcap_records as _mcap
from eventsrc.log.channels import schema_of
from eventsrc.log.format import ACTIVE, SEALED, head_of, mark_seed, segment_path
from tests.support.fixtures_log import BY_HAND, KEY, read_log, read_with_gaps

BEFORE = 3
"""Events recorded before the file is tampered with."""
Tamper = Callable[[Path], None]
OTHER = b"another file\n"


def delete(path: Path) -> None:
    path.unlink()


def rename(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))


def empty(path: Path) -> None:
    os.truncate(path, 0)


def cut_in_the_middle(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 40)


def replace(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(OTHER)
    other.replace(path)


TAKEN = [delete, rename, empty, cut_in_the_middle, replace]
FOUND: dict[Tamper, str] = {
    delete: "was deleted",
    rename: "was renamed or moved away",
    empty: "was cut short to 0 of",
    cut_in_the_middle: "was cut short to",
    replace: "was replaced by another file",
}


def growing(log: Path) -> Path:
    (path,) = log.glob("*.active")
    return path


def write(writer: LogWriter, numbers: range) -> None:
    """One commit for each event."""
    for number in numbers:
        writer.append(KEY, b"%d" % number)
        writer.sync()


@pytest.mark.parametrize("tamper", TAKEN)
def test_recording_goes_on_in_a_new_file(log_path: Path, tamper: Tamper) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    old = growing(log_path)
    tamper(old)
    write(writer, range(BEFORE, 6))
    assert writer.durable_offset == writer.next_offset == 6
    (fault,) = writer.faults
    assert (fault.path, fault.base, fault.following, fault.lost_events) == (old, 0, BEFORE, BEFORE)
    assert FOUND[tamper] in fault.found
    with pytest.raises(LogError, match=FOUND[tamper] + r".*offsets 0 to 2.*are lost.* offset 3 on"):
        writer.close()
    events = {event.offset: event.payload for event in read_log(log_path, BEFORE)}
    assert events == {number: b"%d" % number for number in range(BEFORE, 6)}
    assert "gap" in {finding.kind for finding in verify_log(log_path).findings} or tamper is replace


@pytest.mark.parametrize("tamper", TAKEN)
def test_no_offset_is_used_twice_if_the_writer_dies_after_making_the_new_file(
    log_path: Path, tamper: Tamper, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    tamper(growing(log_path))
    writer.append(KEY, b"3")

    def die(_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(writer._active, "_on_fault", die)
        with pytest.raises(KeyboardInterrupt):
            writer.sync()
    writer._lock.release()
    if tamper is cut_in_the_middle:  # some of it can be read: a person decides
        with pytest.raises(LogDamaged, match="log recover"):
            LogWriter(log_path)
        return
    with LogWriter(log_path) as again:
        assert again.next_offset == BEFORE


@pytest.mark.parametrize("tamper", [delete, empty])
def test_recovery_replaces_lost_events_by_loss_events(log_path: Path, tamper: Tamper) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    tamper(growing(log_path))
    write(writer, range(BEFORE, 6))
    with pytest.raises(LogError):
        writer.close()
    with pytest.raises(LogDamaged, match="offsets 0 to 2 cannot be read"):
        read_log(log_path)
    recover_log(log_path)
    events = read_log(log_path)
    assert [event.key for event in events] == [LOSS_KEY] * BEFORE + [KEY] * 3
    assert not {"gap", "chain", "crc"} & {finding.kind for finding in verify_log(log_path).findings}


def test_the_new_file_has_another_mark_seed(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    old = growing(log_path)
    rename(old)
    write(writer, range(BEFORE, 6))
    new = growing(log_path)
    assert [event.payload for event in read_log(log_path, BEFORE)] == [b"3", b"4", b"5"]
    seeds = [mark_seed(head_of(*file)) for file in ((old.with_name("elsewhere"), 0), (new, BEFORE))]
    assert seeds[0] != seeds[1]
    for file, seed, first in zip((old.with_name("elsewhere"), new), seeds, (0, 3), strict=True):
        for number in range(first, first + 3):
            assert _mcap.encode_mark(number, number + 1, seed) in file.read_bytes()
    with pytest.raises(LogError):
        writer.close()


def test_events_before_the_cut_are_read(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    cut_in_the_middle(growing(log_path))
    write(writer, range(BEFORE, 6))
    with pytest.raises(LogError):
        writer.close()
    shown, gone = read_with_gaps(log_path)
    assert [event.payload for event in shown] == [b"0", b"1", b"3", b"4", b"5"]
    assert gone == {2}


def test_a_file_that_is_put_back_under_its_name_makes_the_log_whole(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    path = growing(log_path)
    rename(path)
    write(writer, range(BEFORE, 6))
    with pytest.raises(LogError, match="put it back"):
        writer.close()
    path.with_name("elsewhere").rename(path)
    assert [event.payload for event in read_log(log_path)] == [b"%d" % n for n in range(6)]


def test_a_file_that_replaced_the_segment_is_never_overwritten(log_path: Path) -> None:
    """Nothing was recorded in the file yet, so the new one has its name."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    path = growing(log_path)
    replace(path)
    write(writer, range(2))
    assert writer.faults[0].lost_events == 0
    with pytest.raises(LogError, match="no recorded event of it is lost"):
        writer.close()
    assert path.with_name(path.name + ".damaged").read_bytes() == OTHER
    assert [event.payload for event in read_log(log_path)] == [b"0", b"1"]


def test_bytes_that_another_program_appends_cost_no_event(log_path: Path) -> None:
    """They would hide everything written behind them."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    with growing(log_path).open("ab") as file:
        file.write(OTHER)
    write(writer, range(BEFORE, 6))
    (fault,) = writer.faults
    assert fault.lost_events == 0
    with pytest.raises(LogError, match="has 13 bytes at its end that another program wrote"):
        writer.close()
    assert [event.payload for event in read_log(log_path)] == [b"%d" % n for n in range(6)]
    assert {finding.kind for finding in verify_log(log_path).findings} == {"schema"}
    assert {path.name for path in log_path.glob("*.mcap")} == {
        segment_path(log_path, base, SEALED).name for base in (0, BEFORE)
    }


@pytest.mark.parametrize("moment", ["before the write", "during the sync"])
def test_a_cut_during_a_commit_is_noticed_before_the_group_counts(
    log_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    path = segment_path(log_path, 0, ACTIVE)
    size = path.stat().st_size
    name = "write_all" if moment == "before the write" else "sync_file"
    real = getattr(_active, name)
    done: list[int] = []

    def cut_first(fd: int, *data: bytes) -> None:
        if not done:
            done.append(fd)
            os.truncate(path, size - 10)
        real(fd, *data)

    monkeypatch.setattr(_active, name, cut_first)
    write(writer, range(BEFORE, 6))
    assert len(writer.faults) == 1
    assert path.stat().st_size == size - 10, "the group stands in the new file only"
    with pytest.raises(LogError, match="was cut short"):
        writer.close()
    assert [event.payload for event in read_log(log_path, BEFORE)] == [b"3", b"4", b"5"]


def test_events_waiting_when_the_file_is_given_up_keep_their_offsets(log_path: Path) -> None:
    """Their sequence numbers counted from the start of the old file."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    empty(growing(log_path))
    for number in range(BEFORE, 10):
        writer.append(KEY, b"%d" % number)
    writer.sync()
    write(writer, range(10, 12))
    with pytest.raises(LogError):
        writer.close()
    events = read_log(log_path, BEFORE)
    assert [(e.offset, e.payload) for e in events] == [(n, b"%d" % n) for n in range(BEFORE, 12)]


def test_other_programs_can_read_the_new_file(log_path: Path) -> None:
    """It also holds the schemas of the old file."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    delete(growing(log_path))
    write(writer, range(BEFORE, 5))
    writer.append("mapfold/loss", b"{}")
    with pytest.raises(LogError):
        writer.close()
    (path,) = log_path.glob("*.mcap")
    with path.open("rb") as file:
        found = list(SeekingReader(file, validate_crcs=True).iter_messages())
    assert [message.data for _, _, message in found] == [b"3", b"4", b"{}"]
    assert [schema is not None and schema.name for schema, _, _ in found] == [
        schema_of(key)[0] for key in (KEY, KEY, "mapfold/loss")
    ]


def test_rotation_goes_on_after_a_file_was_given_up(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND, rotate_events=4)
    for number in range(12):
        write(writer, range(number, number + 1))
        writer.commit_if_due()
        if number == 5:
            delete(
                growing(log_path)
                if len(list(log_path.glob("*.active"))) == 1
                else segment_path(log_path, 4, ACTIVE)
            )
    with pytest.raises(LogError, match="offsets 4 to 5"):
        writer.close()
    shown, gone = read_with_gaps(log_path)
    assert [event.offset for event in shown] == [0, 1, 2, 3, *range(6, 12)]
    assert gone == {4, 5}


@pytest.mark.parametrize("back", [False, True])
def test_a_folder_that_is_gone_ends_the_writer(log_path: Path, back: bool) -> None:
    """Also where another one stands under its name by now: it is not locked."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    write(writer, range(BEFORE))
    log_path.rename(log_path.with_name("moved"))
    if back:
        log_path.mkdir()
    writer.append(KEY, b"3")
    with pytest.raises(LogError, match="log"):
        writer.sync()
    assert writer.durable_offset == BEFORE
    with pytest.raises(LogError):
        writer.append(KEY, b"4")
    with pytest.raises(LogError):
        writer.close()
    if back:
        assert not list(log_path.iterdir())
        log_path.rmdir()
    shutil.move(log_path.with_name("moved"), log_path)
    with LogReader(log_path) as reader:
        assert reader.next_offset == BEFORE
