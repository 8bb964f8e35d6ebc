"""Damaged and forged logs: after `mapfold log recover` no event has another offset or comes from
another log, and everything that could be read is there."""

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from eventsrc.log import LogReader, LogWriter
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.corruption import corrupt_log
from scripts.programs.attack.forgery import mark, mark_as_text, seed_of
from scripts.programs.attack.oracle import Oracle
from tests.support.envelopes import envelope
from tests.support.fixtures_log import BY_HAND

EVENTS, SEGMENT = 59, 20
MOST_ADDED = 101_000
"""So many events more than there were may a mended log have: 100,000 losses are added unasked."""

Damage = Callable[[Arena, Path, Oracle], int]
"""Damages a log; how many events must be left at least."""


def foreign_over_active(arena: Arena, log: Path, oracle: Oracle) -> int:
    """A sealed segment of another log takes the place of the growing one."""
    other = arena.folder / "other"
    _write(other, "other", Oracle())
    (active,) = log.glob("*.active")
    base = active.name.removesuffix(".active")
    active.unlink()
    shutil.copyfile(min(other.glob("*.mcap")), log / base)
    return int(base.removesuffix(".mcap"))


def exchanged_names(_: Arena, log: Path, __: Oracle) -> int:
    """Two whole segments get each other's name."""
    first, second, *_rest = sorted(log.glob("*.mcap"))
    aside = log / "aside"
    first.rename(aside)
    second.rename(first)
    aside.rename(second)
    return EVENTS


def sealed_cut_or_deleted(arena: Arena, log: Path, _: Oracle) -> int:
    """The last sealed segment, behind which nothing comes, is cut at any byte or deleted. What it
    lacks must be losses, so that no offset is given twice."""
    (active,) = log.glob("*.active")
    sealed_to = int(active.name.partition(".")[0])
    active.unlink()
    last = max(log.glob("*.mcap"))
    if arena.rng.random() < 0.2:
        last.unlink()
    else:
        os.truncate(last, arena.rng.randrange(last.stat().st_size))
    if arena.rng.random() < 0.2:
        last.unlink(missing_ok=True)
        os.mkfifo(last)
    return sealed_to


def forged_mark_in_key(arena: Arena, log: Path, oracle: Oracle) -> int:
    """A key holds a commit mark of an offset far away, and the writer died over that chunk."""
    _write(log, "forged", oracle, key=f"tb/{mark_as_text(10**6)}")
    (active,) = log.glob("*.active")
    with active.open("r+b") as file:
        file.truncate(active.stat().st_size - arena.rng.randrange(30, 200))
    return EVENTS


def forged_mark_at_end(_: Arena, log: Path, __: Oracle) -> int:
    """A commit mark of an offset far away, made with the right seed, stands behind all others."""
    (active,) = log.glob("*.active")
    seed = seed_of(active.read_bytes())
    with active.open("ab") as file:
        file.write(mark(EVENTS, 10**12, seed))
    return EVENTS


def one_digit_of_ledger(arena: Arena, log: Path, _: Oracle) -> int:
    """The saved gap ledger says something else than it did."""
    ledger = log / ".ledger.json"
    if ledger.exists():
        text = ledger.read_text()
        digits = [at for at, char in enumerate(text) if char.isdigit()]
        at = arena.rng.choice(digits)
        ledger.write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :])
    return EVENTS


def by_chance(arena: Arena, log: Path, _: Oracle) -> int:
    """Bits, zeros, cuts, repeats: one to three of them."""
    corrupt_log(log, arena.rng)
    return 0


CASES: tuple[Damage, ...] = (
    foreign_over_active,
    exchanged_names,
    sealed_cut_or_deleted,
    forged_mark_in_key,
    forged_mark_at_end,
    one_digit_of_ledger,
)


def attack(arena: Arena) -> None:
    """Round 0: the cases; later one of them, and random damage."""
    chosen = CASES if arena.round == 0 else (arena.rng.choice(CASES), by_chance)
    for damage in chosen:
        arena.attempt(damage.__name__, partial(_one, arena, damage))


def _one(arena: Arena, damage: Damage) -> None:
    log, oracle = arena.folder / damage.__name__, Oracle()
    _write(log, "own", oracle)
    least = damage(arena, log, oracle)
    if least < EVENTS or damage is forged_mark_in_key:
        oracle.forget_promises()  # what was destroyed may be missing, if that is said
    arena.run("reader", "log", "recover", log, codes=(0, 1, 3))
    arena.judge(oracle, log)
    events = _events(log)
    if not least <= events <= 2 * EVENTS + MOST_ADDED:
        arena.complain(f"{damage.__name__}: {events} events are left, {least} were whole")
    arena.run("reader", "log", "verify", log, codes=(0, 1, 3))


def _write(log: Path, run_id: str, oracle: Oracle, key: str = "tb/detections") -> None:
    """Segments of 20 events and a growing one of 19 that was not closed, as after a kill."""
    writer = LogWriter(log, fsync=BY_HAND, rotate_events=SEGMENT)
    for k in range(EVENTS):
        payload = json.dumps(envelope(k, run_id=run_id, note="x" * 50)).encode()
        oracle.wrote(writer.next_offset, payload)
        writer.append(key, payload)
        if k % 4 == 3:
            writer.sync()
    writer.sync()
    writer._sealer.finish()
    writer._active.close()
    writer._lock.release()


def _events(log: Path) -> int:
    with LogReader(log) as reader:
        return reader.next_offset
