"""Several plain publishers, reliable and blocking, on one router: every message is recorded once.

Their sessions stamp their messages or leave it to the router, so timestamps come out of order."""

import json

from eventsrc.log import LogReader
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.oracle import Oracle, digest
from tests.support.envelopes import envelope
from tests.support.fixtures_zenoh import DEADLINE_S, Program

CASES = ((1, 500), (2, 500), (5, 200), (20, 50))
"""How many publishers, and how many keyframes each sends a second."""
SECONDS = 2.0

PUBLISHERS = """
import json, sys, threading
from eventsrc.record.transport.session import ZenohOptions, open_session
from tests.support.envelopes import envelope

endpoint, publishers, per_second, count = sys.argv[1], *map(int, sys.argv[2:5])
pause = threading.Event()

def publish(number):
    with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
        publisher = session.publisher("tb/detections")
        assert publisher.wait_for_subscriber(30.0)
        for k in range(count):
            publisher.put(json.dumps(envelope(k, run_id=f"robot-{number}")).encode())
            pause.wait(1 / per_second)
        session.confirm()

threads = [threading.Thread(target=publish, args=(n,)) for n in range(publishers)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


def attack(arena: Arena) -> None:
    """Round 0: all cases, one after the other through one router; later one at random."""
    endpoint = arena.router()
    for publishers, per_second in CASES if arena.round == 0 else [arena.rng.choice(CASES)]:
        _one(arena, endpoint, publishers, per_second)


def _one(arena: Arena, endpoint: str, publishers: int, per_second: int) -> None:
    log, oracle = arena.folder / f"log-{publishers}", Oracle()
    count = int(per_second * SECONDS)
    recorder = arena.recorder(log, endpoint)
    program = Program(PUBLISHERS, [endpoint, str(publishers), str(per_second), str(count)])
    arena.stack.callback(program.close)
    if program.process.wait(2 * DEADLINE_S) != 0:
        arena.complain(f"publishers failed: {program.lines[-1:]}")
    for number in range(publishers):
        for k in range(count):
            payload = json.dumps(envelope(k, run_id=f"robot-{number}")).encode()
            oracle.sent(payload)
            oracle.acknowledged([digest(payload)])  # as good as: sent reliably, and blocking
    arena.finish(recorder, codes=(0,))
    arena.judge(oracle, log)
    with LogReader(log) as reader:
        if reader.next_offset != publishers * count:
            arena.complain(f"{reader.next_offset} events of {publishers} × {count}")
