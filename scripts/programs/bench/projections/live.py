"""The tail: events per second when behind, and delay when live."""

import threading
import time
from pathlib import Path

from eventsrc.log import LogReader, LogWriter, parse_fsync
from eventsrc.record.append import append_payload
from projections.fold.settings import Settings
from projections.postgres import TailProgress, TailReport, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.embedded import EmbeddedServer

from .world import KEY, World, make_log

BEHIND = 8_000
RATE = 100.0


def sustained(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """Keyframes per second of a tail that starts far behind."""
    size = BEHIND // 10 if quick else BEHIND
    log = make_log(folder / f"log-{size}", size)
    targets = Targets(server.url, server.url)
    rebuild(log, targets, Settings(), until=1)
    started, cpu = time.perf_counter(), time.process_time()
    report = tail(log, targets, Settings(), once=True)
    took = time.perf_counter() - started
    cpu = time.process_time() - cpu
    print(
        f"tail when behind: {report.events} keyframes in {took:.2f} s"
        f" = {report.events / took:.0f} keyframes/s (own CPU {cpu:.2f} s)"
    )


def latency(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """From durable in the log to visible in both queries, at 100 keyframes/s."""
    seconds = 5 if quick else 30
    log = make_log(folder / "log-live", 2_000)
    targets = Targets(server.url, server.url)
    progress = TailProgress()
    stop, seen = threading.Event(), _Visibility(server.url)
    durable: dict[int, float] = {}

    def on_batch(report: TailReport) -> None:
        seen.check(report.next_offset)

    thread = threading.Thread(
        target=tail,
        args=(log, targets, Settings()),
        kwargs={"stop": stop, "on_batch": on_batch, "progress": progress},
    )
    with LogReader(log) as reader:
        end = reader.next_offset
    rebuild(log, targets, Settings(), until=end - 1)
    thread.start()
    progress.wait(end, 120.0)  # it has folded what was there and follows now
    _publish(log, seconds, durable)
    stop.wait(1.0)
    stop.set()
    thread.join()
    delays = sorted(1000 * (seen.at(offset) - when) for offset, when in durable.items())
    p50, p99 = delays[len(delays) // 2], delays[int(len(delays) * 0.99)]
    print(
        f"tail live at {RATE:.0f}/s, {len(delays)} keyframes, durable to visible:"
        f" p50 {p50:.1f} ms, p99 {p99:.1f} ms"
    )


class _Visibility:
    """When each event was first visible to another session, in both databases' queries."""

    def __init__(self, url: str) -> None:
        self._connection = connect_for_cypher(url)
        self._visible: list[tuple[int, float]] = []

    def check(self, next_offset: int) -> None:
        """After a commit: check in another session whether the events are visible."""
        keyframes = self._connection.execute(
            'SELECT count(*) FROM semantic_map."Keyframe" WHERE id >= _graphid(4, %s)',
            [next_offset],
        ).fetchone()
        vector = self._connection.execute(
            "SELECT count(*) FROM detection_embeddings WHERE det_pk = %s", [3 * next_offset]
        ).fetchone()
        assert keyframes == (1,)
        assert vector == (1,)
        self._visible.append((next_offset, time.perf_counter()))

    def at(self, offset: int) -> float:
        """When the event at ``offset`` was visible."""
        return next(when for next_offset, when in self._visible if next_offset > offset)


def _publish(log: Path, seconds: int, durable: dict[int, float]) -> None:
    """Write at RATE with the default group commit; note when each event became durable."""
    world = World(11)
    with LogWriter(log, fsync=parse_fsync("50ms")) as writer:
        waiting: list[int] = []
        begin = time.perf_counter()
        first = writer.next_offset
        for i in range(int(seconds * RATE)):
            payload = world.payload(first + i)
            time.sleep(max(0.0, begin + i / RATE - time.perf_counter()))
            append_payload(writer, KEY, payload)
            waiting.append(first + i)
            writer.commit_if_due()
            now = time.perf_counter()
            while waiting and waiting[0] < writer.durable_offset:
                durable[waiting.pop(0)] = now
