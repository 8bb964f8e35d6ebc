"""``mapfold fleet``: replay, status, verification and questions over many sites at once.

A site that fails does not stop the others. A command ends with exit 3 when a site failed or
something was found at one.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.machine import usable_processors
from eventsrc.base.text import counted, table, visible
from projections.adapters.fleet.engines import Ended
from projections.adapters.fleet.site_databases import check_server, template_of
from projections.adapters.fleet.sites import Site

from . import fleet_options
from .event_text import iso_time
from .folded_log import FoldSettings, settings_from
from .options import CameraOptions, JsonOption, QuestionArgument, option, question_from
from .terminal import Bar, display, emit, finish, say

if TYPE_CHECKING:
    from projections.adapters.fleet.site_databases import WhichSite
    from projections.adapters.fleet.site_tasks import ChosenSettings, SiteStatus
    from projections.postgres.status import SinkStatus

fleet = typer.Typer(
    help="Rebuild, check and ask many sites, each with a log and a database of its own.",
    no_args_is_help=True,
)

_HEADS: Final = (
    "site", "state", "events", "MB", "keys", "last keyframe", "rejected", "lost", "graph", "vectors"
)  # fmt: skip
_NUMBERS: Final = frozenset({"events", "MB", "keys", "rejected", "lost"})
_MB: Final = 1_000_000
_LISTED: Final = 10


def _chosen(given: FoldSettings) -> "ChosenSettings":
    """The values of ``--settings`` and ``--set``, read here: workers may be on other machines."""
    from projections.adapters.fleet.site_tasks import ChosenSettings

    given.checked()
    base = None if given.settings_file is None else settings_from(given.settings_file, None)
    return ChosenSettings(base, tuple(given.assignments))


def _check_reach(engine: str, db: str | None) -> None:
    """Raise MisuseError where workers of a cluster would need the embedded server."""
    if engine.startswith("dask:") and template_of(db, "--db", "MAPFOLD_DB") is None:
        raise MisuseError(
            f"--engine {engine}: workers on other machines cannot reach the embedded server; give"
            " --db postgresql://host/{site}"
        )


@fleet.command()
def replay(
    *,
    place: fleet_options.SitesArgument,
    engine: fleet_options.EngineOption = "local",
    jobs: fleet_options.JobsOption = None,
    again: Annotated[
        bool, typer.Option("--again", help="Rebuild also what is up to date.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Rebuild also over the map of another log.")
    ] = False,
    stores: fleet_options.FleetDatabases,
    settings: FoldSettings,
    no_hnsw: Annotated[
        bool, typer.Option("--no-hnsw", help="Do not index large tables for vector search.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Rebuild the databases of all sites that are not up to date.

    It can be interrupted and run again: sites that are up to date are skipped. Databases that do
    not exist are created. A map made from another log is replaced only with --replace.
    """
    from projections.adapters.fleet.site_tasks import ReplayRequest, SiteReplay, replay_site

    chosen = _chosen(settings)
    sites = fleet_options.sites_of(place)
    _check_reach(engine, stores.db)
    entries: dict[int, dict[str, Any]] = {}
    with stores.opened(sites) as databases:
        requests = [
            ReplayRequest(site, databases[site.name], chosen, again, replace, not no_hnsw)
            for site in sites
        ]
        if engine == "local":  # else each site would wait for it
            for server in databases[sites[0].name].urls:
                check_server(server)
        with fleet_options.ended_sites(replay_site, requests, sites, engine, jobs) as results:
            for ended in results:
                site = sites[ended.index]
                done = ended.result or SiteReplay("failed", error=ended.error)
                entries[ended.index] = _replay_entry(site, ended, done)
                if not as_json and done.report is not None:
                    again_text = f", started {ended.attempts} times" if ended.attempts > 1 else ""
                    say(
                        f"{visible(site.name)}: {counted(done.report.events, 'event')} in"
                        f" {done.report.total_s:.2f} s; digest {done.report.digest[:16]}"
                        f"{again_text}"
                    )
    ordered = [entries[index] for index in sorted(entries)]
    counts = {
        outcome: sum(entry["outcome"] == outcome for entry in ordered)
        for outcome in ("rebuilt", "up_to_date", "followed", "failed")
    }
    if as_json:
        emit({"sites": ordered, **counts})
    _say_replayed(ordered, counts)
    finish(findings=bool(counts["failed"]))


