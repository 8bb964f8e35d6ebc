"""Latency from `publish` in one process to the delivery by a tail in another."""

import json
import statistics
import threading
from dataclasses import dataclass
from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.log.durable_files import FsyncPolicy
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.transport.session import ZenohOptions, open_session

from .payloads import KEY
from .recording import ROUTER, program, said

RATE = 200
PUBLISHER = """
import sys, time
from eventsrc.record.transport.session import ZenohOptions, open_session
from scripts.programs.bench.log.payloads import KEY, Payloads
endpoint, rate, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
payloads = Payloads()
with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
    publisher = session.publisher(KEY)
    assert publisher.wait_for_subscriber(30.0)
    start = time.perf_counter()
    for number in range(count):
        time.sleep(max(0.0, start + number / rate - time.perf_counter()))
        publisher.put(b'{"sent_ns": %d, ' % time.time_ns() + payloads[number][1:])
    session.confirm()
    sys.stdin.read()
"""
TAIL = """
import json, sys, threading, time
from pathlib import Path
from eventsrc.log import follow
log, count = Path(sys.argv[1]), int(sys.argv[2])
stop, waited_ms = threading.Event(), []
print("ready", flush=True)
for event in follow(log, 0, stop=stop):
    if event is not None:
        now = time.time_ns()
        sent = int(event.payload[12:event.payload.index(b",")])
        waited_ms.append((now - sent) / 1e6)
        if len(waited_ms) == count:
            break
print(json.dumps(waited_ms), flush=True)
sys.stdin.read()
"""


@dataclass(frozen=True)
class Latency:
    """Milliseconds from publish to delivery."""

    p50: float
    p99: float
    worst: float


def latency(log: Path, fsync: FsyncPolicy, seconds: float) -> Latency:
    """200 events a second for ``seconds``."""
    count = int(RATE * seconds)
    with program(ROUTER) as router:
        endpoint = said(router)
        with (
            LogWriter(log, fsync=fsync) as writer,
            open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session,
        ):
            recorder = Recorder(session, writer, [KEY], max_events=count)
            with program(TAIL, str(log), str(count)) as tail:
                assert said(tail) == "ready"
                with program(PUBLISHER, endpoint, str(RATE), str(count)):
                    recorder.run(threading.Event())
                waited = json.loads(said(tail))
    cuts = statistics.quantiles(waited, n=100)
    return Latency(cuts[49], cuts[98], max(waited))
