"""Kills recorders under load at random moments, again and again, and counts what that cost.

    scripts/chaos_recorder --kills 10000 --progress kills.jsonl [--seed N]

Runs in batches. In each, several recorders are killed side by side, each with a log, a robot and
an editor of its own: `mapfold record --accept-edits` is a process of its own behind a real router,
the robot is the product's publisher with a spool, the editor sends each command until a recorder
answers. A recorder is killed while it starts, recovers its log, records or seals; in between
`mapfold log recover` is run and often killed too. After each kill, everything that was acknowledged
before it must be in the log, a command at the offset that the answer named; after the last one,
when a recorder was left in peace, the log must hold every envelope and each command once, no event
may have changed or moved, and the fold must count each keyframe once. (An envelope that was on its
way at a kill is sent again, so the log may have it again.)

Each finished batch is a line of the progress file; with the same file, an interrupted run goes on.
"""

import argparse
import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, fields
from itertools import count
from pathlib import Path

from eventsrc.base.errors import TransportError
from eventsrc.envelope.commands import Command, parse_command
from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.log.format import list_segments
from eventsrc.record.recorder.edits import send_command
from eventsrc.record.robot.acks import Ack, ack_key, payload_sha256
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, Router, ZenohOptions, open_session
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import LOOPBACK, MAPFOLD, Program
from tests.support.logs import name_place

LONGEST_LIFE_S = 0.6
LONGEST_RECOVERY_S = 0.06
PATIENCE_S = 300.0
COMMANDS_A_SECOND = 8.0
FAR = Offset(10**9)
EXPECTED = ("duplicate", "loss")
"""Findings about envelopes that were sent again, and about keyframes that came late."""
KEY = "tb/detections"


@dataclass
class Tally:
    """What came of some kills.

    Lost is what was acknowledged and is not in the log; ``missing`` what was published and is not,
    though a last recorder was left in peace. ``twice`` are commands that the log has twice and
    keyframes that the map does not have once; ``moved`` are events that were read at an offset and
    later were not there, or not the same. ``resent`` envelopes are in the log again.
    """

    kills: int = 0
    recoveries_killed: int = 0
    published: int = 0
    envelopes: int = 0
    commands: int = 0
    lost: int = 0
    missing: int = 0
    twice: int = 0
    moved: int = 0
    resent: int = 0
    findings: int = 0

    @property
    def good(self) -> bool:
        """Whether nothing was lost, is missing, counts twice, or has changed."""
        return not (self.lost or self.missing or self.twice or self.moved or self.findings)

    def add(self, other: "Tally") -> None:
        """Add the numbers of other kills."""
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(other, each.name))

    def __str__(self) -> str:
        return (
            f"{self.kills:,} recorders and {self.recoveries_killed:,} recoveries killed; "
            f"{self.published:,} envelopes published, {self.envelopes:,} of them and "
            f"{self.commands:,} commands acknowledged: {self.lost} lost, {self.missing} missing, "
            f"{self.twice} twice, {self.moved} changed or moved, {self.findings} other findings of "
            f"`log verify`; {self.resent:,} envelopes sent again"
        )


class Robot:
    """Publishes keyframes 0, 1, 2 … in a thread and notes which of them were acknowledged."""

    def __init__(self, endpoint: str, spool: Path, key: str, run: str, per_second: float) -> None:
        options = ZenohOptions(connect=(endpoint,))
        self.publisher = EnvelopePublisher(options, spool, key, resend_after_s=0.5)
        self.published = 0
        self._run = run
        self._acked: set[int] = set()
        self._keyframes: dict[str, int] = {}
        self._lock = threading.Lock()
        self._pause_s = 1 / per_second
        self._stop = threading.Event()
        self._watcher = open_session(options, mode="client")
        self._watcher.subscribe(ack_key(run), self._hear)  # type: ignore[arg-type]
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        while not self._stop.wait(self._pause_s):
            message = payload(envelope(self.published, run_id=self._run, note="x" * 4_000))
            with self._lock:
                self._keyframes[payload_sha256(message)] = self.published
            self.publisher.publish(message)
            self.published += 1

    def _hear(self, message: Received) -> None:
        with self._lock:
            acked = Ack.decode(message.payload).sha256
            self._acked.update(self._keyframes[digest] for digest in acked)

    def acknowledged(self) -> set[int]:
        """What was acknowledged by now."""
        with self._lock:
            return set(self._acked)

    def finish(self) -> bool:
        """Stop publishing; whether everything was acknowledged in time."""
        self._stop.set()
        self._thread.join()
        return self.publisher.flush(PATIENCE_S)

    def close(self) -> None:
        """Stop for good."""
        self._stop.set()
        self._thread.join()
        self.publisher.close()
        self._watcher.close()


