"""Hostile values in the place of every option and argument of every command."""

import signal
import subprocess

from eventsrc.log import LogWriter
from scripts.programs.attack.arena import Arena
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.hostile_options import hostile_lines, prepared

LINES = 30
"""Command lines of a round, at random: all of them take an hour."""
PATIENCE_S = 20.0
CODES = (0, 1, 2, 3)
INTERRUPTED = 130
"""Of a command that works for long; not one that waits for a FIFO."""


def attack(arena: Arena) -> None:
    """Each ends by itself, without a traceback; a service that takes the value ends by SIGINT."""
    with LogWriter(arena.folder / "log") as writer:
        for k in range(5):
            writer.append(KEY, payload(envelope(k)))
    with prepared(arena.folder):
        for line in arena.rng.sample([*hostile_lines()], LINES):
            command = arena.start("reader", *line)
            try:
                code = command.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                code = command.end(signal.SIGINT)
                if code == INTERRUPTED and not any("fifo" in word for word in line):
                    continue
            if code not in CODES:
                arena.complain(f"{command.command} ended with {code}")
