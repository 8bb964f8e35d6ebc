"""`mapfold spool`: the contents of a robot's spool, and envelopes in it that a recorder refused."""

from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible
from eventsrc.record.robot.spool import Refused, Spool

from .detect_text import spool_path
from .options import JsonOption
from .terminal import display, emit, finish, say

_MOST: Final = 20
_ALL: Final = 1_000_000_000


def spool(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="The spool [default: that of `mapfold detect`]."),
    ] = None,
    retry: Annotated[
        bool,
        typer.Option(
            "--retry",
            help="Queue the refused envelopes again; the next start with this spool sends them.",
        ),
    ] = False,
    discard: Annotated[
        bool,
        typer.Option(
            "--discard", help="Drop the refused envelopes; the log that refused them keeps them."
        ),
    ] = False,
    json_: JsonOption = False,
) -> None:
    """List a robot's spool: envelopes that wait for a recorder, and those that one refused.

    A recorder refuses an envelope that it cannot use, with a reason, and keeps it in its log under
    mapfold/rejected. It stays in the spool until --retry or --discard. Exit 3 while there is one.
    """
    if retry and discard:
        raise MisuseError("--retry and --discard: give one of them")
    path = file or spool_path()
    if not path.is_file():
        raise MisuseError(f"{path}: no such file; give the file that a detector got as --spool")
    if not Spool.is_spool(path):
        raise MisuseError(f"{path}: another program's database; give a spool")
    opened = Spool(path)
    try:
        retried = opened.retry_refused() if retry else 0
        dropped = opened.discard_refused() if discard else 0
        refused = opened.refused(_ALL if json_ else _MOST)
        waiting, left = len(opened), opened.refused_count
    finally:
        opened.close()
    if json_:
        emit(
            {
                "spool": str(path),
                "waiting": waiting,
                "retried": retried,
                "discarded": dropped,
                "refused": [each._asdict() for each in refused],
            }
        )
    else:
        display("".join(f"{_line(each)}\n" for each in refused))
        if left > len(refused):
            say(f"… and {left - len(refused):,} more")
    if retry:
        say(f"{path}: {counted(retried, 'envelope')} will be sent again")
    if discard:
        say(f"{path}: dropped {counted(dropped, 'envelope')}")
    say(f"{path}: {counted(waiting, 'envelope')} waiting, {left:,} refused")
    if retry and left:
        say(f"{left:,} have lost their bytes to newer ones and cannot be sent again")
    elif left:
        again, drop = (advised("spool", path, option) for option in ("--retry", "--discard"))
        say(f"send them again, to a recorder that takes them: {visible(again)}")
        say(f"or drop them: {visible(drop)}")
    finish(findings=left > 0)


def _line(refused: Refused) -> str:
    who = f"{refused.run_id}:{refused.keyframe_id}"
    return visible(f"{who}  refused by log {refused.log_id}: {refused.reason}")
