"""Sealing in a process of its own: it does the work, and the log never depends on it."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from eventsrc.errors import LogDamaged
from eventsrc.log import ALWAYS, LogWriter, verify_log
from eventsrc.log import seal_worker as _sealer
from eventsrc.log.active_file import ActiveFile
from eventsrc.log.seal import NO_PREVIOUS, SegmentPlan, seal
from eventsrc.log.seal_worker import ProcessGone, SealingProcess
from tests.fixtures_log import KEY, read_log

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 30


def growing(path: Path, events: int = 5) -> SegmentPlan:
    """The plan for a segment that a killed writer left, of a log that nobody holds."""
    program = (
        "import os, sys; from pathlib import Path; from eventsrc.log import ALWAYS, LogWriter\n"
        "writer = LogWriter(Path(sys.argv[1]), fsync=ALWAYS)\n"
        "for n in range(int(sys.argv[2])): writer.append('k', b'%d' % n)\n"
        "print(writer.log_id, flush=True); os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path), str(events)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=TIMEOUT_S,
    )
    return SegmentPlan(path, done.stdout.strip(), 0, NO_PREVIOUS, events)


def test_it_writes_what_sealing_here_writes(tmp_path: Path) -> None:
    plan = growing(tmp_path / "log")
    active = tmp_path / "log" / f"{0:020d}.mcap.active"
    sealed = tmp_path / "log" / f"{0:020d}.mcap"
    process = SealingProcess()
    sha256 = process.seal(plan)
    process.close()
    aside = sealed.read_bytes()
    file = ActiveFile(active, 0)
    assert seal(plan, (file.read_chunk(chunk) for chunk in file.chunks)) == sha256
    assert sealed.read_bytes() == aside
    assert {p.name for p in plan.log.iterdir()} == {"lock", sealed.name, active.name}


class Watched:
    """What the writer's thread asks of its process; ``before`` is called first."""

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


def test_a_writer_that_overlaps_has_its_segments_sealed_aside(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(monkeypatch)
    with LogWriter(log_path, fsync=ALWAYS, rotate_events=10, overlap=True) as writer:
        for number in range(35):
            writer.append(KEY, b"%d" % number)
        assert watched.asked.wait(TIMEOUT_S)
    assert watched.plans == [0, 10, 20, 30]
    assert watched.process is not None
    assert watched.process._process.returncode == 0
    assert [e.payload for e in read_log(log_path)] == [b"%d" % n for n in range(35)]
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}
    assert {p.suffix for p in log_path.iterdir()} == {".mcap", ""}


def test_when_the_process_dies_the_writer_seals_by_itself(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(monkeypatch)
    watched.before = lambda process: process._process.kill()  # type: ignore[method-assign]
    with LogWriter(log_path, fsync=ALWAYS, rotate_events=3, overlap=True) as writer:
        for number in range(10):
            writer.append(KEY, b"%d" % number)
        assert watched.asked.wait(TIMEOUT_S)
    assert watched.plans == [0]
    assert [e.payload for e in read_log(log_path)] == [b"%d" % n for n in range(10)]
    assert len(list(log_path.glob("*.mcap"))) == 4


def test_when_no_process_can_be_started_the_writer_seals_by_itself(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with LogWriter(log_path, fsync=ALWAYS, rotate_events=3, overlap=True) as writer:
        for number in range(4):
            writer.append(KEY, b"%d" % number)
    assert len(list(log_path.glob("*.mcap"))) == 2


def test_a_short_recording_starts_no_process(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused() -> SealingProcess:
        raise AssertionError("started")

    monkeypatch.setattr(_sealer, "SealingProcess", refused)
    with LogWriter(log_path, overlap=True) as writer:
        writer.append(KEY, b"x")
    assert len(list(log_path.glob("*.mcap"))) == 1


def test_a_process_that_dies_at_work_leaves_no_half_made_file(tmp_path: Path) -> None:
    plan = growing(tmp_path / "log")
    process = SealingProcess()
    half_made = plan.log / f"{0:020d}.{process._process.pid}.mcap.sealing"
    half_made.write_bytes(b"half")
    process._process.kill()
    with pytest.raises(ProcessGone):
        process.seal(plan)
    assert not half_made.exists()


def test_it_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = growing(tmp_path / "log")
    stranger = tmp_path / "folder"
    for module in ("json.py", "queue.py", "eventsrc/__init__.py"):
        (stranger / module).parent.mkdir(parents=True, exist_ok=True)
        (stranger / module).write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    monkeypatch.chdir(stranger)
    process = SealingProcess()
    process.seal(plan)
    process.close()
    assert not (tmp_path / "executed").exists()


def test_errors_come_back_as_they_were(tmp_path: Path) -> None:
    plan = growing(tmp_path / "log")
    process = SealingProcess()
    active = plan.log / f"{0:020d}.mcap.active"
    data = bytearray(active.read_bytes())
    data[data.index(b'"type"') if b'"type"' in data else len(data) // 2] ^= 1
    active.write_bytes(data)
    with pytest.raises(LogDamaged, match="CRC"):
        process.seal(plan)
    active.unlink()
    with pytest.raises(FileNotFoundError):
        process.seal(plan)
    process.close()
    with pytest.raises(ProcessGone):
        process.seal(plan)
    assert [p.name for p in plan.log.iterdir()] == ["lock"]


def test_a_dead_writer_leaves_nothing_that_stands_in_the_next_ones_way(log_path: Path) -> None:
    """The process writes under a name of its own, and puts nothing in place by itself."""
    plan = growing(log_path)
    process = SealingProcess()
    process._to.write(
        b'{"log": "%s", "log_id": "%s", "base": 0, "previous_sha256": "", '
        b'"following": 5}\n' % (str(log_path).encode(), plan.log_id.encode())
    )
    process._from.close()
    process._to.close()  # the writer is killed here
    with LogWriter(log_path) as writer:
        assert writer.next_offset == 5
        writer.append(KEY, b"next")
    process._process.wait(TIMEOUT_S)
    assert [e.payload for e in read_log(log_path)][-1] == b"next"
    assert sorted(p.suffix for p in log_path.iterdir() if p.suffix) == [".mcap", ".mcap"]
