"""Parsing a log in several processes: the events, their order and the errors are those of one.

The oracle is `parsed_stretches` of a plain reader, in this process.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader, LogWriter
from projections.map import parsed_log
from projections.map.parsed_log import ParsedLog, default_workers
from projections.map.parsing import parsed_stretches
from tests.property.test_parsed_bytes import comparable
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import BY_HAND, KEY, flip
from tests.support.logs import write_random_log
from tests.support.thorough import mostly_slow, rounds

COUNT = 400


@pytest.fixture(autouse=True)
def _small_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that small logs are shared out."""
    monkeypatch.setattr(parsed_log, "MIN_EVENTS", 1)
    monkeypatch.setattr(parsed_log, "EVENTS_PER_WORKER", 1)
    monkeypatch.setattr(parsed_log, "_RANGE_BYTES", 4096)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed by tests."""
    return write_random_log(tmp_path_factory.mktemp("parsed") / "log", 7, COUNT)


def one_process(log: Path, until: int | None = None) -> tuple[list[Any], str | None]:
    """The events, and the damage after them."""
    with LogReader(log) as reader:
        end = reader.next_offset if until is None else Offset(until)
        return gathered(parsed_stretches(reader.read(Offset(0), end)))


def gathered(stretches: Iterator[list[Any]]) -> tuple[list[Any], str | None]:
    found: list[Any] = []
    try:
        for stretch in stretches:
            found += map(comparable, stretch)
    except LogDamaged as error:
        return found, str(error)
    return found, None


@contextlib.contextmanager
def parsing(log: Path, workers: int, until: int | None = None) -> Iterator[ParsedLog]:
    """With all processes started and ready, so that they get ranges from the first on."""
    with LogReader(log) as reader:
        end = reader.next_offset if until is None else Offset(until)
        with ParsedLog(reader, end, workers) as parsed:
            for process in parsed._alive:
                assert wait([process.connection], 60)
            yield parsed


def pids(parsed: ParsedLog) -> list[int]:
    return [process._process.pid for process in parsed._alive]


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The ranges that this process reads itself."""
    ranges: list[tuple[int, int]] = []
    read = ParsedLog._here

    def noted(self: ParsedLog, start: Offset, end: Offset) -> Iterator[list[Any]]:
        ranges.append((start, end))
        return read(self, start, end)

    monkeypatch.setattr(ParsedLog, "_here", noted)
    return ranges


@pytest.mark.seconds
@pytest.mark.parametrize("workers", mostly_slow([2, 1, 3]))
def test_processes_give_the_events_of_one(
    log: Path, workers: int, here: list[tuple[int, int]]
) -> None:
    with parsing(log, workers) as parsed:
        assert gathered(parsed.stretches()) == one_process(log)
        assert (parsed.started, parsed.lost) == (workers, 0)
    assert here == []


@pytest.mark.slow
def test_random_logs_damaged_or_not(tmp_path: Path) -> None:
    for seed in range(12):
        path = write_random_log(tmp_path / f"log-{seed}", seed)
        rng = random.Random(seed)
        if seed % 3:
            damaged = rng.choice(sorted(path.glob("*.mcap")))
            flip(damaged, rng.randrange(damaged.stat().st_size))
        for until in (None, rng.randrange(150)):
            try:
                expected = one_process(path, until)
            except LogDamaged:
                continue  # the newest segment cannot be opened at all
            with parsing(path, 1 + seed % 3, until) as parsed:
                assert gathered(parsed.stretches()) == expected


