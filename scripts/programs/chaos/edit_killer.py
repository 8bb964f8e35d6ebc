"""Kills tail, recorder and server at random moments while commands and keyframes arrive.

    python -m scripts.programs.chaos.edit_killer [--rounds N] [--seed N]

`mapfold record --accept-edits` and `mapfold tail` are processes of their own beside a real router
and a server. A commander sends each command again under its id until a recorder says that it is in
the log. Counted: commands that were acknowledged and are not in the log (lost), that are in it more
than once (twice), and checks after which the databases differ from a fresh replay (wrong).

Two robots publish, each in a map frame of its own; the first command joins these.
"""

import argparse
import random
import signal
import sys
import tempfile
import threading
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from eventsrc.base.errors import TransportError
from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.recorder.edits import send_command
from eventsrc.record.transport.session import Router, ZenohOptions, open_session
from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.parsing import read_commands, read_corrections
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.status import projection_status
from projections.store.history_recorder import map_after
from tests.support.envelopes import payload
from tests.support.fixtures_zenoh import LOOPBACK, MAPFOLD, Program
from tests.support.logs import (
    KEY,
    forget_keyframes,
    join_frames,
    keep_apart,
    name_place,
    undo,
    walk,
    write_log,
)
from tests.support.rows import all_rows
from tests.support.servers import kill_postgres, server_to_kill

ROUNDS_A_CHECK = 20
LONGEST_PAUSE_S = 0.8
PATIENCE_S = 120.0
KEYFRAMES_A_SECOND = 40.0
COMMANDS_A_SECOND = 4.0


@dataclass
class Tally:
    """What came of it all."""

    rounds: int = 0
    checks: int = 0
    acknowledged: int = 0
    joined: int = 0
    lost: int = 0
    twice: int = 0
    wrong: int = 0

    @property
    def good(self) -> bool:
        """Nothing was lost, nothing counts twice, and all rows are right."""
        return not (self.lost or self.twice or self.wrong)


class Commander(threading.Thread):
    """Sends commands, each until it is acknowledged; ``acknowledged`` are their ids."""

    def __init__(
        self,
        endpoint: str,
        log_id: str,
        rng: random.Random,
        history: list[Command],
        has_joined: bool,
    ) -> None:
        super().__init__()
        self._endpoint, self._log_id, self._rng = endpoint, log_id, rng
        self.history = history
        self.acknowledged: list[str] = []
        self.stop = threading.Event()
        self._has_joined = has_joined

    def run(self) -> None:
        with open_session(ZenohOptions(connect=(self._endpoint,)), mode="client") as session:
            while not self.stop.wait(self._rng.expovariate(COMMANDS_A_SECOND)):
                given = self._next()
                while not self.stop.is_set():
                    try:
                        send_command(session, self._log_id, given, Offset(10**9), timeout_s=2.0)
                    except TransportError:
                        self.stop.wait(0.05)  # no recorder now; the answer may be lost too
                        continue
                    self.acknowledged.append(given.command_id)
                    if given.kind != "join-frames":  # so that it is never undone
                        self.history.append(given)
                    break

    def _next(self) -> Command:
        rng = self._rng
        if not self._has_joined:
            self._has_joined = True
            return join_frames("b", "a", dx=0.5, dyaw=0.1)
        first, second = rng.sample(range(60), 2)
        kind = rng.random()
        if kind < 0.4:
            return name_place(first, f"room {rng.randrange(10**6)}")
        if kind < 0.55:
            return keep_apart(first, second)
        if kind < 0.7 or not self.history:
            return forget_keyframes(*sorted((first, second)))
        return undo(rng.choice(self.history))


class Robot(threading.Thread):
    """Publishes keyframes in a map frame; those that no recorder hears are not in the log."""

    def __init__(self, endpoint: str, run_id: str, frame: str, first: int) -> None:
        super().__init__()
        self._endpoint, self._run_id, self._frame, self.next = endpoint, run_id, frame, first
        self.stop = threading.Event()

    def run(self) -> None:
        with open_session(ZenohOptions(connect=(self._endpoint,)), mode="client") as session:
            publisher = session.publisher(KEY)
            while not self.stop.wait(1 / KEYFRAMES_A_SECOND):
                (document,) = walk(1, seed=self.next, first=self.next, run_id=self._run_id)
                publisher.put(payload(document | {"frame": self._frame}))
                self.next += 1


