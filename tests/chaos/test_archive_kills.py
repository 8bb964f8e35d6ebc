"""kill -9 on `log archive`, `log retain`, `log restore` and `log redact`: every command goes on, no
event is lost, and what was redacted is nowhere.

At each call of a store and each change of a file, one after the other; and at random ones beside a
recorder, as many of each command as `MAPFOLD_KILLS` says:

    MAPFOLD_KILLS=50 python -m pytest -m slow -s tests/chaos/test_archive_kills.py
"""

import json
import os
import random
import select
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

from eventsrc.base.errors import LogBusy
from eventsrc.base.object_store import ObjectStore
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.log.archive import Archive
from eventsrc.log.away import restore_log
from eventsrc.log.verify import verify_archive
from tests.integration.test_archive import bytes_of, recorded
from tests.support import prefork
from tests.support.byte_search import holds
from tests.support.commands import PROGRAM, Commands
from tests.support.dying import DYING
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.thorough import stride

REDACT = ("log", "redact", "log", "--class", "person", "--reason", "a test")
PATIENCE_S = 60.0


def killed_at(mapfold: Commands, calls: int, *words: str, codes: tuple[int, ...] = (0,)) -> bool:
    """Run a command that dies at this call; False if it ended before, with one of these codes."""
    argv = [str(PROGRAM), str(calls), *words]
    program = prefork.start(DYING, argv, env=mapfold.env, cwd=mapfold.folder)
    try:
        code = program.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:  # --follow, with nothing more to do
        program.kill()
        program.wait()
        return True
    assert code in (-9, *codes), (code, *words)
    return code == -9


@pytest.mark.seconds
@pytest.mark.parametrize("command", ["archive", "retain", "restore"])
def test_killed_at_each_call_it_goes_on(command: str, tmp_path: Path) -> None:
    log, mapfold = recorded(tmp_path / "log"), Commands.in_folder(tmp_path)
    url, whole = f"file://{tmp_path}/archive", bytes_of(log)
    words = {
        "archive": ("log", "archive", "log", url),
        "retain": ("log", "retain", "log", "--keep-bytes", "0"),
        "restore": ("log", "restore", url, "back"),
    }[command]
    if command != "archive":
        mapfold("log", "archive", "log", url)
    for calls in count(0, stride(5)):
        if not killed_at(mapfold, calls, *words):
            break
        if command != "retain":  # from the beginning; of what is retained, less is left each time
            mapfold(*words)
            there = tmp_path / ("archive" if command == "archive" else "back")
            assert command == "archive" or bytes_of(there) == whole
            assert verify_archive(ObjectStore(url)).findings == ()
            assert verify_archive(ObjectStore(url)).events == 60
            shutil.rmtree(there)
            (log / ".archive.json").unlink(missing_ok=True)
    assert calls > 5
    with LogReader(log) as reader:
        assert len(list(reader.read())) == 60
    mapfold("log", "restore", url, "log")
    LogWriter(log).close()  # deletes half-made files
    assert bytes_of(log) == whole


def record() -> None:
    """Record keyframes, with a person in every third, in the log ``argv[1]``, one every ``argv[2]``
    seconds; keep in the file ``argv[3]`` how many were synced. A line on stdin is answered by one:
    ``pause`` lets the log go, ``stop`` ends."""
    log, pace_s, synced = Path(sys.argv[1]), float(sys.argv[2]), os.open(sys.argv[3], os.O_RDWR)
    number, word = 0, "go"
    while word != "stop":
        if word == "go":
            try:
                with LogWriter(log, rotate_events=10) as writer:
                    while not (asked := select.select([0], [], [], pace_s)[0]):
                        writer.append(KEY, payload(seen(number)))
                        writer.sync()
                        number += 1
                        os.pwrite(synced, number.to_bytes(8, "little"), 0)
            except LogBusy:  # a redaction has it
                asked = select.select([0], [], [], 0.01)[0]
        else:
            asked = select.select([0], [], [], None)[0]
        if asked:
            word = os.read(0, 100).decode().strip()
            os.write(1, b"done\n")


def seen(number: int) -> dict[str, object]:
    """A keyframe; in every third there is a person."""
    things = [detection("cup", [1.0, 0.0, 0.0, 0.1 * (number % 3)])]
    if number % 3 == 0:
        things.append(detection("person", [0.5, 0.5, 0.0, 0.0], note=f"face-{number}-"))
    return envelope(number, 0.4 * (number % 40), 0.0, detections=things)


