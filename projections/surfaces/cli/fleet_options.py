"""Options of ``mapfold fleet``, the engine that ``--engine`` names, and the bar over all sites."""

import contextlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.errors import LogError, MisuseError
from eventsrc.base.machine import usable_processors
from eventsrc.base.text import counted
from eventsrc.log import LogReader
from projections.adapters.fleet.engines import DaskCluster, Ended, Engine, LocalPool, Task
from projections.adapters.fleet.site_databases import site_databases
from projections.adapters.fleet.sites import Site, find_sites
from projections.postgres.connection import Targets

from .options import option
from .terminal import Bar, people, say


def open_engine(engine: str, jobs: int | None, tasks: int) -> Engine:
    """``local``, with ``jobs`` processes, or ``dask://HOST:PORT``. Raises MisuseError for anything
    else."""
    if engine == "local":
        return LocalPool(min(jobs or usable_processors(), max(1, tasks)))
    scheme, _, address = engine.partition("://")
    if scheme != "dask" or not address:
        raise MisuseError(f"--engine {engine}: there are local and dask://HOST:PORT")
    if jobs is not None:
        raise MisuseError("--jobs is for --engine local; a cluster runs as many as it has workers")
    return DaskCluster(address)


SitesArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DIR|LIST",
        help="Folder with a log in each subfolder, or a file with a line NAME PATH for each log.",
    ),
]
TemplateOption = Annotated[
    str | None,
    option(
        "TEMPLATE",
        "A database for each site, as postgresql://host/{site} [env MAPFOLD_DB; default:"
        " databases of the embedded server, named as the sites].",
        "--db",
    ),
]
VectorTemplateOption = Annotated[
    str | None,
    option(
        "TEMPLATE",
        "A database of each site's embeddings [env MAPFOLD_VECTOR_DB; default: --db].",
        "--vector-db",
    ),
]
EngineOption = Annotated[
    str,
    option(
        "ENGINE",
        "local: processes on this machine; dask://HOST:PORT: the workers of that scheduler.",
        "--engine",
    ),
]


def _jobs_option(default: str) -> Any:
    help_ = f"Sites at once [default: {default}]."
    return option("N", help_, "--jobs", min=1, max=1024)


JobsOption = Annotated[int | None, _jobs_option("the number of cores")]
QuestionJobsOption = Annotated[int | None, _jobs_option("twice the number of cores")]
"""For `relocalize`, which waits for databases."""


@dataclass(frozen=True, kw_only=True)
class FleetDatabases:
    """``--db`` and ``--vector-db``, each with a database for every site."""

    db: TemplateOption = None
    vector_db: VectorTemplateOption = None

    def opened(self, sites: Sequence[Site]) -> AbstractContextManager[dict[str, Targets]]:
        """The databases by name of site."""
        return site_databases(sites, self.db, self.vector_db)


def sites_of(place: Path) -> list[Site]:
    """The sites of DIR or LIST; prints which subfolders are left out."""
    return find_sites(place, say)


@contextlib.contextmanager
def ended_sites(
    task: Task, requests: Sequence[Any], sites: Sequence[Site], engine: str, jobs: int | None
) -> Iterator[Iterator[Ended]]:
    """The results of a task for each site as they come, with a progress bar. SIGTERM ends the
    workers, as Ctrl-C does."""
    with open_engine(engine, jobs, len(requests)) as running, Bar() as bar:
        yield _shown(running.run, task, requests, sites, bar)


def _shown(
    run: Any, task: Task, requests: Sequence[Any], sites: Sequence[Site], bar: Bar
) -> Iterator[Ended]:
    sizes = [_events(site) for site in sites] if people.is_terminal else [0] * len(sites)
    total, ended = sum(sizes), set[int]()

    def show(events: int) -> None:
        done = max(events, sum(sizes[index] for index in ended))
        bar.show(counted(len(sites), "site"), min(done, total), total)

    for each in run(task, requests, show):
        ended.add(each.index)
        yield each


def _events(site: Site) -> int:
    try:
        with LogReader(site.log) as reader:
            return int(reader.next_offset)
    except (LogError, OSError):  # its task reports it
        return 0
