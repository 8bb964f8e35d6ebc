"""Ask the databases of several sites the same question, several at once."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from eventsrc.base.advised import advised
from eventsrc.base.errors import MapfoldError
from eventsrc.log.reader import segments_of
from projections.fold.settings import Camera
from projections.localize.relocalize import Answer, Question, rank
from projections.postgres.queries.relocalize import CandidateReader

from .site_databases import SiteDatabases, exists
from .sites import Site
from .which_site import WhichSite, which_site


@dataclass(frozen=True, slots=True)
class FleetAnswer:
    """The ranking of the sites that could be asked, and why the others could not."""

    which: WhichSite
    not_asked: Mapping[str, str]


def ask_sites(
    sites: Sequence[Site],
    databases: Mapping[str, SiteDatabases],
    question: Question,
    *,
    top: int,
    camera: Camera | None,
    jobs: int,
) -> FleetAnswer:
    """Ask each site; one that cannot be asked does not affect the ranking of the others."""
    with ThreadPoolExecutor(jobs, "ask") as threads:  # it mostly waits for the databases
        answers = threads.map(
            lambda site: _ask(site, databases[site.name], question, top=top, camera=camera), sites
        )
        found = {site.name: answer for site, answer in zip(sites, answers, strict=True)}
    return FleetAnswer(
        which_site({name: a for name, a in found.items() if isinstance(a, Answer)}),
        {name: a for name, a in found.items() if isinstance(a, str)},
    )


def _ask(
    site: Site, databases: SiteDatabases, question: Question, *, top: int, camera: Camera | None
) -> Answer | str:
    """The answer of one site's map, or the reason why there is none."""
    try:
        for url in databases.urls:
            if exists(url) is False:
                segments_of(site.log)  # raises where there is no log to replay
                return f"there is no such database yet; `{advised('fleet', 'replay')}` makes it"
        with CandidateReader(databases.targets) as reader:
            candidates = reader.candidates(question.crops)
        return rank(question, candidates, top=top, camera=camera)
    except MapfoldError as error:
        return str(error)
