"""A power cut after any system call: whatever the disk may then hold, all recorded events are read
back, none is made up, and the log can be appended to."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import LogReader, LogWriter, recover_log
from eventsrc.log.durable_files import ALWAYS, FsyncPolicy
from tests.support.fixtures_log import BY_HAND, KEY, read_log
from tests.support.power_loss import Call, Tracer, power_cuts
from tests.support.thorough import mostly_slow, stride

THREE = FsyncPolicy(interval_ns=10**18, max_events=3)


def worthless(name: str) -> bool:
    """Half-made files, which every start deletes unread, and the lock, whose text means nothing."""
    return name.endswith((".new", ".sealing")) or name == "lock"


@pytest.fixture
def tracer(log_path: Path) -> Iterator[Tracer]:
    """Of everything done to the log at ``log_path``."""
    with pytest.MonkeyPatch.context() as patch:
        yield Tracer(log_path, patch)


def append(tracer: Tracer, writer: LogWriter, count: int) -> None:
    for _ in range(count):
        writer.append(KEY, b"payload %d" % writer.next_offset)
        tracer.promise = writer.durable_offset


def one_life(tracer: Tracer, policy: FsyncPolicy) -> None:
    """Commits, a rotation and a sealed end."""
    with LogWriter(tracer.folder, fsync=policy, rotate_events=6) as writer:
        append(tracer, writer, 8)
        tracer.promise = writer.sync()
        append(tracer, writer, 2)
    tracer.promise = 10


def killed_and_restarted(tracer: Tracer) -> None:
    """A process dies without a word; the next one seals what it left."""
    writer = LogWriter(tracer.folder, fsync=BY_HAND)
    append(tracer, writer, 3)
    tracer.promise = writer.sync()
    append(tracer, writer, 2)
    writer._lock.release()
    with LogWriter(tracer.folder, fsync=ALWAYS) as again:
        append(tracer, again, 2)


def killed_and_recovered(tracer: Tracer) -> None:
    """The same, by the command that a person runs."""
    writer = LogWriter(tracer.folder, fsync=BY_HAND)
    append(tracer, writer, 3)
    tracer.promise = writer.sync()
    writer._lock.release()
    recover_log(tracer.folder)


LIVES: dict[str, Callable[[Tracer], None]] = {
    "always": lambda tracer: one_life(tracer, ALWAYS),
    "groups": lambda tracer: one_life(tracer, THREE),
    "killed and restarted": killed_and_restarted,
    "killed and recovered": killed_and_recovered,
}


@pytest.mark.parametrize("name", mostly_slow(sorted(LIVES, key="always".__eq__), 3))
def test_recorded_events_survive_any_power_cut(name: str, tracer: Tracer, quick_path: Path) -> None:
    LIVES[name](tracer)
    assert survive(tracer.end(), quick_path / "log", stride(3)) > 40


def survive(calls: list[Call], log: Path, every: int = 1) -> int:
    """Check every outcome of every power cut, or some of them; how many there were."""
    cuts = 0
    for call, promised, files in power_cuts(calls, worthless):
        place = f"after {call!r}, {promised} promised, left {sorted(files or ())}"
        assert files is not None or promised == 0, place
        if files is not None:
            cuts += 1
            if cuts % every == 0:
                check(log, files, promised, place)
    return cuts


def check(log: Path, files: dict[str, bytes], promised: int, place: str) -> None:
    """Read, then write on, what a power cut left."""
    log.mkdir()
    for name, content in files.items():
        (log / name).write_bytes(content)
    if files:
        with LogReader(log) as reader:
            before = list(reader.read())
        assert [e.offset for e in before] == list(range(len(before))), place
    with LogWriter(log, fsync=ALWAYS) as writer:
        assert writer.next_offset >= promised, place
        writer.append(KEY, b"payload %d" % writer.next_offset)
    events = read_log(log)
    assert [e.payload for e in events] == [b"payload %d" % n for n in range(len(events))], place
    shutil.rmtree(log)


def test_without_syncs_recorded_events_are_lost(tracer: Tracer, quick_path: Path) -> None:
    """The test above can fail: take the syncs of files away, or those of the folder."""
    one_life(tracer, ALWAYS)
    for ignored in ("sync", "sync folder", "sync parent"):
        calls = [call for call in tracer.end() if call.name != ignored]
        with pytest.raises((AssertionError, LogError)):
            survive(calls[:60], quick_path / ignored)


def test_the_tracer_notes_calls_in_order(tracer: Tracer) -> None:
    with LogWriter(tracer.folder, fsync=ALWAYS) as writer:
        append(tracer, writer, 1)
    names = [call.name.split(" ")[0] for call in tracer.calls if "lock" not in call.name]
    first_commit = names.index("rename") + 2
    assert names[first_commit : first_commit + 4] == ["write", "write", "sync", "write"]
