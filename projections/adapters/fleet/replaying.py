"""The task of ``fleet replay``: rebuild the databases of one site, unless they are up to date.

A rebuild is swapped in by its last transaction. So a site whose worker was killed has either its
old map, or the new one, in which case its checkpoint is up to date and it is not rebuilt again.
"""

import time
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from eventsrc.base.errors import MapfoldError
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.errors import DatabaseUnavailable, ProjectionBusy, ProjectionMismatch
from projections.fold.settings import Settings
from projections.postgres import RebuildReport, rebuild
from projections.postgres.checkpoints import load
from projections.postgres.connection import connect, database_errors, describe_target
from projections.postgres.loader import LoaderName
from projections.postgres.origin import refuse_other_events
from projections.postgres.sink import SinkName
from projections.postgres.status import Status, projection_status

from .engine import Progress
from .site_databases import SiteDatabases, create_if_missing
from .sites import Site
from .task_errors import advice_for, os_error_text

BUSY_S: Final = 20.0
"""Longest wait for a site that another process writes: the server may not have noticed yet that a
worker was killed."""
_POLL_S: Final = 0.2

Outcome: TypeAlias = Literal["rebuilt", "up_to_date", "followed", "failed"]


@dataclass(frozen=True, slots=True)
class ChosenSettings:
    """The values of ``--settings`` and ``--set``; logs may name settings of their own."""

    base: Settings | None = None
    assignments: tuple[str, ...] = ()

    def of(self, corrections: Corrections) -> Settings:
        """The settings of a map under these corrections."""
        base = self.base or corrections.settings or Settings()
        return base.with_assignments(self.assignments)


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """A site to replay. ``again`` rebuilds it even if it is up to date; ``replace`` even over the
    map of another log."""

    site: Site
    databases: SiteDatabases
    settings: ChosenSettings = field(default_factory=ChosenSettings)
    again: bool = False
    replace: bool = False
    loader: LoaderName = "copy"
    hnsw: bool = True


@dataclass(frozen=True, slots=True)
class SiteReplay:
    """The outcome: ``rebuilt`` with its report, ``up_to_date``, ``followed`` by a live tail, which
    writes it, or ``failed`` with the reason. ``events`` is the length of the log."""

    outcome: Outcome
    events: int = 0
    report: RebuildReport | None = None
    error: str | None = None


def replay_site(request: ReplayRequest, progress: Progress) -> SiteReplay:
    """Rebuild one site. Errors of its log and databases are in the result, not raised."""
    with advice_for(request.databases):
        try:
            return _replay(request, progress)
        except MapfoldError as error:
            return SiteReplay("failed", error=str(error))
        except OSError as error:
            return SiteReplay("failed", error=os_error_text(error, request.site))


def _replay(request: ReplayRequest, progress: Progress) -> SiteReplay:
    with LogReader(request.site.log) as reader:  # fails before a database is created
        events = int(reader.next_offset)
    for url in request.databases.urls:
        create_if_missing(url)
    waited_until = time.monotonic() + BUSY_S
    while True:
        outcome = _outcome_before(request)
        if outcome is not None:
            return SiteReplay(outcome, events)
        try:
            report = rebuild(
                request.site.log,
                request.databases.targets,
                request.settings.of,
                loader=request.loader,
                hnsw=request.hnsw,
                workers=0,  # the other sites keep the other processors busy
                progress=lambda at: progress(at.done),
            )
        except ProjectionBusy:
            if time.monotonic() > waited_until:
                raise
            time.sleep(_POLL_S)
        else:
            return SiteReplay("rebuilt", report.events, report)


def _outcome_before(request: ReplayRequest) -> Outcome | None:
    """The outcome if no rebuild is needed; None if one is. Raises ProjectionMismatch for the map of
    another log that is not to be replaced."""
    found = projection_status(request.site.log, request.databases.targets, request.settings.of)
    for sink in found.sinks:
        if sink.condition == "unreachable":
            raise DatabaseUnavailable(sink.note or sink.place)
    if request.replace and request.again:
        return None
    conditions = {sink.condition for sink in found.sinks}
    if request.replace and "other" in conditions:
        return None
    for sink in found.sinks:
        # A map of the same log with other settings is replaced without --replace.
        if sink.condition == "other" and sink.lag is None:
            raise ProjectionMismatch(
                f"{sink.place}: the {sink.sink} there: made from another log, or from more events"
                f" than {request.site.log} has; {_REPLACE}"
            )
    if not request.replace:
        _refuse_other_events(request, found)
    if request.again:
        return None
    if conditions == {"idle"} and len({sink.digest for sink in found.sinks}) == 1:
        return "up_to_date"
    if "following" in conditions and conditions <= {"idle", "following", "refolding"}:
        return "followed"
    return None


_REPLACE: Final = "is this the right database for the site? --replace rebuilds it from this log"


def _refuse_other_events(request: ReplayRequest, found: Status) -> None:
    """Raise ProjectionMismatch where the last event of a checkpoint differs from the log's."""
    urls: dict[SinkName, str] = {
        "graph": request.databases.graph_url,
        "vectors": request.databases.vector_url,
    }
    with LogReader(request.site.log) as reader:
        for sink in found.sinks:
            if sink.next_offset is None or sink.condition == "missing":
                continue
            url = urls[sink.sink]
            with connect(url, application="mapfold fleet") as connection, database_errors(url):
                checkpoint = load(connection, sink.sink)
            if checkpoint is not None and checkpoint.log_id == reader.log_id:
                refuse_other_events(
                    checkpoint,
                    sink.sink,
                    describe_target(url),
                    request.site.log,
                    reader,
                    _REPLACE,
                )
