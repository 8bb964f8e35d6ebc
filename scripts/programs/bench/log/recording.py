"""Recording through a loopback router: publisher, router and recorder in processes of their own."""

import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.log.durable_files import FsyncPolicy
from eventsrc.record.log_info import log_info
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.transport.session import ZenohOptions, open_session
from tests.support.commands import UnusedCpu, cpu_seconds, unused_cpu

from .payloads import KEY
from .plain import PlainFile

ROUTER = """
import sys
from eventsrc.record.transport.session import ZenohOptions
from eventsrc.record.transport.session import Router
with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router:
    print(router.endpoints[0], flush=True)
    sys.stdin.read()
"""
PUBLISHER = """
import sys, time
from eventsrc.record.transport.session import ZenohOptions, open_session
from scripts.programs.bench.log.payloads import KEY, Payloads
endpoint, rate, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
payloads = Payloads()
with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
    publisher = session.publisher(KEY)
    assert publisher.wait_for_subscriber(30.0)
    start = time.perf_counter()
    number = 0
    while (now := time.perf_counter() - start) < seconds:
        ahead = number / rate - now
        if ahead > 0.002:
            time.sleep(ahead)
        publisher.put(payloads[number])
        number += 1
    session.confirm()
    print(number, flush=True)
    sys.stdin.read()
"""
UNPACED = float("inf")
"""As fast as the recorder takes it: a reliable, blocking publisher is slowed down and loses nothing
when the receiver cannot keep up."""
ROOT = Path(__file__).parents[4]


@contextmanager
def program(code: str, *args: str) -> Iterator["subprocess.Popen[str]"]:
    """Python code in a process of its own, which ends when its standard input is closed."""
    command = [sys.executable, "-c", code, *args]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


def said(process: "subprocess.Popen[str]") -> str:
    """The next line a program prints."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


@dataclass(frozen=True)
class Recording:
    """``per_s`` is events a second from the logging of the first to that of the last. ``unsealed``
    segments were left at the end, and sealing them took ``sealing_s`` seconds more. ``cpu_us`` is
    processor time for each event, by process: unlike the rate it hardly depends on what else the
    machine does. ``unused`` is the part of all processors' time that no program got meanwhile."""

    published: int
    recorded: int
    per_s: float
    unsealed: int
    sealing_s: float
    cpu_us: Mapping[str, float]
    unused: UnusedCpu | None

    @property
    def lost(self) -> int:
        """Messages published and not recorded."""
        return self.published - self.recorded


class _Until:
    """Sets ``stop`` when everything that a publisher says it published has come, or when it takes
    too long."""

    def __init__(self, publisher: "subprocess.Popen[str]", seconds: float) -> None:
        self.stop = threading.Event()
        self.published = 0
        self._give_up = threading.Timer(seconds * 2 + 20, self.stop.set)
        self._give_up.start()
        self._listener = threading.Thread(target=self._listen, args=(publisher,))
        self._listener.start()

    def _listen(self, publisher: "subprocess.Popen[str]") -> None:
        self.published = int(said(publisher))

    def check(self, arrived: int) -> None:
        """To be called from time to time with the number of messages so far."""
        if self.published and arrived >= self.published:
            self.stop.set()

    def end(self) -> None:
        """End the timer and the thread."""
        self._give_up.cancel()
        self._listener.join()


def record(log: Path, fsync: FsyncPolicy, rate: float, seconds: float) -> Recording:
    """Publish at ``rate`` for ``seconds`` and record all of it, as `mapfold record` does."""
    with program(ROUTER) as router:
        endpoint = said(router)
        with (
            LogWriter(log, fsync=fsync, sealing_process=True) as writer,
            open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session,
        ):
            recorder = Recorder(session, writer, [KEY])
            unused_before, start = unused_cpu(), time.perf_counter()
            before = {"recorder": cpu_seconds(os.getpid()), "router": cpu_seconds(router.pid)}
            with program(PUBLISHER, endpoint, str(rate), str(seconds)) as publisher:
                until = _Until(publisher, seconds)
                report = recorder.run(
                    until.stop, every_s=0.05, watch=lambda now: until.check(now.recorded)
                )
                until.end()
                used = {
                    "recorder": cpu_seconds(os.getpid()) - before["recorder"],
                    "router": cpu_seconds(router.pid) - before["router"],
                    "publisher": cpu_seconds(publisher.pid),
                }
            unused = _unused_part(unused_before, time.perf_counter() - start)
            unsealed = len(list(log.glob("*.active"))) - 1
            begun, ended = time.perf_counter(), _ended_cpu_s()
        used["sealing"] = _ended_cpu_s() - ended  # all ended processes: only the sealer is new
    sealing_s = time.perf_counter() - begun
    per_s = _logged_per_s(log)
    cpu_us = {name: s * 1e6 / max(1, report.recorded) for name, s in used.items()}
    return Recording(until.published, report.recorded, per_s, unsealed, sealing_s, cpu_us, unused)


def _unused_part(before: UnusedCpu | None, seconds: float) -> UnusedCpu | None:
    after = unused_cpu()
    if before is None or after is None:
        return None
    total = seconds * (os.cpu_count() or 1)
    return UnusedCpu(*(s / total for s in after.since(before)))


def _ended_cpu_s() -> float:
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return ended.ru_utime + ended.ru_stime


def subscribe_plain(path: Path, seconds: float) -> float:
    """The floor with Zenoh: the same bytes through a router to a plain file, with the same syncs
    and nothing else; events a second."""
    with program(ROUTER) as router, PlainFile(path) as file:
        endpoint = said(router)
        with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
            session.subscribe(KEY, lambda message: file.append(message.payload))
            session.confirm()
            with program(PUBLISHER, endpoint, str(UNPACED), str(seconds)) as publisher:
                until = _Until(publisher, seconds)
                while not until.stop.wait(0.05):
                    until.check(file.count)
                until.end()
            return file.per_s


def _logged_per_s(log: Path) -> float:
    """From the first event's logging to the last one's."""
    info = log_info(log)
    assert info.first_logged_ns is not None
    assert info.last_logged_ns is not None
    return (info.events - 1) * 1e9 / (info.last_logged_ns - info.first_logged_ns)