def _replay_entry(site: Site, ended: Ended, done: Any) -> dict[str, Any]:
    return {
        "site": site.name,
        "path": str(site.log),
        "outcome": done.outcome,
        "attempts": ended.attempts,
        "events": done.events,
        "report": None if done.report is None else asdict(done.report),
        "error": done.error,
    }


def _say_replayed(entries: list[dict[str, Any]], counts: dict[str, int]) -> None:
    parts = [f"{counts['rebuilt']:,} rebuilt", f"{counts['up_to_date']:,} up to date"]
    if counts["followed"]:
        parts.append(f"{counts['followed']:,} written by a live tail")
    if counts["failed"]:
        parts.append(f"{counts['failed']:,} failed")
    say(f"{counted(len(entries), 'site')}: {', '.join(parts)}")
    _say_failed([(entry["site"], entry["error"]) for entry in entries if entry["error"]])


def _say_failed(failed: list[tuple[str, str]]) -> None:
    for name, error in failed:
        say(f"failed: {visible(name)}: {error}")


@fleet.command()
def status(
    *,
    place: fleet_options.SitesArgument,
    jobs: fleet_options.JobsOption = None,
    stores: fleet_options.FleetDatabases,
    settings: FoldSettings,
    as_json: JsonOption = False,
) -> None:
    """Show a table of all sites: log, last keyframe, losses, and how far the databases are.

    Exit 3 when a site is not up to date, has lost something or cannot be read.
    """
    from projections.adapters.fleet.site_tasks import SiteStatus, StatusRequest, look_at_site
    from projections.postgres.status import status_document

    from .log import info_document

    chosen = _chosen(settings)
    sites = fleet_options.sites_of(place)
    found: list[SiteStatus] = [SiteStatus()] * len(sites)
    with stores.opened(sites) as databases:
        requests = [StatusRequest(site, databases[site.name], chosen) for site in sites]
        with fleet_options.ended_sites(look_at_site, requests, sites, "local", jobs) as results:
            for ended in results:
                found[ended.index] = ended.result or SiteStatus(error=ended.error)
    if as_json:
        documents = []
        for site, each in zip(sites, found, strict=True):
            document = {"site": site.name, "path": str(site.log), "ok": each.healthy}
            document |= {"error": each.error, "info": None, "log": None, "sinks": None}
            if each.info is not None and each.databases is not None:
                document |= {"info": info_document(each.info)}
                document |= status_document(each.info, each.databases)
            documents.append(document)
        emit({"sites": documents, "ok": all(each.healthy for each in found)})
    else:
        display(status_table(sites, found))
    _say_failed([(s.name, each.error) for s, each in zip(sites, found, strict=True) if each.error])
    finish(findings=not all(each.healthy for each in found))


