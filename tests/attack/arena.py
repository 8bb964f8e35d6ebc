"""One round of an attack: its folder, its chance, its processes, and what was found."""

import os
import random
import signal
import subprocess
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from .oracle import Oracle
from .tally import Tally
from .victim import PATIENCE_S, Victim

Attack = Callable[["Arena"], None]


class Arena:
    """A context manager; at its end all processes are gone and what they did is in the tally.

    ``database`` gives the URL of a running server that all rounds share.
    """

    def __init__(
        self,
        folder: Path,
        number: int,
        chance: random.Random,
        tally: Tally,
        database: Callable[[], str],
    ) -> None:
        self.folder, self.round, self.chance, self.tally = folder, number, chance, tally
        self.database = database
        self.stack = ExitStack()
        clean = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
        self._env = {**clean, "MAPFOLD_HOME": str(folder / "home"), "COLUMNS": "100"}

    def attempt(self, name: str, play: Callable[[], None]) -> None:
        """Play something; whatever it raises is a complaint, and the round goes on."""
        try:
            play()
        except Exception:  # noqa: BLE001  # told in full
            self.complain(f"{name} could not be played to its end:\n{traceback.format_exc()}")

    def start(self, role: str, *arguments: str | Path, env: Mapping[str, str] = {}) -> Victim:
        """Start `mapfold ARGUMENTS`."""
        victim = Victim(role, [*map(str, arguments)], env={**self._env, **env}, cwd=self.folder)
        self.stack.callback(self._judge, victim)
        return victim

    def run(
        self,
        role: str,
        *arguments: str | Path,
        codes: tuple[int, ...] = (0, 1, 2, 3),
        env: Mapping[str, str] = {},
        patience_s: float = PATIENCE_S,
    ) -> Victim:
        """Run `mapfold ARGUMENTS` to its end; another exit code than ``codes`` is complained of."""
        victim = self.start(role, *arguments, env=env)
        try:
            code = victim.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.complain(f"{victim.command} did not end within {patience_s:g} s")
            return victim
        if code not in codes:
            self.complain(f"{victim.command} ended with {code}: {' / '.join(victim.lines[-2:])}")
        return victim

    def router(self) -> str:
        """Start a router; where it listens."""
        router = self.start("router", "router", "--listen", "tcp/127.0.0.1:0")
        said = router.wait_for("router listening on ")
        return said.removeprefix("router listening on ").split("; ")[0].split(", ")[0]

    def recorder(self, log: Path, endpoint: str, *options: str) -> Victim:
        """Start a recorder; it is subscribed when this returns."""
        recorder = self.start("recorder", "record", log, "--connect", endpoint, *options)
        recorder.wait_for("recording ")
        return recorder

    def finish(self, victim: Victim, codes: tuple[int, ...] = (0, 3)) -> None:
        """End it as a person does, and complain when it ends otherwise."""
        if not victim.running:
            said = " / ".join(victim.lines[-2:])
            self.complain(f"{victim.command} had ended by itself: {said}")
        elif victim.end(signal.SIGINT) not in codes:
            self.complain(f"{victim.command} ended with {victim.process.returncode}")

    def judge(self, oracle: Oracle, log: Path) -> None:
        """Count what ``log`` lacks of what was acknowledged, and what was made up."""
        judgement = oracle.judge(log)
        self.tally.acknowledged += judgement.acknowledged
        self.tally.lost += judgement.lost
        self.tally.invented += judgement.invented

    def complain(self, text: str) -> None:
        """Something is not as it must be."""
        self.tally.complaints.append(f"round {self.round}: {text}")

    def _judge(self, victim: Victim) -> None:
        if victim.running:
            victim.kill()
        self.tally.weigh(victim.role, victim.peak_mb(), victim.command)
        faults = victim.faults()
        self.tally.tracebacks += len(faults)
        if faults:
            self.complain(f"{victim.command}: {faults[0]}: {victim.lines[-1]}")
        victim.close()

    def __enter__(self) -> "Arena":
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()
