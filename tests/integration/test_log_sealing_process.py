"""Sealing in a process of its own: the same bytes as in the writer, and no log depends on it."""

import json
import os
import sys
import threading
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.model import Offset
from eventsrc.log import ALWAYS, LogWriter, sealer, verify_log
from eventsrc.log.mcap_records import MARK_BYTES
from eventsrc.log.seal import NO_PREVIOUS, SegmentPlan, seal, write_sealed
from eventsrc.log.sealer import ProcessGone, SealingProcess
from eventsrc.log.segment import ActiveFile
from tests.support import prefork
from tests.support.fixtures_log import KEY, read_log

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 30
FIRST_SEGMENT = f"{0:020d}"


def killed_writer(path: Path, events: int = 5) -> SegmentPlan:
    """The plan for the segment that a killed writer left, of a log that is not locked."""
    program = (
        "import os, sys; from pathlib import Path; from eventsrc.log import ALWAYS, LogWriter\n"
        "writer = LogWriter(Path(sys.argv[1]), fsync=ALWAYS)\n"
        "for n in range(int(sys.argv[2])): writer.append('k', b'%d' % n)\n"
        "print(writer.log_id, flush=True); os.kill(os.getpid(), 9)\n"
    )
    argv = ["-c", str(path), str(events)]
    done = prefork.run(program, argv, env=os.environ, cwd=ROOT, timeout=TIMEOUT_S)
    return SegmentPlan(path, done.stdout.decode().strip(), Offset(0), NO_PREVIOUS, Offset(events))


def test_it_writes_the_bytes_that_the_writer_would_write(tmp_path: Path) -> None:
    plan = killed_writer(tmp_path / "log")
    active = tmp_path / "log" / f"{FIRST_SEGMENT}.mcap.active"
    sealed = tmp_path / "log" / f"{FIRST_SEGMENT}.mcap"
    process = SealingProcess()
    sha256 = process.seal(plan)
    process.close()
    by_process = sealed.read_bytes()
    file = ActiveFile(active, Offset(0))
    assert seal(plan, (file.read_chunk(chunk) for chunk in file.chunks)) == sha256
    assert sealed.read_bytes() == by_process
    assert {p.name for p in plan.log.iterdir()} == {"lock", sealed.name, active.name}


@pytest.mark.skipif(not hasattr(os, "posix_fadvise"), reason="no such call on this system")
@pytest.mark.parametrize("cached", [True, False])
def test_what_is_sealed_leaves_the_page_cache_unless_it_is_to_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, cached: bool
) -> None:
    advised: list[tuple[int, int, int]] = []
    monkeypatch.setattr(os, "posix_fadvise", lambda _, *advice: advised.append(advice))
    plan = killed_writer(tmp_path / "log")
    file = ActiveFile(tmp_path / "log" / f"{FIRST_SEGMENT}.mcap.active", Offset(0))
    sealed = tmp_path / "sealed"
    write_sealed(plan, (file.read_chunk(chunk) for chunk in file.chunks), sealed, cached=cached)
    size = sealed.stat().st_size
    assert advised == ([] if cached else [(0, size, os.POSIX_FADV_DONTNEED)])


def test_it_starts_where_the_module_path_has_entries_that_python_passes_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = killed_writer(tmp_path / "log")
    monkeypatch.syspath_prepend(".")
    sys.path.insert(0, Path())  # type: ignore[arg-type]
    process = SealingProcess()
    assert process.seal(plan)
    process.close()