@fleet.command()
def verify(
    *,
    place: fleet_options.SitesArgument,
    engine: fleet_options.EngineOption = "local",
    jobs: fleet_options.JobsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Read every byte of all logs, as `log verify` does of one; exit 3 if anything is wrong."""
    from projections.adapters.fleet.site_tasks import SiteVerification, verify_site

    from .event_text import finding_text
    from .log import verification_document

    sites = fleet_options.sites_of(place)
    found = [SiteVerification()] * len(sites)
    with fleet_options.ended_sites(verify_site, sites, sites, engine, jobs) as results:
        for ended in results:
            found[ended.index] = ended.result or SiteVerification(error=ended.error)
    pairs = list(zip(sites, found, strict=True))
    if as_json:
        documents = [
            {"site": site.name, "path": str(site.log), "sound": each.sound, "error": each.error}
            | {"report": None if each.found is None else verification_document(each.found)}
            for site, each in pairs
        ]
        emit({"sites": documents, "sound": all(each.sound for each in found)})
    else:
        for site, each in pairs:
            for finding in () if each.found is None else each.found.findings:
                display(f"{visible(site.name)}: {finding_text(finding)}")
    read = [each.found for each in found if each.found is not None]
    wrong = sum(not each.sound for each in found)
    say(
        f"{counted(len(sites), 'site')}: {counted(sum(r.events for r in read), 'event')},"
        f" {sum(r.size_bytes for r in read):,} bytes:"
        f" {f'{wrong:,} with findings or not readable' if wrong else 'all good'}"
    )
    _say_failed([(site.name, each.error) for site, each in pairs if each.error])
    finish(findings=bool(wrong))


@fleet.command()
def relocalize(
    *,
    place: fleet_options.SitesArgument,
    query: QuestionArgument,
    top: Annotated[int, option("N", "Places of each site.", "--top", min=1, max=100)] = 3,
    camera: CameraOptions,
    jobs: fleet_options.QuestionJobsOption = None,
    stores: fleet_options.FleetDatabases,
    as_json: JsonOption = False,
) -> None:
    """Find the site a robot is at, from a few object crops: the probability of each, and of none.

    Each site's map is asked as by `mapfold relocalize`; its answer is in the output. Exit 3 when a
    site could not be asked.
    """
    from projections.adapters.fleet.site_databases import ask_sites

    question, asked_by = question_from(query), camera.camera
    sites = fleet_options.sites_of(place)
    with stores.opened(sites) as databases:
        workers = jobs or 2 * usable_processors()
        answer = ask_sites(sites, databases, question, top=top, camera=asked_by, jobs=workers)
    best = answer.which.best
    if as_json:
        emit(
            {
                "site": None if best is None else best.name,
                "none": answer.which.none,
                "sites": [each.document() for each in answer.which.sites],
                "not_asked": dict(answer.not_asked),
            }
        )
    else:
        display(which_site_text(answer.which))
    for name, reason in answer.not_asked.items():
        say(f"not asked: {visible(name)}: {reason}")
    finish(findings=bool(answer.not_asked))


@fleet.command()
def align(
    *,
    place: fleet_options.SitesArgument,
    jobs: fleet_options.JobsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find which of many logs are of one building, in whatever frames: a table, by building.

    Every two maps are aligned, as `mapfold align` aligns runs; only what is sure makes a building.
    Exit 3 when a log could not be compared or pairs contradict each other.
    """
    try:
        from projections.adapters.fleet import buildings
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold fleet align needs {error.name}, which is not installed; pip install"
            " 'mapfold[align]'"
        ) from None
    sites, task = fleet_options.sites_of(place), buildings.things_of_site
    made = [buildings.SiteThings(None)] * len(sites)
    with fleet_options.ended_sites(task, sites, sites, "local", jobs) as results:
        for ended in results:
            made[ended.index] = ended.result or buildings.SiteThings(None, ended.error)
    named = [(site.name, each) for site, each in zip(sites, made, strict=True)]
    failed = [(name, each.error) for name, each in named if each.error]
    things = {name: each.things for name, each in named if each.things is not None}
    pairs, others = buildings.comparable(things)
    requests, found = [(things[one], things[other]) for one, other in pairs], dict.fromkeys(pairs)
    with fleet_options.open_engine("local", jobs, len(pairs)) as engine, Bar() as bar:
        for number, ended in enumerate(engine.run(buildings.align_pair, requests), start=1):
            found[pairs[ended.index]] = ended.result
            bar.show("aligning", number, len(pairs), "pairs")
            if ended.error is not None:
                failed.append((" and ".join(pairs[ended.index]), ended.error))
    all_ = buildings.Buildings.of(things, found)
    if as_json:
        emit(all_.document() | {"other_space": others, "failed": dict(failed)})
    else:
        display(all_.text())
    if others:
        names = ", ".join(map(visible, others[:_LISTED])) + (", …" if others[_LISTED:] else "")
        say(f"embeddings of another space than most, compared with their like only: {names}")
    _say_failed(failed)
    finish(findings=bool(failed or others or all_.is_in_doubt))


