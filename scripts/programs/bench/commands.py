"""Processor time of commands on logs/sample with thousands of corrections, and without them.

Each kind of command is appended alone, then mixed, then with an undo of each. For each log the
processor time of ``mapfold state`` (first: nothing kept beside the log; again: the history is kept)
and of ``mapfold edits`` is printed, with the ratio to the log without commands, and the part of it
that is reading and parsing the commands.
"""

import argparse
import math
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

from eventsrc.envelope import commands
from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectedPose,
    RigidTransform,
    encode_command,
)
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import NEVER, LogReader, LogWriter
from projections.map.parsing import read_commands

SAMPLE = Path("logs/sample")
RUN, KEYFRAMES = RunId("sim-7-a"), 445
KINDS: dict[str, Callable[[random.Random, int], Command]] = {}
Kind = Callable[[random.Random, int], Command]


def _kind(function: Kind) -> Kind:
    KINDS[function.__name__.replace("_", "-")] = function
    return function


def _own(number: int) -> dict[str, str]:
    return {"command_id": f"c{number}", "issued_by": "ann@lab", "reason": "bench"}


def _anchor(chance: random.Random) -> Anchor:
    return Anchor(run_id=RUN, keyframe_id=KeyframeId(chance.randrange(1, KEYFRAMES + 1)))


def _anchors(chance: random.Random, count: int) -> tuple[Anchor, ...]:
    numbers = chance.sample(range(1, KEYFRAMES + 1), count)
    return tuple(Anchor(run_id=RUN, keyframe_id=KeyframeId(n)) for n in numbers)


def _det_id(chance: random.Random) -> str:
    return f"{RUN}_kf{chance.randrange(1, KEYFRAMES + 1)}_d{chance.randrange(2)}"


def _span(chance: random.Random) -> tuple[KeyframeId, KeyframeId]:
    first, last = sorted(KeyframeId(chance.randrange(1, KEYFRAMES + 1)) for _ in range(2))
    return first, last


def _small(chance: random.Random) -> RigidTransform:
    return RigidTransform.of(*(chance.uniform(-1e-3, 1e-3) for _ in range(3)))


@_kind
def transforms_of_the_run(chance: random.Random, number: int) -> Command:
    return commands.CorrectPoses(**_own(number), run_id=RUN, transform=_small(chance))


@_kind
def transforms_of_spans(chance: random.Random, number: int) -> Command:
    first, last = _span(chance)
    return commands.CorrectPoses(
        **_own(number), run_id=RUN, transform=_small(chance), first=first, last=last
    )


@_kind
def transforms_of_keyframes(chance: random.Random, number: int) -> Command:
    at = _span(chance)[0]
    return commands.CorrectPoses(
        **_own(number), run_id=RUN, transform=_small(chance), first=at, last=at
    )


@_kind
def poses(chance: random.Random, number: int) -> Command:
    numbers = chance.sample(range(1, KEYFRAMES + 1), 10)
    return commands.CorrectPoses(
        **_own(number),
        run_id=RUN,
        poses=tuple(
            CorrectedPose(
                keyframe_id=KeyframeId(n),
                x=chance.uniform(0.0, 12.0),
                y=chance.uniform(0.0, 8.0),
                yaw=chance.uniform(-math.pi, math.pi),
            )
            for n in numbers
        ),
    )


@_kind
def name_place(chance: random.Random, number: int) -> Command:
    return commands.NamePlace(**_own(number), place=_anchor(chance), name=f"room {number}")


@_kind
def keep_apart(chance: random.Random, number: int) -> Command:
    a, b = _anchors(chance, 2)
    return commands.KeepApart(**_own(number), places=(a, b))


@_kind
def undo_merge(chance: random.Random, number: int) -> Command:
    return commands.UndoMerge(
        **_own(number), merge_offset=Offset(number % KEYFRAMES), places=_anchors(chance, 3)
    )


@_kind
def join(chance: random.Random, number: int) -> Command:
    a, b = _anchors(chance, 2)
    return commands.Join(**_own(number), places=(a, b))


@_kind
def same_object(chance: random.Random, number: int) -> Command:
    return commands.SameObject(**_own(number), det_ids=(_det_id(chance), _det_id(chance)))


@_kind
def different_objects(chance: random.Random, number: int) -> Command:
    return commands.DifferentObjects(**_own(number), det_ids=(_det_id(chance), _det_id(chance)))


@_kind
def drop_object(chance: random.Random, number: int) -> Command:
    return commands.DropObject(**_own(number), det_ids=(_det_id(chance), _det_id(chance)))


@_kind
def drop_detection(chance: random.Random, number: int) -> Command:
    return commands.DropDetection(**_own(number), det_ids=(_det_id(chance),))


@_kind
def forget_run(chance: random.Random, number: int) -> Command:
    return commands.ForgetRun(**_own(number), run_id=RunId(f"other-{number}"))


@_kind
def forget_keyframes(chance: random.Random, number: int) -> Command:
    at = _span(chance)[0]
    return commands.ForgetKeyframes(**_own(number), run_id=RUN, first=at, last=at)


@_kind
def forget_absent_keyframes(chance: random.Random, number: int) -> Command:
    first = KeyframeId(10**6 + 2 * number)
    return commands.ForgetKeyframes(**_own(number), run_id=RUN, first=first, last=first)


