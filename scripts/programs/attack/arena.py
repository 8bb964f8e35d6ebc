"""One round of an attack: its folder, random generator, processes and results."""

import os
import random
import signal
import subprocess
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from .attacked_command import PATIENCE_S, AttackedCommand
from .oracle import Oracle
from .tally import Tally

Attack = Callable[["Arena"], None]


class Arena:
    """A context manager; at its end all processes are gone and their results are in the tally.

    ``database`` gives the URL of a running server that all rounds share.
    """

    def __init__(
        self,
        folder: Path,
        number: int,
        rng: random.Random,
        tally: Tally,
        database: Callable[[], str],
    ) -> None:
        self.folder, self.round, self.rng, self.tally = folder, number, rng, tally
        self.database = database
        self.stack = ExitStack()
        clean = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
        self._env = {**clean, "MAPFOLD_HOME": str(folder / "home"), "COLUMNS": "100"}

    def attempt(self, name: str, play: Callable[[], None]) -> None:
        """Run ``play``; an exception becomes a complaint, and the round goes on."""
        try:
            play()
        except Exception:  # noqa: BLE001  # reported in full
            self.complain(f"{name} could not be played to its end:\n{traceback.format_exc()}")

    def start(
        self, role: str, *arguments: str | Path, env: Mapping[str, str] = {}
    ) -> AttackedCommand:
        """Start `mapfold ARGUMENTS`."""
        attacked = AttackedCommand(
            role, [*map(str, arguments)], env={**self._env, **env}, cwd=self.folder
        )
        self.stack.callback(self._judge, attacked)
        return attacked

    def run(
        self,
        role: str,
        *arguments: str | Path,
        codes: tuple[int, ...] = (0, 1, 2, 3),
        env: Mapping[str, str] = {},
        patience_s: float = PATIENCE_S,
    ) -> AttackedCommand:
        """Run `mapfold ARGUMENTS` to its end; another exit code than ``codes`` is complained of."""
        attacked = self.start(role, *arguments, env=env)
        try:
            code = attacked.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.complain(f"{attacked.command} did not end within {patience_s:g} s")
            return attacked
        if code not in codes:
            self.complain(
                f"{attacked.command} ended with {code}: {' / '.join(attacked.lines[-2:])}"
            )
        return attacked

    def router(self) -> str:
        """Start a router; where it listens."""
        router = self.start("router", "router", "--listen", "tcp/127.0.0.1:0")
        said = router.wait_for("router listening on ")
        return said.removeprefix("router listening on ").split("; ")[0].split(", ")[0]

    def recorder(self, log: Path, endpoint: str, *options: str) -> AttackedCommand:
        """Start a recorder; it is subscribed when this returns."""
        recorder = self.start("recorder", "record", log, "--connect", endpoint, *options)
        recorder.wait_for("recording ")
        return recorder

    def finish(self, attacked: AttackedCommand, codes: tuple[int, ...] = (0, 3)) -> None:
        """End it with SIGINT; complain if it had ended before, or ends with another code."""
        if not attacked.running:
            said = " / ".join(attacked.lines[-2:])
            self.complain(f"{attacked.command} had ended by itself: {said}")
        elif attacked.end(signal.SIGINT) not in codes:
            said = " / ".join(attacked.lines[-2:])
            self.complain(f"{attacked.command} ended with {attacked.process.returncode}: {said}")

    def judge(self, oracle: Oracle, log: Path) -> None:
        """Count the acknowledged events that ``log`` lacks, and the invented ones in it."""
        judgement = oracle.judge(log)
        self.tally.acknowledged += judgement.acknowledged
        self.tally.lost += judgement.lost
        self.tally.invented += judgement.invented

    def complain(self, text: str) -> None:
        """Note a violation."""
        self.tally.complaints.append(f"round {self.round}: {text}")

    def _judge(self, attacked: AttackedCommand) -> None:
        if attacked.running:
            attacked.kill()
        self.tally.note_memory(attacked.role, attacked.peak_mb(), attacked.command)
        faults = attacked.faults()
        self.tally.tracebacks += len(faults)
        if faults:
            self.complain(f"{attacked.command}: {faults[0]}: {attacked.lines[-1]}")
        attacked.close()

    def __enter__(self) -> "Arena":
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()
