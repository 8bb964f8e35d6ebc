"""Measure every claim about the log's speed in one run.

scripts/bench_log [--quick] [--seconds S] [--rate N] [--folder DIR] [NAME…]
names: record read latency
"""

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eventsrc.log import ALWAYS, GROUP_COMMIT, LogReader, LogWriter

from .latency import latency
from .payloads import KEY, Payloads
from .plain import append_plain, read_mcap
from .recording import UNPACED, Recording, record, subscribe_plain


@contextmanager
def fresh(folder: Path, name: str) -> Iterator[Path]:
    """A path for a log or a file, deleted afterwards."""
    path = folder / name
    yield path
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def say(what: str, value: str, wanted: str) -> None:
    """One line of the result."""
    print(f"{what:<58} {value:>18}   {wanted}", flush=True)


def bench_record(folder: Path, seconds: float, rate: float) -> None:
    """Recording through Zenoh at ``rate`` and unpaced; beside it the floor: a bare file loop and a
    bare Zenoh subscriber; and the log's writer alone."""
    payloads = Payloads()
    short = min(seconds, 5)
    with fresh(folder, "recorded") as path:
        done = record(path, GROUP_COMMIT, rate, seconds)
        say_recording(f"recorded for {seconds:.0f} s at {rate:,.0f}/s", done, "≥ 20,000/s")
    with fresh(folder, "recorded") as path:
        done = record(path, GROUP_COMMIT, UNPACED, seconds / 2)
        say_recording(f"recorded as fast as it goes for {seconds / 2:.0f} s", done, "")
    with fresh(folder, "plain") as path:
        say("floor: bare file loop", f"{append_plain(path, payloads, short):,.0f}/s", "")
    with fresh(folder, "plain") as path:
        say("floor: bare Zenoh subscriber", f"{subscribe_plain(path, 2 * short):,.0f}/s", "")
    with fresh(folder, "appended") as path:
        appended, sealed = append_log(path, payloads, short)
    say("LogWriter alone", f"{appended:,.0f}/s", "")
    say("LogWriter alone, until all is sealed", f"{sealed:,.0f}/s", "")


def say_recording(what: str, done: Recording, wanted: str) -> None:
    """The lines of a recording."""
    say(what, f"{done.per_s:,.0f}/s", wanted)
    say("  published and not recorded", f"{done.lost} of {done.published:,}", "0")
    say("  segments left to seal, and how long that took", sealing(done), "")
    each = done.cpu_us
    parts = ", ".join(f"{name} {each[name]:.1f}" for name in each)
    say(f"  processor µs for each event: {parts}", f"{sum(each.values()):.1f} µs", "")
    if (unused := done.unused) is not None:
        parts = f"idle {unused.idle:.0%}, idle while waiting for the disk {unused.disk:.0%}"
        say(f"  processors: {parts}, taken by the host", f"{unused.host:.0%}", "")
    say("  one-minute load of the machine", f"{os.getloadavg()[0]:.1f}", "")


def sealing(done: Recording) -> str:
    """How many segments were unsealed at the end of a recording, and the time to seal them."""
    return f"{done.unsealed}, {done.sealing_s:.1f} s"


def append_log(path: Path, payloads: Payloads, seconds: float) -> tuple[float, float]:
    """Append to a log one event at a time: events a second, and the same counting the time until
    all is sealed."""
    start = time.perf_counter()
    count = 0
    with LogWriter(path) as writer:
        while time.perf_counter() - start < seconds:
            writer.append(KEY, payloads[count])
            count += 1
        writer.sync()
        appended = time.perf_counter() - start
    return count / appended, count / (time.perf_counter() - start)


def bench_read(folder: Path, events: int) -> None:
    """Reading a long log of small events, then a shorter one of 9 kB events."""
    for detections, count in ((0, events), (3, events // 20)):
        payloads = Payloads(detections)
        with fresh(folder, "long") as path:
            with LogWriter(path, fsync=GROUP_COMMIT) as writer:
                for number in range(count):
                    writer.append(KEY, payloads[number])
            size = len(payloads[0])
            _read(path, f"{count:,} events of {size:,} bytes")


def _read(path: Path, what: str) -> None:
    start = time.perf_counter()
    with LogReader(path) as reader:
        last = list(reader.read(reader.next_offset - 10))
    ms = (time.perf_counter() - start) * 1e3
    assert len(last) == 10
    say(f"{what}: open, read the last ten", f"{ms:.1f} ms", "≤ 300 ms")
    bare = read_mcap(path)
    start = time.perf_counter()
    with LogReader(path) as reader:
        count = sum(1 for _ in reader.read())
    ours = count / (time.perf_counter() - start)
    bare = (bare + read_mcap(path)) / 2
    say(f"{what}: read all", f"{ours:,.0f}/s", "")
    say("  ours / mcap's stream reader (which checks no CRC)", f"{ours / bare:.2f}", "≥ 0.6")


def bench_latency(folder: Path, seconds: float) -> None:
    """Latency from publish to a tail in another process, at 200 events a second."""
    for name, policy, wanted in (
        ("group commit", GROUP_COMMIT, "p50 ≤ 60, p99 ≤ 150"),
        ("--fsync always", ALWAYS, ""),
    ):
        with fresh(folder, "tailed") as path:
            found = latency(path, policy, seconds)
        value = f"{found.p50:.1f} {found.p99:.1f} {found.worst:.1f} ms"
        say(f"publish to tail, {name}: p50 p99 worst", value, wanted)


def main() -> None:
    """Run the benchmarks named on the command line, or all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=["record", "read", "latency"])
    parser.add_argument("--quick", action="store_true", help="a tenth of everything")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=21_000.0)
    parser.add_argument("--folder", type=Path, help="on the disk to measure; default: /tmp")
    args = parser.parse_args()
    part = 0.1 if args.quick else 1.0
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        if "record" in args.names:
            bench_record(folder, args.seconds * part, args.rate)
        if "read" in args.names:
            bench_read(folder, int(1_000_000 * part))
        if "latency" in args.names:
            bench_latency(folder, args.seconds * part / 2)


if __name__ == "__main__":
    main()