class Watched:
    """Notes what is sealed in processes; ``before`` is called before each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.plans: list[int] = []
        self.process: SealingProcess | None = None
        self.asked = threading.Event()
        real = SealingProcess.seal

        def seal(process: SealingProcess, plan: SegmentPlan) -> str:
            self.plans.append(plan.base)
            self.process = process
            self.asked.set()
            self.before(process)
            return real(process, plan)

        monkeypatch.setattr(SealingProcess, "seal", seal)

    def before(self, process: SealingProcess) -> None:
        """Nothing."""


def write(path: Path, events: int, rotate_events: int, watched: Watched | None = None) -> None:
    """A log of so many events, sealed by a process."""
    with LogWriter(path, fsync=ALWAYS, rotate_events=rotate_events, sealing_process=True) as writer:
        for number in range(events):
            writer.append(KEY, b"%d" % number)
        assert watched is None or watched.asked.wait(TIMEOUT_S)


def check(path: Path, events: int, segments: int) -> None:
    """Everything is there, sealed, and the chain of hashes holds."""
    assert [e.payload for e in read_log(path)] == [b"%d" % n for n in range(events)]
    assert {f.kind for f in verify_log(path).findings} == {"schema"}
    assert sorted(p.suffix for p in path.iterdir()) == ["", ".json", *[".mcap"] * segments]


def test_one_process_seals_all_segments(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch)
    write(log_path, 35, 10, watched)
    assert watched.plans == [0, 10, 20, 30]
    assert watched.process is not None
    assert watched.process._process.returncode is not None
    check(log_path, 35, 4)


def test_when_the_process_dies_the_thread_seals(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(monkeypatch)
    watched.before = lambda process: process._process.kill()  # type: ignore[method-assign]
    write(log_path, 10, 3, watched)
    assert watched.plans == [0]
    check(log_path, 10, 4)


def test_when_no_process_can_be_started_the_thread_seals(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    write(log_path, 4, 3)
    check(log_path, 4, 2)


def test_a_log_of_one_segment_starts_no_process(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start() -> SealingProcess:
        raise AssertionError("started")

    monkeypatch.setattr(sealer, "SealingProcess", start)
    write(log_path, 1, 10)
    check(log_path, 1, 1)


def test_a_process_that_dies_while_sealing_leaves_no_half_written_file(tmp_path: Path) -> None:
    plan = killed_writer(tmp_path / "log")
    process = SealingProcess()
    half_written = plan.log / f"{FIRST_SEGMENT}.{process._process.pid}.mcap.sealing"
    half_written.write_bytes(b"half")
    process._process.kill()
    with pytest.raises(ProcessGone):
        process.seal(plan)
    assert not half_written.exists()


@pytest.mark.slow
def test_it_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = killed_writer(tmp_path / "log")
    stranger = tmp_path / "folder"
    for module in ("json.py", "queue.py", "eventsrc/__init__.py"):
        (stranger / module).parent.mkdir(parents=True, exist_ok=True)
        (stranger / module).write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    monkeypatch.chdir(stranger)
    process = SealingProcess()
    process.seal(plan)
    process.close()
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
def test_errors_come_back_as_they_were_raised(tmp_path: Path) -> None:
    plan = killed_writer(tmp_path / "log")
    process = SealingProcess()
    active = plan.log / f"{FIRST_SEGMENT}.mcap.active"
    whole = active.read_bytes()
    damaged = bytearray(whole)
    damaged[-MARK_BYTES - 1] ^= 1  # the payload of the last event
    active.write_bytes(damaged)
    with pytest.raises(LogDamaged, match="CRC"):
        process.seal(plan)
    active.unlink()
    with pytest.raises(FileNotFoundError):
        process.seal(plan)
    process.close()
    with pytest.raises(ProcessGone):
        process.seal(plan)
    assert [p.name for p in plan.log.iterdir()] == ["lock"]


def test_the_process_of_a_dead_writer_changes_nothing_in_its_log(log_path: Path) -> None:
    """It writes under a name of its own, finds no process to answer, and deletes that file."""
    plan = killed_writer(log_path)
    process = SealingProcess()
    question = {
        "log": str(log_path),
        "log_id": plan.log_id,
        "base": 0,
        "previous_sha256": "",
        "following": 5,
    }
    process.send(json.dumps(question).encode())
    process.connection.close()  # as when the writer is killed
    with LogWriter(log_path) as writer:
        assert writer.next_offset == 5
        writer.append(KEY, b"next")
    assert process._process.wait(TIMEOUT_S) == 0
    assert [e.payload for e in read_log(log_path)][-1] == b"next"
    assert sorted(p.suffix for p in log_path.iterdir()) == ["", ".json", ".mcap", ".mcap"]
