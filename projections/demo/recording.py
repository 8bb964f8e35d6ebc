"""Run A explores the house: one process drives, another records, a router between them.

Meanwhile a tail in this process writes what is recorded into the databases.
"""

import time
from dataclasses import dataclass
from typing import Final

from eventsrc.envelope import Offset, RunId
from eventsrc.log import LogReader
from eventsrc.log_info import log_info
from eventsrc.sim import SimulatedRun
from eventsrc.system_events import is_system_key
from eventsrc.transport.session import Router, ZenohOptions
from projections.database.connection import Targets
from projections.settings import Settings

from .children import Children
from .folder import DemoFolder
from .mapping import Followed, Follower

_ANY_PORT: Final = ZenohOptions(listen=("tcp/127.0.0.1:0",))
_PATIENCE_S: Final = 40.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the recorder got of what was driven.

    ``intact`` says that the log holds every payload, in order, byte for byte.
    """

    run_id: RunId
    published: int
    recorded: int
    intact: bool
    rejected: int
    lost: int
    drive_seconds: float
    log_bytes: int
    seconds: float


def record_run(
    run: SimulatedRun,
    speed: float,
    folder: DemoFolder,
    targets: Targets,
    settings: Settings,
) -> tuple[Recorded, Followed]:
    """Have run A published, recorded into the folder's log, and followed into the databases."""
    started = time.monotonic()
    count = len(run.envelopes)
    drive_s = run.true_poses[-1].time_s
    with Router(_ANY_PORT) as router, Children() as children:
        connect = ("--connect", router.endpoints[0])
        children.start(
            "record",
            ("record", str(folder.log), *connect, "--max-events", str(count)),
            folder.said("record"),
        )
        children.wait_said("record", "recording", _PATIENCE_S)
        with Follower(folder.log, targets, settings) as follower:
            seed = str(run.house.seed)
            children.start(
                "simulate",
                ("simulate", "--seed", seed, "--run", "a", "--speed", str(speed), *connect),
                folder.said("simulate"),
            )
            children.wait(_PATIENCE_S + drive_s / speed)
            followed = follower.caught_up(Offset(count))
    seconds = time.monotonic() - started
    info = log_info(folder.log)
    with LogReader(folder.log) as reader:
        payloads = [event.payload for event in reader.read() if not is_system_key(event.key)]
    recorded = Recorded(
        run_id=run.run_id,
        published=count,
        recorded=len(payloads),
        intact=payloads == list(run.payloads),
        rejected=info.rejected,
        lost=info.lost,
        drive_seconds=drive_s,
        log_bytes=info.size_bytes,
        seconds=seconds,
    )
    return recorded, followed
