"""Ctrl-C and SIGTERM at random moments: of questions to one timeline, and of commands that fold and
write. What is asked next is answered rightly."""

import signal
import subprocess
from pathlib import Path
from typing import Any

from mapfold import Settings, Timeline

from scripts.programs.attack.arena import Arena
from tests.support.commands import interrupt
from tests.support.logs import bridge, walk, write_log

LONGEST_LIFE_S = 3.0
INTERRUPTS = 12
LAST_MOMENT = 40_000
RULES = (
    Settings(eps_m=0.8, min_samples=3),
    Settings(places="rooms"),
    Settings(fusion="evidence", eps_m=1.0),
)
ENDED = {signal.SIGINT: (0, 130, -signal.SIGINT), signal.SIGTERM: (0, 143, -signal.SIGTERM)}


def attack(arena: Arena) -> None:
    """Interrupt questions to a timeline, then two commands."""
    rng = arena.rng
    log = write_log(arena.folder / "log", [*walk(40, seed=rng.randrange(1000)), *bridge()])
    rules = rng.choice(RULES)
    with Timeline(log, rules, cache=False) as fresh, Timeline(log, rules) as asked:
        expected = _answers(fresh)
        for _ in range(INTERRUPTS):
            interrupt(lambda: _answers(asked), rng.randrange(1, LAST_MOMENT))
        if _answers(asked) != expected:
            arena.complain(f"an interrupted timeline under {rules} answers otherwise")
    commands: tuple[tuple[str | Path, ...], ...] = (
        ("state", log, "--digest"),
        ("merges", log),
        ("bisect", log, "place_count >= 2"),
        ("draw", log, "--out", "map.svg"),
        ("export", log, "--graphml", "map.graphml"),
    )
    for command in rng.sample(commands, 2):
        _interrupt(arena, command)


def _answers(timeline: Timeline) -> list[Any]:
    ends = (timeline.end, timeline.end // 2)
    return [*(timeline.at(end).digest for end in ends), timeline.merges(), timeline.diff(*ends)]


def _interrupt(arena: Arena, command: tuple[str | Path, ...]) -> None:
    right = arena.run("reader", *command, codes=(0,)).output()
    sent = arena.rng.choice([*ENDED])
    begun = arena.start("reader", *command)
    try:
        code = begun.process.wait(arena.rng.uniform(0.0, LONGEST_LIFE_S))
    except subprocess.TimeoutExpired:
        begun.process.send_signal(sent)
        code = begun.wait()
    if code not in ENDED[sent]:
        arena.complain(f"{begun.command} ended with {code} after {sent.name}")
    if arena.run("reader", *command, codes=(0,)).output() != right:
        arena.complain(f"{begun.command} prints something else after {sent.name}")
