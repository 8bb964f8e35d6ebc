"""The tasks for one site: ``fleet replay``, ``fleet status`` and ``fleet verify``.

A rebuild is swapped in by its last transaction. So a site whose worker was killed has either its
old map, or the new one, in which case its checkpoint is up to date and it is not rebuilt again.
Errors of a site's log and databases are in the results, not raised.
"""

import contextlib
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import complete_by
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader, Verification, verify_log
from eventsrc.record.log_info import LogInfo, log_info
from projections.fold.corrections import Corrections
from projections.fold.map_errors import DatabaseUnavailable, ProjectionBusy, ProjectionMismatch
from projections.fold.settings import Settings
from projections.postgres import RebuildReport, rebuild
from projections.postgres.checkpoints import load
from projections.postgres.connection import (
    Targets,
    connect,
    database_errors,
    describe_target,
    url_without_secrets,
)
from projections.postgres.labels import SINKS
from projections.postgres.origin import refuse_other_events
from projections.postgres.status import SinkStatus, Status, projection_status

from .engines import Progress
from .site_databases import create_if_missing, exists
from .sites import Site


@contextlib.contextmanager
def advice_for(databases: Targets) -> Iterator[None]:
    """Add one site's databases to the command lines that messages advise in this context, without
    passwords, which libpq reads from ~/.pgpass or PGPASSWORD."""

    def complete(words: Sequence[str], without: Collection[str]) -> list[str]:
        given = [("--db", databases.graph_url)]
        if databases.vector_url != databases.graph_url:
            given.append(("--vector-db", databases.vector_url))
        if words[:1] == ["log"]:
            return []
        left_out = {*words, *without}
        return [
            word
            for option, url in given
            if option not in left_out
            for word in (option, url_without_secrets(url))
        ]

    complete_by(complete)
    try:
        yield
    finally:
        complete_by(None)


def error_text(error: MapfoldError | OSError, site: Site) -> str:
    """The text of an error, of a file error with its path."""
    if isinstance(error, MapfoldError):
        return str(error)
    return f"{error.filename or site.log}: {error.strerror or error}"


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
    databases: Targets
    settings: ChosenSettings = field(default_factory=ChosenSettings)
    again: bool = False
    replace: bool = False
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
    """Rebuild one site."""
    with advice_for(request.databases):
        try:
            return _replay(request, progress)
        except (MapfoldError, OSError) as error:
            return SiteReplay("failed", error=error_text(error, request.site))


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
                request.databases,
                request.settings.of,
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
    found = projection_status(request.site.log, request.databases, request.settings.of)
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
    with LogReader(request.site.log) as reader:
        for sink in found.sinks:
            if sink.next_offset is None or sink.condition == "missing":
                continue
            url = request.databases.url_of(sink.sink)
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


@dataclass(frozen=True, slots=True)
class StatusRequest:
    """A request for the status of a site."""

    site: Site
    databases: Targets
    settings: ChosenSettings = field(default_factory=ChosenSettings)


@dataclass(frozen=True, slots=True)
class SiteStatus:
    """A site's log and databases. ``error`` says why its log cannot be read; then the others are
    None."""

    info: LogInfo | None = None
    databases: Status | None = None
    error: str | None = None

    @property
    def healthy(self) -> bool:
        """Whether the log can be read and has lost nothing, and the databases are up to date."""
        if self.info is None or self.databases is None:
            return False
        return self.databases.healthy and not self.info.rejected and not self.info.lost


def look_at_site(request: StatusRequest, _: Progress) -> SiteStatus:
    """The status of one site."""
    with advice_for(request.databases):
        try:
            info = log_info(request.site.log)
            return SiteStatus(info, _databases(request, info))
        except (MapfoldError, OSError) as error:
            return SiteStatus(error=error_text(error, request.site))


def _databases(request: StatusRequest, info: LogInfo) -> Status:
    targets = request.databases
    missing = {url for url in targets.urls if exists(url) is False}
    if not missing:
        return projection_status(request.site.log, targets, request.settings.of)
    others = [url for url in targets.urls if url not in missing]
    found = {}
    if others:  # one of the two exists
        status = projection_status(
            request.site.log, Targets(others[0], others[0]), request.settings.of
        )
        found = {sink.sink: sink for sink in status.sinks}
    sinks = (
        SinkStatus(name, describe_target(url), "missing", note="there is no such database yet")
        if url in missing
        else found[name]
        for name in SINKS
        for url in (targets.url_of(name),)
    )
    return Status(info.log_id, Offset(info.events), tuple(sinks))


@dataclass(frozen=True, slots=True)
class SiteVerification:
    """The report of ``log verify`` for a site; ``error`` where the log could not be read at all."""

    found: Verification | None = None
    error: str | None = None

    @property
    def sound(self) -> bool:
        """Whether the verification found no fault."""
        return self.found is not None and not self.found.findings


def verify_site(site: Site, progress: Progress) -> SiteVerification:
    """Verify one site's log."""
    try:
        found = verify_log(site.log)
    except (MapfoldError, OSError) as error:
        return SiteVerification(error=error_text(error, site))
    progress(found.events)
    return SiteVerification(found)