@pytest.mark.slow
@pytest.mark.seconds
@pytest.mark.parametrize("kind", mostly_slow(["a byte", "a segment", "no file"]))
def test_damage_is_named_as_by_one_process(tmp_path: Path, kind: str) -> None:
    path = write_random_log(tmp_path / "log", 3)  # rotates often
    files = sorted(path.glob("*.mcap"))
    assert len(files) > 3
    if kind == "a byte":
        flip(files[2], files[2].stat().st_size // 3)
    elif kind == "a segment":
        flip(files[2], files[2].stat().st_size - 20)
    else:
        files[2].unlink()
    expected = one_process(path)
    assert expected[0]
    assert expected[1] is not None
    with parsing(path, rounds(2, 1)) as parsed:
        assert gathered(parsed.stretches()) == expected


@pytest.mark.slow
@pytest.mark.seconds
@pytest.mark.parametrize("killed", mostly_slow([1, 2]))
def test_a_killed_process_costs_nothing_but_time(log: Path, killed: int) -> None:
    with parsing(log, 2) as parsed:
        found = parsed.stretches()
        first = [comparable(each) for each in next(found)]
        for pid in pids(parsed)[:killed]:
            os.kill(pid, signal.SIGKILL)
        rest, damage = gathered(found)
        assert (first + rest, damage) == one_process(log)
        assert parsed.lost == killed


@pytest.mark.slow
def test_processes_killed_at_random_moments(log: Path) -> None:
    expected, rng = one_process(log)[0], random.Random(1)
    for _ in range(rounds(25, 5)):
        with parsing(log, 3) as parsed:
            victims = {rng.randrange(len(expected)): pid for pid in pids(parsed)}
            found: list[Any] = []
            for stretch in parsed.stretches():
                for event in stretch:
                    if len(found) in victims:
                        os.kill(victims[len(found)], rng.choice([signal.SIGKILL, signal.SIGSEGV]))
                    found.append(comparable(event))
            assert found == expected


@pytest.mark.slow
def test_a_stopped_process_is_given_up(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parsed_log, "PATIENCE_S", 0.2)
    with parsing(log, 1) as parsed:
        os.kill(pids(parsed)[0], signal.SIGSTOP)
        assert gathered(parsed.stretches()) == one_process(log)
        assert parsed.lost == 1


def test_without_processes_the_log_is_read_here(
    log: Path, monkeypatch: pytest.MonkeyPatch, here: list[tuple[int, int]]
) -> None:
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with LogReader(log) as reader, ParsedLog(reader, reader.next_offset, 3) as parsed:
        assert (parsed.started, parsed.lost) == (0, 0)
        assert gathered(parsed.stretches()) == one_process(log)
    assert here == [(0, reader.next_offset)]


def test_entries_of_the_module_path_that_python_passes_over(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(".")
    sys.path.insert(0, Path())  # type: ignore[arg-type]
    with parsing(log, 1) as parsed:
        assert (parsed.started, parsed.lost) == (1, 0)


@pytest.mark.slow
def test_a_process_that_ends_at_once(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parsed_log, "_parse_ranges", sys.exit)
    with parsing(log, 2) as parsed:
        assert gathered(parsed.stretches()) == one_process(log)
        assert (parsed.started, parsed.lost) == (2, 2)


def parse_into_small_slots(*arguments: Any) -> None:
    """In a worker process: as `_parse_ranges`, with other slots."""
    parsed_log.SLOT_BYTES = 64 * 1024  # type: ignore[misc]
    parsed_log._parse_ranges(*arguments)


@pytest.mark.seconds
def test_events_that_no_slot_has_room_for(
    tmp_path: Path, here: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parsed_log, "SLOT_BYTES", 64 * 1024)
    monkeypatch.setattr(parsed_log, "_parse_ranges", parse_into_small_slots)
    path, vector = tmp_path / "log", [1.0] * 8000
    with LogWriter(path, fsync=BY_HAND) as writer:
        for k in range(30):
            seen = [detection("cup", vector)] if k % 10 == 0 else []
            writer.append(KEY, payload(envelope(k, detections=seen)))
            writer.sync()
    with parsing(path, 1) as parsed:
        assert gathered(parsed.stretches()) == one_process(path)
        assert parsed.lost == 0
    assert 0 < len(here) < 30


@pytest.mark.slow
@pytest.mark.seconds
def test_a_log_that_grows_and_is_sealed_meanwhile(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with LogWriter(path, fsync=BY_HAND, rotate_events=60) as writer:
        for k in range(100):
            writer.append(KEY, payload(envelope(k)))
            if k % 7 == 0:
                writer.sync()
        writer.sync()
        expected = one_process(path)
        with parsing(path, rounds(2, 1)) as parsed:
            found = parsed.stretches()
            first = [comparable(each) for each in next(found)]
            for k in range(100, 200):
                writer.append(KEY, payload(envelope(k)))
            writer.sync()
            rest, damage = gathered(found)
    assert (first + rest, damage) == expected
    assert len(expected[0]) == 100


def test_the_processes_end_with_the_context(log: Path) -> None:
    ended: list[int] = []

    def interrupted() -> None:
        with parsing(log, 1) as parsed:
            ended.extend(pids(parsed))
            next(parsed.stretches())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(ProcessLookupError):
        os.kill(ended[0], 0)


@pytest.mark.seconds
@pytest.mark.slow
def test_a_killed_parent_leaves_no_process(log: Path) -> None:
    program = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from eventsrc.log import LogReader\n"
        "from projections.map import parsed_log\n"
        "parsed_log.MIN_EVENTS = parsed_log.EVENTS_PER_WORKER = 1\n"
        "with LogReader(Path(sys.argv[1])) as reader:\n"
        "    with parsed_log.ParsedLog(reader, reader.next_offset, 2) as parsed:\n"
        "        print(*[p._process.pid for p in parsed._alive], flush=True)\n"
        "        sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(log)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        handles = [os.pidfd_open(int(pid)) for pid in parent.stdout.readline().split()]
        parent.kill()
    assert len(handles) == 2
    for handle in handles:
        assert wait([handle], 30)  # readable when the process has ended
        os.close(handle)


def test_small_logs_start_no_process(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    with LogReader(log) as reader, ParsedLog(reader, reader.next_offset, 64) as parsed:
        assert parsed.started == 0


@pytest.mark.slow
def test_more_processes_than_anything(log: Path) -> None:
    with parsing(log, 64) as parsed:
        assert gathered(parsed.stretches()) == one_process(log)
        assert parsed.started == 64


def test_a_process_for_each_further_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    for processors, workers in ((1, 0), (2, 1), (4, 3), (5, 4), (64, 4)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=processors: set(range(n)))
        assert default_workers() == workers
