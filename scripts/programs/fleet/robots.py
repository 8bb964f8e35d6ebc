"""The robots of one site in one process, each with a publisher, a session and a spool of its own.

    robots.py ENDPOINT KEY SITE ROBOTS PER_SECOND SECONDS FOLDER LIFE SPREAD

It prints ``ready``, begins at the first line of its standard input and publishes for SECONDS, or
until its input ends, then waits until everything is acknowledged. The last line is a JSON document.

Every keyframe is written to FOLDER/published-SITE-LIFE.jsonl when `publish` has returned, so what
is in that file is in the spool, also when this process is killed.
"""

import json
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from eventsrc.record.robot.acks import Ack, payload_sha256
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, ZenohOptions, open_session
from tests.support.envelopes import detection, envelope

DIM = 512
FLUSH_S = 120.0
"""How long the last acknowledgements may take."""
RESEND_AFTER_S = 2.0


def robot_name(site: int, number: int) -> str:
    """Of robot ``number`` at a site."""
    return f"site-{site}-robot-{number:03d}"


def run_id(site: int, number: int, life: int) -> str:
    """A robot that starts again begins a new run."""
    return f"{robot_name(site, number)}-run-{life}"


class Robot:
    """Makes envelopes of 9 kB: three detections, each with 512 numbers that no other has."""

    def __init__(self, site: int, number: int, life: int, publisher: EnvelopePublisher) -> None:
        self._rng = np.random.default_rng([site, number, life])
        self.publisher = publisher
        self.run_id = run_id(site, number, life)
        self._x, self._y = self._rng.uniform(-20.0, 20.0, 2).tolist()
        self.next_keyframe = 0

    def _detection(self, name: str) -> dict[str, Any]:
        vector = self._rng.standard_normal(DIM, dtype=np.float32)
        return detection(name, vector, confidence=round(float(self._rng.uniform(0.5, 1.0)), 3))

    def publish(self) -> tuple[int, str]:
        """Publish the next keyframe; its id and the digest of its payload."""
        number = self.next_keyframe
        document = envelope(
            number,
            self._x + 0.01 * number,
            self._y,
            run_id=self.run_id,
            timestamp=time.time(),
            detections=[self._detection(name) for name in ("cup", "chair", "table")],
        )
        payload = json.dumps(document).encode()
        self.publisher.publish(payload)
        self.next_keyframe += 1
        return number, payload_sha256(payload)


class Lags:
    """Seconds from `publish` to the acknowledgement, which says that the keyframe is synced."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._published: dict[str, float] = {}
        self._early: dict[str, float] = {}
        self.seconds: list[float] = []

    def published(self, sha256: str, at: float) -> None:
        """Note a keyframe of which `publish` was called at ``at``."""
        with self._lock:
            acknowledged = self._early.pop(sha256, None)
            if acknowledged is None:
                self._published[sha256] = at
            else:
                self.seconds.append(acknowledged - at)

    def receive(self, message: Received) -> None:
        """Note the digests of an acknowledgement; a second one of the same is not counted."""
        now = time.monotonic()
        if "/refused/" in message.key:
            return
        for sha256 in Ack.decode(message.payload).sha256:
            with self._lock:
                at = self._published.pop(sha256, None)
                if at is None:
                    self._early[sha256] = now
                else:
                    self.seconds.append(now - at)


def publish_all(
    robots: list[Robot], per_second: float, seconds: float, spread: bool, out: TextIO, lags: Lags
) -> int:
    """Publish from all robots in turn, evenly over each period or all at its start; how many."""
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    begin = time.monotonic()
    count = 0
    for number in range(int(seconds * per_second)):
        for index, robot in enumerate(robots):
            phase = index / len(robots) if spread else 0.0
            wait = begin + (number + phase) / per_second - time.monotonic()
            if wait > 0 and ended.wait(wait):
                return count
            at = time.monotonic()
            keyframe, sha256 = robot.publish()
            out.write(json.dumps([robot.run_id, keyframe, sha256]) + "\n")
            out.flush()
            lags.published(sha256, at)
            count += 1
    return count


def main() -> None:
    """Run the site's robots."""
    endpoint, key, site, count, per_second, seconds, folder, life, spread = sys.argv[1:]
    options = ZenohOptions(connect=(endpoint,))
    lags = Lags()
    path = Path(folder) / f"published-{site}-{life}.jsonl"
    with ExitStack() as stack:
        out = stack.enter_context(path.open("a"))
        watcher = stack.enter_context(open_session(options, mode="client"))
        watcher.subscribe("mapfold/ack/*", lags.receive)
        robots = []
        for number in range(int(count)):
            spool = Path(folder) / "spools" / f"{robot_name(int(site), number)}.sqlite"
            publisher = EnvelopePublisher(options, spool, key, resend_after_s=RESEND_AFTER_S)
            stack.callback(publisher.close)
            robots.append(Robot(int(site), number, int(life), publisher))
        resumed = sum(robot.publisher.unacknowledged for robot in robots)
        print("ready", flush=True)
        sys.stdin.readline()
        before_s = time.process_time()
        published = publish_all(robots, float(per_second), float(seconds), spread == "1", out, lags)
        deadline = time.monotonic() + FLUSH_S
        for robot in robots:
            robot.publisher.flush(max(0.0, deadline - time.monotonic()))
        summary = {
            "published": published,
            "resumed": resumed,
            "unacknowledged": sum(robot.publisher.unacknowledged for robot in robots),
            "refused": sum(robot.publisher.refused_count for robot in robots),
            "cpu_s": time.process_time() - before_s,
            "lags_s": [round(lag, 5) for lag in lags.seconds],
        }
        print(json.dumps(summary), flush=True)


if __name__ == "__main__":
    main()