@_kind
def use_settings(chance: random.Random, number: int) -> Command:
    eps_m = round(chance.uniform(1.0, 1.5), 3)
    return commands.UseSettings(**_own(number), settings={"eps_m": eps_m, "min_samples": 8})


@_kind
def reembed(chance: random.Random, number: int) -> Command:
    return commands.Reembed(
        **_own(number),
        space=f"space-{number % 7}",
        dim=8,
        first=Offset(0),
        end=Offset(1),
        detections=1,
        sha256=f"{number:064x}",
    )


@_kind
def undo_of_the_one_before(chance: random.Random, number: int) -> Command:
    if not number:
        return use_settings(chance, number)
    return commands.Undo(**_own(number), undone=f"c{number - 1}")


@_kind
def undo_of_nothing(chance: random.Random, number: int) -> Command:
    return commands.Undo(**_own(number), undone=f"nothing-{number}")


@_kind
def about_nothing(chance: random.Random, number: int) -> Command:
    absent = [Anchor(run_id=RUN, keyframe_id=KeyframeId(10**6 + n)) for n in (number, number + 1)]
    return commands.KeepApart(**_own(number), places=(absent[0], absent[1]))


def large_undo_merge(chance: random.Random, number: int) -> Command:
    """Of every keyframe of the log; as a few of them are as much as thousands of other commands, it
    is not among `KINDS`."""
    return commands.UndoMerge(
        **_own(number), merge_offset=Offset(0), places=_anchors(chance, KEYFRAMES)
    )


def mixed(chance: random.Random, number: int) -> Command:
    """Of all kinds but those that would change the settings or leave the run out."""
    return chance.choice([each for name, each in KINDS.items() if name not in _NOT_MIXED])(
        chance, number
    )


_NOT_MIXED = ("reembed", "undo-of-the-one-before")


def commands_of(kind: Kind, count: int) -> Iterator[Command]:
    """A seeded sequence of commands."""
    chance = random.Random(kind.__name__)
    return (kind(chance, number) for number in range(count))


def undone(kind: Kind, count: int) -> Iterator[Command]:
    """Commands, and then an undo of each."""
    undos = (commands.Undo(**_own(count + number), undone=f"c{number}") for number in range(count))
    return chain(commands_of(kind, count), undos)


def write_log(log: Path, given: Iterator[Command]) -> Path:
    """The keyframes of the sample log, and commands behind them."""
    with LogReader(SAMPLE) as reader, LogWriter(log, fsync=NEVER) as writer:
        for event in reader.read():
            if event.is_envelope:
                writer.append(event.key, event.payload, logged_ns=event.logged_ns)
        for command in given:
            writer.append(COMMAND_KEY, encode_command(command))
    return log


def cpu_of(*words: str) -> float:
    """Processor time of a whole command, in seconds."""
    before = _children()
    program = [sys.executable, "-m", "projections.surfaces.cli", *words]
    hidden = subprocess.DEVNULL
    subprocess.run(program, check=True, stdout=hidden, stderr=hidden)
    return _children() - before


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def reading_of(log: Path) -> float:
    """Processor time of reading and parsing the commands of a log, in seconds."""
    started = time.process_time()
    with LogReader(log) as reader:
        read_commands(reader)
        for _ in reader.read():  # the fold reads them once more and passes over them
            pass
    return time.process_time() - started


def case(name: str, log: Path, base: tuple[float, ...] | None) -> tuple[float, ...]:
    """Measure a log and print a line."""
    spent = tuple(
        cpu_of(*words) for words in (("state", str(log)), ("state", str(log)), ("edits", str(log)))
    )
    first, again, edits = spent
    reading = reading_of(log)
    ratios = (
        ""
        if base is None
        else f"  {first / base[0]:5.2f} × {again / base[1]:5.2f} ×  "
        f"without reading {(first - reading) / base[0]:5.2f} × {(again - reading) / base[1]:5.2f} ×"
    )
    print(
        f"{name:38} state {first:6.2f} s, again {again:6.2f} s, edits {edits:6.2f} s, "
        f"reading {reading:5.2f} s{ratios}",
        flush=True,
    )
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commands", type=int, default=10_000)
    parser.add_argument("--kind", action="append", choices=[*KINDS, "mixed", "large-undo-merge"])
    arguments = parser.parse_args()
    count: int = arguments.commands
    wanted = arguments.kind or [*KINDS, "mixed", "large-undo-merge"]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        plain = write_log(at / "plain", iter(()))
        cpu_of("state", str(plain), "--at", "1")  # so that all modules are compiled
        shutil.rmtree(at / "plain.timeline", ignore_errors=True)
        base = case("without commands", plain, None)
        every = {**KINDS, "mixed": mixed, "large-undo-merge": large_undo_merge}
        for name in wanted:
            kind, number = every[name], count if name != "large-undo-merge" else count // 500
            case(f"{number} {name}", write_log(at / name, commands_of(kind, number)), base)
            log = write_log(at / f"{name}-undone", undone(kind, number // 2))
            case(f"{number // 2} {name}, each undone", log, base)


if __name__ == "__main__":
    main()
