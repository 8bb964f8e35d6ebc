"""Recording through a loopback router: three processes, as in life."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from eventsrc._zenoh import ZenohOptions, open_session
from eventsrc.log import LogWriter, log_info
from eventsrc.log.fsync import FsyncPolicy
from eventsrc.recorder import Recorder

from .payloads import KEY

ROUTER = """
import sys
from eventsrc._zenoh import ZenohOptions
from eventsrc.router import Router
with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router:
    print(router.endpoints[0], flush=True)
    sys.stdin.read()
"""
PUBLISHER = """
import sys, time
from eventsrc._zenoh import ZenohOptions, open_session
from tests.bench.log.payloads import KEY, Payloads
endpoint, rate, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
payloads = Payloads()
with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
    publisher = session.publisher(KEY)
    assert publisher.wait_for_subscriber(30.0)
    start = time.perf_counter()
    for number in range(count):
        ahead = start + number / rate - time.perf_counter()
        if ahead > 0.002:
            time.sleep(ahead)
        publisher.put(payloads[number])
    session.confirm()
    print(count / (time.perf_counter() - start), flush=True)
    sys.stdin.read()
"""
ROOT = Path(__file__).parents[3]


@contextmanager
def program(code: str, *args: str) -> Iterator["subprocess.Popen[str]"]:
    """Python code in a process of its own, which ends when its standard input does."""
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
    """``lost`` are messages published and not recorded; rates are events a second."""

    published: int
    recorded: int
    published_per_s: float
    recorded_per_s: float

    @property
    def lost(self) -> int:
        """What did not get there."""
        return self.published - self.recorded


def record(log: Path, fsync: FsyncPolicy, rate: float, seconds: float) -> Recording:
    """Publish at ``rate`` for ``seconds`` and record all of it."""
    count = int(rate * seconds)
    stop = threading.Event()
    with program(ROUTER) as router:
        endpoint = said(router)
        with (
            LogWriter(log, fsync=fsync) as writer,
            open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session,
        ):
            recorder = Recorder(session, writer, [KEY], max_events=count)
            with program(PUBLISHER, endpoint, str(rate), str(count)) as publisher:
                give_up = threading.Timer(seconds * 2 + 10, stop.set)
                give_up.start()
                report = recorder.run(stop)
                give_up.cancel()
                published_per_s = float(said(publisher))
    return Recording(count, report.recorded, published_per_s, _logged_per_s(log))


def _logged_per_s(log: Path) -> float:
    """From the first event's logging to the last one's."""
    info = log_info(log)
    assert info.first_logged_ns is not None
    assert info.last_logged_ns is not None
    return (info.events - 1) * 1e9 / (info.last_logged_ns - info.first_logged_ns)