class Editor:
    """Sends commands in a thread, each until it is acknowledged, and notes at which offset."""

    def __init__(self, endpoint: str, log_id: str, rng: random.Random) -> None:
        self._endpoint, self._log_id, self._rng = endpoint, log_id, rng
        self._acked: dict[str, int] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._edit)
        self._thread.start()

    def _edit(self) -> None:
        with open_session(ZenohOptions(connect=(self._endpoint,)), mode="client") as session:
            for number in count():
                if self._stop.wait(self._rng.expovariate(COMMANDS_A_SECOND)):
                    return
                given: Command = name_place(self._rng.randrange(60), f"room {number}")
                while not self._stop.is_set():
                    try:
                        answer = send_command(session, self._log_id, given, FAR, timeout_s=0.5)
                    except TransportError:
                        self._stop.wait(0.05)  # no recorder now; the answer may be lost too
                        continue
                    with self._lock:
                        self._acked[given.command_id] = answer.offset
                    break

    def acknowledged(self) -> dict[str, int]:
        """The offset at which each command was acknowledged, by its id."""
        with self._lock:
            return dict(self._acked)

    def finish(self) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join()


class Stored:
    """What is in the log, as it was first read; reads on from where it was."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._digests: list[bytes] = []
        self.keyframes: Counter[int] = Counter()
        self.commands: dict[str, int] = {}
        self.twice = 0

    def read_on(self) -> None:
        """Look at what was added."""
        with LogReader(self._log) as reader:
            for event in reader.read(Offset(len(self._digests))):
                self._digests.append(_digest(event.key, event.payload))
                if event.is_envelope:
                    self.keyframes[json.loads(event.payload)["keyframe_id"]] += 1
                elif event.key == COMMAND_KEY:
                    command_id = parse_command(event.payload).command_id
                    self.twice += command_id in self.commands
                    self.commands.setdefault(command_id, event.offset)

    def moved(self) -> int:
        """How many events are not any more what and where they were when they were first read."""
        with LogReader(self._log) as reader:
            now = [_digest(event.key, event.payload) for event in reader.read()]
        same = sum(a == b for a, b in zip(self._digests, now, strict=False))
        return len(self._digests) - same


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()


class Ordeal:
    """One log behind a router, its robot, its editor, and one recorder after the other."""

    def __init__(
        self, endpoint: str, folder: Path, rate: float, rng: random.Random, name: str = "a"
    ) -> None:
        self._log = folder / "log"
        self._rng = rng
        self._endpoint = endpoint
        self._key = f"{KEY}/{name}"
        self._stored = Stored(self._log)
        self._editor: Editor | None = None
        self._tally = Tally()
        self._robot = Robot(endpoint, folder / "spool", self._key, f"run-{name}", rate)

    def kill(self, times: int) -> Tally:
        """Start and kill ``times`` recorders, then leave one in peace; what came of it."""
        for _ in range(times):
            self._start_editor()
            self._one_life()
            if self._log_exists():  # else it was killed before there was one
                self._recover()
                self._check()
        self._end()
        return self._tally

    def _record(self) -> Program:
        keys = ["--connect", self._endpoint, "--key", self._key]
        return Program(MAPFOLD, ["record", str(self._log), *keys, "--accept-edits"])

    def _log_exists(self) -> bool:
        return self._log.is_dir() and bool(list_segments(self._log))

    def _start_editor(self) -> None:
        if self._editor is None and self._log_exists():
            with LogReader(self._log) as reader:
                self._editor = Editor(self._endpoint, reader.log_id, self._rng)

    def _one_life(self) -> None:
        recorder = self._record()
        if self._rng.random() < 0.7:
            recorder.wait_for("recording")
        code = self._kill_after(recorder, LONGEST_LIFE_S)
        assert code == -signal.SIGKILL, f"{self._log}: it ended by itself: {recorder.lines}"
        self._tally.kills += 1

    def _kill_after(self, program: Program, longest_s: float) -> int:
        """Kill a program at a random moment; its exit code."""
        try:
            return program.process.wait(self._rng.uniform(0.0, longest_s))
        except subprocess.TimeoutExpired:
            return program.end(signal.SIGKILL)
        finally:
            program.close()

    def _recover(self) -> None:
        """Recover every fourth log by a command that is often killed, every fourth here; the others
        are found by the next recorder as they were left."""
        chance = self._rng.random()
        if chance < 0.25:
            recovery = Program(MAPFOLD, ["log", "recover", str(self._log)])
            code = self._kill_after(recovery, LONGEST_RECOVERY_S)
            assert code in (-signal.SIGKILL, 0, 3), f"{self._log}: {code}: {recovery.lines}"
            self._tally.recoveries_killed += code == -signal.SIGKILL
        elif chance < 0.5:
            LogWriter(self._log).close()

    def _check(self) -> None:
        """Count what was acknowledged by now and is not in the log."""
        envelopes = self._robot.acknowledged()
        commands = {} if self._editor is None else self._editor.acknowledged()
        self._stored.read_on()
        tally = self._tally
        tally.envelopes, tally.commands = len(envelopes), len(commands)
        tally.lost = len(envelopes - self._stored.keyframes.keys()) + sum(
            self._stored.commands.get(id_) != offset for id_, offset in commands.items()
        )

    def _end(self) -> None:
        """Leave one recorder in peace until it has everything, then count."""
        last = self._record()
        try:
            last.wait_for("recording")  # else Ctrl-C ends it as it starts, with 130
            acknowledged = self._robot.finish()
            if self._editor is not None:
                self._editor.finish()
            code = last.end(signal.SIGINT, PATIENCE_S)
        finally:
            last.close()
        assert acknowledged, f"{self._log}: not everything was acknowledged: {last.lines}"
        assert code in (0, 3), f"{self._log}: the last recorder ended with {code}: {last.lines}"
        self._check()
        tally, stored = self._tally, self._stored
        tally.published = self._robot.published
        tally.missing = tally.published - len(stored.keyframes)
        tally.resent = stored.keyframes.total() - len(stored.keyframes)
        tally.moved = stored.moved()
        with LogReader(self._log) as reader:
            _, view = fold_log(reader, Settings())
        tally.twice = stored.twice + abs(len(view.keyframes) - tally.published)
        found = verify_log(self._log).findings
        tally.findings = sum(finding.kind not in EXPECTED for finding in found)

    def close(self) -> None:
        """Stop robot and editor."""
        if self._editor is not None:
            self._editor.finish()
        self._robot.close()


def kill_side_by_side(
    folder: Path, times: int, *, lanes: int = 1, rate: float = 300.0, seed: str
) -> Tally:
    """Kill ``times`` recorders, ``lanes`` at a time, each with a log of its own."""
    shares = [times // lanes + (lane < times % lanes) for lane in range(lanes)]
    tally = Tally()
    with ExitStack() as stack:
        (endpoint,) = stack.enter_context(Router(LOOPBACK)).endpoints
        ordeals = []
        for lane in range(lanes):
            own = folder / f"lane-{lane}"
            own.mkdir()
            ordeal = Ordeal(endpoint, own, rate, random.Random(f"{seed}/{lane}"), f"r{lane}")
            ordeals.append(stack.enter_context(closing(ordeal)))
        with ThreadPoolExecutor(lanes) as threads:
            for part in threads.map(Ordeal.kill, ordeals, shares):
                tally.add(part)
    return tally


def finished_batches(progress: Path | None, seed: int) -> tuple[int, Tally]:
    """How many batches of this seed a progress file has, and what came of them."""
    batches, tally = 0, Tally()
    if progress is not None and progress.exists():
        for line in progress.read_text().splitlines():
            row = json.loads(line)
            if row.pop("seed") == seed:
                batches += 1
                tally.add(Tally(**row))
    return batches, tally


def main() -> int:
    """0 when nothing was lost, counts twice or has changed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--batch", type=int, default=100, help="kills in a batch")
    parser.add_argument("--lanes", type=int, default=4, help="recorders side by side")
    parser.add_argument("--rate", type=float, default=30.0, help="keyframes a second of a robot")
    parser.add_argument("--seed", type=int, default=20260324)
    parser.add_argument("--progress", type=Path, help="file of finished batches; it goes on there")
    args = parser.parse_args()
    # A shell has programs in the background ignore Ctrl-C, and so would the recorders.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    batch, total = finished_batches(args.progress, args.seed)
    print(f"seed {args.seed}, after {batch} batches: {total}", flush=True)
    while total.kills < args.kills and total.good:
        folder = Path(tempfile.mkdtemp(prefix="mapfold-kills-"))
        share, seed = min(args.batch, args.kills - total.kills), f"{args.seed}/{batch}"
        tally = kill_side_by_side(folder, share, lanes=args.lanes, rate=args.rate, seed=seed)
        total.add(tally)
        batch += 1
        if args.progress is not None:
            with args.progress.open("a") as file:
                print(json.dumps({"seed": args.seed, **asdict(tally)}), file=file)
        print(f"batch {batch}: {tally}", flush=True)
        if tally.good:
            shutil.rmtree(folder)
        else:
            print(f"its logs and spools are in {folder}", flush=True)
    print(f"all: {total}")
    return 0 if total.good else 1


if __name__ == "__main__":
    sys.exit(main())
