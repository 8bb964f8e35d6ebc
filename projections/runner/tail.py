"""Tail: keep the databases at the end of the log while it grows.

A tail folds the log from its start, or from the last snapshot below the checkpoints (the fold's
state lives nowhere else), and each sink listens from its own checkpoint on. One such pass
(`_tail_pass`) lasts until the tail is stopped, unless the server loses commits that it had not
flushed: then the fold is ahead of the databases, and another pass begins at their checkpoints.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from eventsrc.log import LogReader
from projections.postgres.connect import Targets, place
from projections.settings import Settings
from projections.sinks.loader import LoaderName

from ._backoff import AWAY, Backoff, OnTrouble
from ._stores import Only, open_stores
from ._tail_pass import Note, OnBatch, TailPass, TailPlan
from ._writing import LostCommits
from .progress import TailProgress, TailReport

BATCH_EVENTS: Final = 500
"""At most this many events in one transaction: about half a second of work when behind."""
ONCE_PATIENCE_S: Final = 60.0


def tail(
    log: Path,
    targets: Targets,
    settings: Settings,
    *,
    once: bool = False,
    only: Only = None,
    loader: LoaderName = "copy",
    batch_events: int = BATCH_EVENTS,
    stop: threading.Event | None = None,
    on_fold: Callable[[int], None] = lambda _: None,
    on_batch: OnBatch = lambda _: None,
    on_trouble: OnTrouble = lambda _: None,
    note: Note = lambda _: None,
    progress: TailProgress | None = None,
) -> TailReport:
    """Follow ``log`` until ``stop`` is set, or with ``once`` only to its present end.

    ``on_batch`` is called after each commit; ``on_fold`` is told how many events are folded and
    written, at the start of a pass and after each batch of it; ``note`` is told of snapshots that
    could not be used or kept, which costs time and nothing else. Raises ProjectionMismatch when the
    databases were made from another log or with other settings, ProjectionBusy, CheckpointMoved.
    """
    plan = TailPlan(
        log,
        targets,
        settings,
        once,
        stop or threading.Event(),
        ONCE_PATIENCE_S if once else None,
        batch_events,
        on_fold,
        on_batch,
        on_trouble,
        note,
        progress or TailProgress(),
    )
    report = TailReport()
    outage: Backoff | None = None
    while True:
        try:
            if _pass(plan, report, only, loader, outage):
                return report
        except LostCommits:
            report.restarts += 1
            # What lost them may happen again while the next pass begins.
            at = place(targets.graph_url)
            outage = Backoff(at, plan.stop, on_trouble, plan.patience_s)


def _pass(
    plan: TailPlan, report: TailReport, only: Only, loader: LoaderName, outage: Backoff | None
) -> bool:
    """One pass; False when the database was away at its beginning. Raises LostCommits.

    ``outage`` is given for all but the first: that one is no place for patience.
    """
    begun = False
    try:
        if outage is not None:
            outage.wait()
            plan.targets.revive()
        opened = open_stores(
            plan.targets, plan.settings, only=only, application="mapfold tail", loader=loader
        )
        with opened as stores, LogReader(plan.log) as reader:
            run = TailPass(plan, stores, report)
            run.begin(reader)
            begun = True
            run.follow(reader)
    except AWAY as error:
        if begun or outage is None:
            raise
        outage.failed(error)
        return False
    return True