@fleet.command()
def url(
    *,
    place: fleet_options.SitesArgument,
    site: Annotated[str, typer.Argument(metavar="SITE", help="The site's name.")],
    db: fleet_options.TemplateOption = None,
) -> None:
    """Print the URL of one site's database, for --db of the commands of one map.

    A URL of the embedded server works while that server runs: see `db start`.
    """
    sites = fleet_options.sites_of(place)
    if site not in {each.name for each in sites}:
        names = ", ".join(visible(each.name) for each in sites[:_LISTED])
        more = f" and {len(sites) - _LISTED:,} more" if len(sites) > _LISTED else ""
        raise MisuseError(f"{place}: no site {site!r}; there are {names}{more}")
    with fleet_options.FleetDatabases(db=db).opened(sites) as databases:
        display(databases[site].graph_url)


def status_table(sites: Sequence[Site], found: "Sequence[SiteStatus]") -> str:
    """One line a site."""
    rows = [_row(site, each) for site, each in zip(sites, found, strict=True)]
    return table(_HEADS, rows, right=_NUMBERS)


def _row(site: Site, found: "SiteStatus") -> list[str]:
    info, databases = found.info, found.databases
    if info is None or databases is None:
        return [visible(site.name), "failed", *"------", "-", "-"]
    last = "-" if info.last_stamp_ns is None else iso_time(info.last_stamp_ns)[:19] + "Z"
    published = [key for key in info.keys if not key.startswith("mapfold/")]
    return [
        visible(site.name),
        "ok" if found.healthy else "findings",
        f"{info.events:,}",
        f"{info.size_bytes / _MB:,.1f}",
        f"{len(published):,}",
        last,
        f"{info.rejected:,}",
        f"{info.lost:,}",
        *map(_sink_cell, databases.sinks),
    ]


def _sink_cell(sink: "SinkStatus") -> str:
    """The condition, the number of events behind, and that of parked events."""
    cell: str = sink.condition
    if sink.lag:
        cell = f"behind by {sink.lag:,}" if cell == "behind" else f"{cell}, behind by {sink.lag:,}"
    if sink.dead_letters:
        cell += f", {len(sink.dead_letters):,} parked"
    return cell


def which_site_text(which: "WhichSite") -> str:
    """The likeliest site, then all of them with place and probabilities."""
    if not which.sites:
        return "no site could be asked\n"
    best = which.best
    if best is None:
        first = f"none of these sites (probability {which.none:.2f})"
    else:
        first = f"{visible(best.name)} (probability {best.probability:.2f})"
    lines = [first]
    for number, each in enumerate(which.sites[:_LISTED], start=1):
        answer = each.answer
        place = visible(answer.places[0].name or answer.places[0].place_id) if answer.places else ""
        at = "" if answer.pose is None else f" at ({answer.pose.x:.2f}, {answer.pose.y:.2f}) m"
        lines.append(
            f"{number}. {visible(each.name)}  {each.probability:.3f}"
            f"  known {answer.known:.2f}, confidence {answer.confidence:.2f}"
            f"  {place}{at}".rstrip()
            + (f"  (thin map: {answer.thin})" if answer.thin is not None else "")
        )
    if len(which.sites) > _LISTED:
        lines.append(f"and {len(which.sites) - _LISTED:,} more")
    lines.append(f"none of them  {which.none:.3f}")
    return "\n".join(lines) + "\n"
