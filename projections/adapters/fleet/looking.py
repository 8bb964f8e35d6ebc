"""The tasks of ``fleet status``, the state of a site's log and databases, and of ``fleet verify``,
which reads every byte of its log."""

from dataclasses import dataclass, field

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.model import Offset
from eventsrc.log import Verification, verify_log
from eventsrc.record.log_info import LogInfo, log_info
from projections.postgres.connection import Targets, describe_target
from projections.postgres.sink import SinkName
from projections.postgres.status import SinkStatus, Status, projection_status

from .engine import Progress
from .replaying import ChosenSettings
from .site_databases import SiteDatabases, exists
from .sites import Site
from .task_errors import advice_for, os_error_text


@dataclass(frozen=True, slots=True)
class StatusRequest:
    """A request for the status of a site."""

    site: Site
    databases: SiteDatabases
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
    """The status of one site. Errors of its log and databases are in the result, not raised."""
    with advice_for(request.databases):
        try:
            info = log_info(request.site.log)
            return SiteStatus(info, _databases(request, info))
        except MapfoldError as error:
            return SiteStatus(error=str(error))
        except OSError as error:
            return SiteStatus(error=os_error_text(error, request.site))


def _databases(request: StatusRequest, info: LogInfo) -> Status:
    urls = request.databases
    missing = {url for url in urls.urls if exists(url) is False}
    if not missing:
        return projection_status(request.site.log, urls.targets, request.settings.of)
    others = [url for url in urls.urls if url not in missing]
    found = {}
    if others:  # one of the two exists
        status = projection_status(
            request.site.log, Targets(others[0], others[0]), request.settings.of
        )
        found = {sink.sink: sink for sink in status.sinks}
    named: tuple[tuple[SinkName, str], ...] = (
        ("graph", urls.graph_url),
        ("vectors", urls.vector_url),
    )
    sinks = (
        SinkStatus(name, describe_target(url), "missing", note="there is no such database yet")
        if url in missing
        else found[name]
        for name, url in named
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
    """Verify one site's log. Errors of the log are in the result, not raised."""
    try:
        found = verify_log(site.log)
    except MapfoldError as error:
        return SiteVerification(error=str(error))
    except OSError as error:
        return SiteVerification(error=os_error_text(error, site))
    progress(found.events)
    return SiteVerification(found)