class Recorder:
    """A recorder in a process of its own."""

    def __init__(self, mapfold: Commands, pace_s: float) -> None:
        self._stdin, self._commands = os.pipe()
        self._answers, self._stdout = os.pipe()
        self._synced = mapfold.folder / "synced"
        self._synced.write_bytes(bytes(8))
        argv = ["record", str(mapfold.folder / "log"), str(pace_s), str(self._synced)]
        streams = {"stdin": self._stdin, "stdout": self._stdout}
        entry = f"{__name__}:record"
        self._program = prefork.start(entry, argv, env=mapfold.env, cwd=mapfold.folder, **streams)

    @property
    def synced(self) -> int:
        """How many keyframes are on the disk."""
        return int.from_bytes(self._synced.read_bytes(), "little")

    def tell(self, word: str) -> None:
        """Say a word, and wait until it is done."""
        os.write(self._commands, f"{word}\n".encode())
        assert os.read(self._answers, 100) == b"done\n"

    @contextmanager
    def paused(self, *, whole: bool) -> Iterator[None]:
        """Let others write; unless ``whole``, contend with them from the beginning."""
        self.tell("pause")
        if not whole:
            self.tell("go")
        yield
        self.tell("go")

    def end(self) -> None:
        """Stop and close the log."""
        self.tell("stop")
        assert self._program.wait(PATIENCE_S) == 0
        for fd in (self._stdin, self._commands, self._answers, self._stdout):
            os.close(fd)


def kill_beside_a_recorder(folder: Path, kills: int, pace_s: float, seed: int) -> Counter[str]:
    """Kill each command ``kills`` times; what was killed, and how many events there were."""
    chance, mapfold = random.Random(seed), Commands.in_folder(folder)
    url, done = f"file://{folder}/archive", Counter[str]()
    recorder = Recorder(mapfold, pace_s)

    def kill(name: str, *words: str, codes: tuple[int, ...] = (0,)) -> None:
        if done[name] < kills:
            done[name] += killed_at(mapfold, chance.randrange(60), *words, codes=codes)

    while recorder.synced < 30:
        mapfold("log", "info", "log", code=None)
    mapfold("log", "archive", "log", url)
    while min(done[name] for name in ("archive", "retain", "restore", "redact")) < kills:
        follow = ("--follow",) if chance.random() < 0.5 else ()
        kill("archive", "log", "archive", "log", url, *follow)
        mapfold("log", "archive", "log", url)
        kill("retain", "log", "retain", "log", "--keep-bytes", "0")
        kill("restore", "log", "restore", url, chance.choice(["back", "log"]))
        mapfold("log", "restore", url, "log")
        if (folder / "back").exists():  # else it was killed too early
            mapfold("log", "restore", url, "back")
            assert verify_log(folder / "back").findings == ()
            shutil.rmtree(folder / "back")
        with recorder.paused(whole=chance.random() < 0.7):
            kill("redact", *REDACT, codes=(0, 1))  # 1: the recorder has the log
        with recorder.paused(whole=True):
            mapfold("log", "redact", "log", "--resume")
    recorder.end()
    mapfold(*REDACT)
    mapfold("log", "archive", "log", url)
    mapfold("log", "retain", "log", "--keep-bytes", "0")
    done["events lost"] = lost(folder / "log", recorder.synced)
    assert verify_log(folder / "log").findings == ()
    assert verify_archive(ObjectStore(url)).findings == ()
    assert verify_archive(ObjectStore(url)).unnamed == ()
    restore_log(Archive(ObjectStore(url)), folder / "back")
    done["events lost"] += lost(folder / "back", recorder.synced)
    done["redacted payloads found"] = len(holds(folder, [b"face-"]))
    done["events"] = recorder.synced
    return done


def lost(log: Path, synced: int) -> int:
    """How many of the synced keyframes a log has not."""
    with LogReader(log) as reader:
        there = {json.loads(e.payload)["keyframe_id"] for e in reader.read() if e.is_envelope}
    return len(set(range(synced)) - there)


@pytest.mark.slow
def test_killed_beside_a_recorder(tmp_path: Path) -> None:
    kills = int(os.environ.get("MAPFOLD_KILLS", "3"))
    done = kill_beside_a_recorder(tmp_path, kills, 0.02 if kills < 10 else 0.1, 20261129)
    print(dict(done))
    assert done["events lost"] == done["redacted payloads found"] == 0