class Ordeal:
    """A router, a server, a recorder and a tail; a context manager."""

    def __init__(self, folder: Path, rng: random.Random, fresh: Targets) -> None:
        self._log, self._rng, self._fresh = folder / "log", rng, fresh
        self._keyframes = 60
        write_log(self._log, [each | {"frame": "a"} for each in walk(self._keyframes)])
        with LogReader(self._log) as reader:
            self._log_id = reader.log_id
        self._history: list[Command] = []
        self._acknowledged: list[str] = []
        self.tally = Tally()
        with ExitStack() as stack:
            (self._endpoint,) = stack.enter_context(Router(LOOPBACK)).endpoints
            self._server = stack.enter_context(server_to_kill())
            self._targets = Targets(self._server.url, self._server.url)
            self._programs = {"tail": self._start("tail"), "recorder": self._start("recorder")}
            stack.callback(lambda: [program.close() for program in self._programs.values()])
            self._stack = stack.pop_all()

    def _start(self, what: str) -> Program:
        if what == "tail":
            return Program(MAPFOLD, ["tail", str(self._log), "--db", self._server.url])
        options = ["--connect", self._endpoint, "--accept-edits"]
        return Program(MAPFOLD, ["record", str(self._log), *options])

    def run(self, rounds: int) -> None:
        """Kill something ``rounds`` times; check every `ROUNDS_A_CHECK` times and at the end."""
        while self.tally.rounds < rounds:
            has_joined = bool(self._acknowledged)
            commander = Commander(
                self._endpoint, self._log_id, self._rng, self._history, has_joined
            )
            robots = [
                Robot(self._endpoint, f"run-{frame}", frame, self._keyframes) for frame in "ab"
            ]
            threads = [commander, *robots]
            for thread in threads:
                thread.start()
            try:
                for _ in range(min(ROUNDS_A_CHECK, rounds - self.tally.rounds)):
                    commander.stop.wait(self._rng.uniform(0.0, LONGEST_PAUSE_S))
                    self._kill(self._rng.choice(["tail", "tail", "recorder", "server"]))
                    self.tally.rounds += 1
            finally:
                for thread in threads:
                    thread.stop.set()
                    thread.join(PATIENCE_S)
            self._keyframes = max(robot.next for robot in robots)
            self._acknowledged += commander.acknowledged
            self._check()

    def _kill(self, what: str) -> None:
        if what == "server":
            kill_postgres(self._server)
            self._server.start()
            return
        program = self._programs[what]
        # A tail that found no server at its start has ended by itself.
        if program.process.poll() is None:
            program.process.send_signal(signal.SIGKILL)
        program.close()
        self._programs[what] = self._start(what)

    def _check(self) -> None:
        """Let the tail catch up; count commands, and compare the rows with a fresh replay."""
        recorder = self._programs["recorder"]
        recorder.wait_for("recording")
        recorder.end(signal.SIGINT)
        recorder.close()
        LogWriter(self._log).close()  # what a killed one has left behind
        self._wait_for_tail()
        with LogReader(self._log) as reader:
            stands = Counter(c.command.command_id for c in read_commands(reader))
            known = read_corrections(reader)
            view = map_after(reader, Settings(), reader.next_offset, corrections=known, note=print)
            kept = map_digest(view)
        again = rebuild(self._log, self._fresh, Settings())
        tally = self.tally
        tally.checks += 1
        tally.acknowledged = len(self._acknowledged)
        tally.lost = len(set(self._acknowledged) - stands.keys())
        tally.twice = sum(count > 1 for count in stands.values())
        rows = all_rows(self._targets)
        tally.wrong += rows != all_rows(self._fresh)
        tally.wrong += kept != again.digest
        tally.joined = sum('"frame_joined": true' in row[-1] for row in rows[0]["Keyframe"])
        self._programs["recorder"] = self._start("recorder")

    def _wait_for_tail(self) -> None:
        pause, waited = threading.Event(), 0.0
        while not self._has_caught_up():
            assert waited < PATIENCE_S, self._programs["tail"].lines[-5:]
            if self._programs["tail"].process.poll() is not None:
                self._kill("tail")
            pause.wait(0.2)
            waited += 0.2

    def _has_caught_up(self) -> bool:
        try:
            sinks = projection_status(self._log, self._targets, Settings()).sinks
        except DatabaseError:
            return False
        return all(sink.condition == "following" and sink.lag == 0 for sink in sinks)

    def __enter__(self) -> "Ordeal":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def main() -> int:
    """0 when nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=random.randrange(10**6))
    args = parser.parse_args()
    # A shell has programs in the background ignore Ctrl-C, and so would the recorders.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(f"seed {args.seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder, server_to_kill() as other:
        fresh = Targets(other.url, other.url)
        with Ordeal(Path(folder), random.Random(args.seed), fresh) as ordeal:
            ordeal.run(args.rounds)
            print(ordeal.tally)
            return 0 if ordeal.tally.good else 1


if __name__ == "__main__":
    sys.exit(main())
