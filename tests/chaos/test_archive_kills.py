"""kill -9 on `log archive`, `log retain` and `log restore` at random moments, while a recorder
records: every command goes on, and no event is lost."""

import random
import subprocess
import threading
from pathlib import Path

import pytest

from eventsrc.base.object_store import ObjectStore
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.log.archive import Archive
from eventsrc.log.away import restore_log
from eventsrc.log.verify import verify_archive
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.thorough import rounds

LONGEST_LIFE_S = 0.5


class Recorder:
    """Records an event every few milliseconds in a thread, in small segments."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self.has_sealed = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._record)
        self._thread.start()

    def _record(self) -> None:
        with LogWriter(self._log, rotate_events=20) as writer:
            while not self._stop.wait(0.003):
                writer.append(KEY, payload(envelope(writer.next_offset)))
                writer.sync()
                if not self.has_sealed.is_set() and any(self._log.glob("*.mcap")):
                    self.has_sealed.set()

    def end(self) -> None:
        """Stop and close the log."""
        self._stop.set()
        self._thread.join()


def kill_at_random(mapfold: Commands, chance: random.Random, *words: str) -> bool:
    """Start a command and kill it soon; whether it had ended by itself, which must have been well
    done."""
    program = mapfold.start(*words)
    try:
        program.wait(chance.uniform(0.02, LONGEST_LIFE_S))
    except subprocess.TimeoutExpired:
        program.kill()
        program.wait()
        return False
    assert program.returncode == 0, words
    return True


def kill_again_and_again(folder: Path, kills: int, seed: int) -> None:
    """Kill archivers and retentions beside a recorder, then restores; compare all."""
    print(f"kills={kills} seed={seed}")
    chance, mapfold = random.Random(seed), Commands.in_folder(folder)
    log, url = folder / "log", f"file://{folder}/archive"
    recorder = Recorder(log)
    try:
        killed = 0
        assert recorder.has_sealed.wait(60.0)
        mapfold("log", "archive", "log", url)  # so that there is one to retain by
        while killed < kills:
            follow = ("--follow",) if chance.random() < 0.5 else ()
            killed += not kill_at_random(mapfold, chance, "log", "archive", "log", url, *follow)
            killed += not kill_at_random(
                mapfold, chance, "log", "retain", "log", "--keep-bytes", "0"
            )
    finally:
        recorder.end()
    mapfold("log", "archive", "log", url)
    mapfold("log", "retain", "log", "--keep-bytes", "0")
    with LogReader(log) as reader:
        recorded = list(reader.read())
    assert [each.offset for each in recorded] == list(range(len(recorded)))
    assert verify_log(log).findings == ()
    assert verify_archive(ObjectStore(url)).findings == ()
    for _ in range(kills):
        if kill_at_random(mapfold, chance, "log", "restore", url, "back"):
            break
    restore_log(Archive(ObjectStore(url)), folder / "back")
    with LogReader(folder / "back") as reader:
        assert list(reader.read()) == recorded
    assert verify_log(folder / "back").findings == ()


@pytest.mark.seconds
def test_ten_kills(tmp_path: Path) -> None:
    kill_again_and_again(tmp_path, rounds(50, 10), 20261128)


@pytest.mark.slow
def test_fifty_kills(tmp_path: Path) -> None:
    kill_again_and_again(tmp_path, 50, 20261129)
