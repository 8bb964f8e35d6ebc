"""Tail: keep the databases at the end of the log while it grows.

A tail folds the log from its start, or from the last snapshot below the checkpoints (the fold's
state is kept nowhere else), and writes to each sink from its own checkpoint on. One pass
(`TailPass`) lasts until the tail is stopped, unless the server loses commits that it had not
flushed: then the fold is ahead of the databases, and another pass begins at their checkpoints.

A batch has the events since the last one: a single event at a low rate, up to `BATCH_EVENTS` when
the tail is behind. Each batch is one transaction per database (`writer`).

An event that cannot be folded is parked: its offset and the reason go to the dead letters in the
same transaction that moves past it. Parked events are left out at every later start too, so that
the rows stay equal to the fold, until a rebuild tries them again.

A command changes how earlier events are folded. One that only names places is applied at once, in
the transaction that moves past it. Any other command interrupts the tail: a `refold` folds the log
again, and the tail continues from there. At the start of a pass the checkpoints state which
commands the map includes, so none is lost. If a command moves a keyframe out of bounds, the refold
ends, the old map stays without later events, and the tail waits for another command.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from eventsrc.log import LogReader
from projections.fold.settings import Settings

from .connection import Targets, describe_target
from .inputs import LogInputs, SettingsOf
from .loader import LoaderName
from .stores import Only, open_stores
from .tail_pass import Note, OnBatch, OnRefold, TailPass, TailPlan
from .tail_progress import TailProgress, TailReport
from .writer import AWAY, Backoff, LostCommits, OnTrouble

BATCH_EVENTS: Final = 500
"""The most events in one transaction: about half a second of work when behind."""
ONCE_TIMEOUT_S: Final = 60.0
"""Seconds that `tail` with ``once`` waits for an unreachable database."""


def tail(
    log: Path,
    targets: Targets,
    settings: Settings | SettingsOf,
    *,
    once: bool = False,
    only: Only = None,
    loader: LoaderName = "copy",
    batch_events: int = BATCH_EVENTS,
    stop: threading.Event | None = None,
    on_fold: Callable[[int], None] = lambda _: None,
    on_batch: OnBatch = lambda _: None,
    on_trouble: OnTrouble = lambda _: None,
    on_refold: OnRefold = lambda _done, _total: None,
    note: Note = lambda _: None,
    progress: TailProgress | None = None,
) -> TailReport:
    """Follow ``log`` until ``stop`` is set, or with ``once`` only to its present end.

    ``settings`` may depend on the log's corrections. ``on_batch`` is called after each commit;
    ``on_fold`` is called with the number of events folded and written, at the start of a pass and
    after each batch of it; ``on_refold`` with the number of events that a refold has folded and the
    number that it has to fold. ``note`` is called with a message for each snapshot that could not
    be used or kept, which costs time and nothing else, and for a command that cannot be applied;
    with ``once`` such a command is raised (ImpossibleCommand). Raises ProjectionMismatch when the
    databases were made from another log or with other settings, ProjectionBusy, CheckpointMoved.
    """
    plan = TailPlan(
        log,
        targets,
        settings,
        once,
        stop or threading.Event(),
        ONCE_TIMEOUT_S if once else None,
        batch_events,
        on_fold,
        on_batch,
        on_trouble,
        on_refold,
        note,
        progress or TailProgress(),
    )
    report = TailReport()
    outage: Backoff | None = None
    while True:
        try:
            if _run_pass(plan, report, only, loader, outage):
                return report
        except LostCommits:
            report.restarts += 1
            # The database may be unreachable while the next pass begins.
            at = describe_target(targets.graph_url)
            outage = Backoff(at, plan.stop, on_trouble, plan.patience_s)


def _run_pass(
    plan: TailPlan, report: TailReport, only: Only, loader: LoaderName, outage: Backoff | None
) -> bool:
    """Run one pass; False when the database was unreachable at its beginning. Raises LostCommits.

    ``outage`` is None for the first pass, which does not wait for an unreachable database.
    """
    run: TailPass | None = None
    try:
        if outage is not None:
            outage.wait()
            plan.targets.restart_embedded()
        with LogReader(plan.log) as reader:
            inputs = LogInputs.read(reader, plan.settings)
            opened = open_stores(
                plan.targets,
                inputs.latest.settings,
                only=only,
                application="mapfold tail",
                loader=loader,
            )
            with opened as stores:
                run = TailPass(plan, stores, report, inputs, inputs.latest)
                run.run(reader)
    except AWAY as error:
        if (run is not None and run.began) or outage is None:
            raise
        outage.failed(error)
        return False
    return True
