"""The database of each site: from a URL template, or of the embedded server, named as the site.

A map has fixed names in its database: the graph ``semantic_map``, which Apache AGE keeps as a
schema, the schema ``mapfold`` with the checkpoints, and tables in ``public``. So two sites cannot
share a database, not even in two schemas, and ``{site}`` must be in the database's name.

Which site's map a question is from is found by asking the databases of all sites, several at once.
Scores of places cannot be compared across maps: they are shares of one map's poses. The two
probabilities of an answer can, as each map calibrates them: `known`, that it has the things shown,
and `confidence`, that the pose found is right. Their logits are the evidence for a map against
"none of them" (docs/decisions/relocalization.md). The prior is equal for all sites; that of "none"
is its share in the questions that the weights were fitted on.
"""

import contextlib
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

import psycopg
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised, visible
from eventsrc.log.sealed_end import segments_of
from projections.fold.exact import exp
from projections.fold.map_errors import DatabaseError
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import Answer, Question, rank
from projections.postgres.connection import (
    Connection,
    Targets,
    check_url,
    connect,
    database_errors,
    describe_target,
    open_targets,
)
from projections.postgres.queries.candidate_search import CandidateReader

from .sites import Site

PLACEHOLDER: Final = "{site}"
MAX_BYTES: Final = 63
"""Most bytes of a database's name; PostgreSQL would truncate a longer one."""
_RESERVED: Final = frozenset({"template0", "template1"})
_MARK: Final = "mapfoldsitemark"
"""The placeholder of a site's name while a template is checked."""
_EXAMPLE: Final = f"postgresql://host/{PLACEHOLDER}, or postgresql://host/map_{PLACEHOLDER}"
Template = tuple[str, str]
"""A URL with ``{site}``, and what messages call it."""


@contextlib.contextmanager
def site_databases(
    sites: Sequence[Site], db: str | None, vector_db: str | None
) -> Iterator[dict[str, Targets]]:
    """The databases of each site, by its name. The embedded server, if needed, runs while the
    context is open. Raises MisuseError for an invalid template or name, and where two sites would
    share a database."""
    graph = template_of(db, "--db", "MAPFOLD_DB")
    vectors = template_of(vector_db, "--vector-db", "MAPFOLD_VECTOR_DB") or graph
    if graph is not None and vectors is not None:
        yield _databases(sites, graph, vectors)
        return
    vector_url = None if vectors is None else _filled(vectors, sites[0].name)
    with open_targets(None, vector_url) as targets:
        if targets.embedded is None:
            raise MisuseError("set --db too, or neither --db nor --vector-db")
        url = targets.embedded.url_of(_MARK).replace(_MARK, PLACEHOLDER)
        own = url, "the embedded server"
        yield _databases(sites, own, vectors or own)


def template_of(option: str | None, name: str, variable: str) -> Template | None:
    """The template of an option, else of an environment variable, checked; None without both."""
    url, given_as = (option, name) if option else (os.environ.get(variable), variable)
    if not url:
        return None
    if PLACEHOLDER not in url:
        raise MisuseError(
            f"{given_as}: no {PLACEHOLDER} in it, so all sites would have one database; a map has"
            f" fixed names there, and each site needs its own: {_EXAMPLE}"
        )
    filled = url.replace(PLACEHOLDER, _MARK)
    check_url(filled, given_as)
    with_mark = sorted(
        name for name, value in conninfo_to_dict(filled).items() if _MARK in str(value)
    )
    if with_mark != ["dbname"]:
        raise MisuseError(
            f"{given_as}: {PLACEHOLDER} may be only in the database's name (not in"
            f" {', '.join(n for n in with_mark if n != 'dbname')}): {_EXAMPLE}; where"
            " sites have servers of their own, run the command once for each server, with a list"
        )
    rest = filled.replace(_MARK, "")
    if "{" in rest or "}" in rest:
        raise MisuseError(
            f"{given_as}: braces other than those of {PLACEHOLDER}: {_EXAMPLE}; write %7B for {{"
            " and %7D for }"
        )
    return url, given_as


def _filled(template: Template, name: str) -> str:
    url, given_as = template
    filled = url.replace(PLACEHOLDER, quote(name, safe=""))
    check_url(filled, f"{given_as} for the site {visible(name)}")
    database = str(conninfo_to_dict(filled)["dbname"])
    size = len(database.encode())
    if size > MAX_BYTES:
        raise MisuseError(
            f"site {visible(name)}: its database would be named {visible(database)}, {size} bytes,"
            f" and PostgreSQL allows {MAX_BYTES}; give a list with a shorter name: NAME PATH"
        )
    if database in _RESERVED:
        raise MisuseError(
            f"site {visible(name)}: {database} is a database of PostgreSQL's own; give a list with"
            f" another name, or a template such as --db postgresql://host/map_{PLACEHOLDER}"
        )
    return filled


def _databases(sites: Sequence[Site], graph: Template, vectors: Template) -> dict[str, Targets]:
    of: dict[str, Targets] = {}
    owners: dict[tuple[str, str, str], str] = {}
    for site in sites:
        of[site.name] = Targets(_filled(graph, site.name), _filled(vectors, site.name))
        for url in of[site.name].urls:
            parts = conninfo_to_dict(url)
            port = parts.get("port") or os.environ.get("PGPORT") or 5432
            key = str(parts.get("host")).lower(), str(port), str(parts["dbname"])
            if owners.setdefault(key, site.name) != site.name:
                raise MisuseError(
                    f"sites {visible(owners[key])} and {visible(site.name)} would both have"
                    f" {describe_target(url)}; give a list with other names"
                )
    return of


def exists(url: str) -> bool | None:
    """Whether a database exists; None where no server answers."""
    with _maintenance(url) as connection:
        if connection is None:
            return None
        return _is_there(connection, _name(url))


def check_server(url: str) -> None:
    """Raise DatabaseUnavailable when neither a database's server nor the database answers."""
    if exists(url) is None:
        connect(url, application="mapfold fleet").close()


def create_if_missing(url: str) -> bool:
    """Create the database of a URL; False if it exists or no server answers.

    Raises DatabaseError when it may not be created.
    """
    name = _name(url)
    with _maintenance(url) as connection:
        if connection is None or _is_there(connection, name):
            return False
        try:
            connection.execute(
                sql.SQL("CREATE DATABASE {} TEMPLATE template0 ENCODING 'UTF8'").format(
                    sql.Identifier(name)
                )
            )
        except psycopg.errors.InsufficientPrivilege:
            user = connection.info.user
            raise DatabaseError(
                f"{describe_target(url)}: it does not exist, and user {user} may not create it;"
                f" have a superuser run ALTER ROLE {sql.Identifier(user).as_string()} CREATEDB, or"
                f" create it with createdb -E UTF8 -T template0 -O"
                f" {shlex.join([user, name])}"
            ) from None
        except (psycopg.errors.DuplicateDatabase, psycopg.errors.UniqueViolation):
            return False  # another process has just created it
        return True


def _name(url: str) -> str:
    return str(conninfo_to_dict(url)["dbname"])


@contextlib.contextmanager
def _maintenance(url: str) -> Iterator[Connection | None]:
    """A connection to the server's database ``postgres``, None where that is not allowed."""
    # In UTF-8 whatever the URL or PGCLIENTENCODING says: a site may have any name.
    parts = conninfo_to_dict(url) | {"dbname": "postgres", "client_encoding": "UTF8"}
    server = make_conninfo("", **parts)
    try:
        connection = psycopg.connect(
            server, autocommit=True, application_name="mapfold fleet", connect_timeout=10
        )
    except psycopg.OperationalError:
        # No server answers, or this user may not use that database. Connecting to the site's own
        # database next raises the error that says which.
        yield None
        return
    with connection, database_errors(url):
        yield connection


def _is_there(connection: Connection, name: str) -> bool:
    row = connection.execute(
        "SELECT FROM pg_catalog.pg_database WHERE datname = %s", [name]
    ).fetchone()
    return row is not None


KNOWN_WEIGHT: Final = 0.863
CONFIDENCE_WEIGHT: Final = 0.470
INTERCEPT: Final = -0.568
"""Conditional logit with "none" at 0, fitted on the developing half of generated buildings: six
sites each, one of them the right one for about half of the questions."""
FITTED_SITES: Final = 6
_LEAST: Final = 1e-6
"""Least distance of clipped probabilities from 0 and 1, so that no single map decides."""
_MOST_LOGIT: Final = math.log((1.0 - _LEAST) / _LEAST)


@dataclass(frozen=True, slots=True)
class RankedSite:
    """A site, the probability that the robot is there, and the answer of its map."""

    name: str
    probability: float
    answer: Answer

    def document(self) -> dict[str, Any]:
        """As JSON: the answer in the shape of ``relocalize --json``, with site and probability."""
        return {"site": self.name, "probability": self.probability} | self.answer.document()


@dataclass(frozen=True, slots=True)
class WhichSite:
    """The sites, likeliest first, and the probability that the robot is at none of them."""

    sites: tuple[RankedSite, ...]
    none: float

    @property
    def best(self) -> RankedSite | None:
        """The likeliest site; None where "none" is likelier than each."""
        if not self.sites or self.none >= self.sites[0].probability:
            return None
        return self.sites[0]


def which_site(answers: Mapping[str, Answer]) -> WhichSite:
    """Rank the sites by their answers to one question."""
    if not answers:
        return WhichSite((), 1.0)
    prior = math.log(FITTED_SITES / len(answers))
    names = sorted(answers)
    evidence = [prior + _evidence(answers[name]) for name in names]
    greatest = max(0.0, *evidence)
    weights = [exp(max(-700.0, value - greatest)) for value in evidence]
    none = exp(max(-700.0, -greatest))
    total = math.fsum([none, *weights])
    ranked = [
        RankedSite(name, weight / total, answers[name])
        for name, weight in zip(names, weights, strict=True)
    ]
    return WhichSite(tuple(sorted(ranked, key=lambda r: (-r.probability, r.name))), none / total)


def _evidence(answer: Answer) -> float:
    of_confidence = CONFIDENCE_WEIGHT * _logit(answer.confidence)
    known = _logit(answer.known) if answer.looks is None else _within(answer.looks.logit)
    return INTERCEPT + KNOWN_WEIGHT * known + of_confidence


def _logit(probability: float) -> float:
    within = min(1.0 - _LEAST, max(_LEAST, probability))
    return math.log(within / (1.0 - within))


def _within(logit: float) -> float:
    return min(_MOST_LOGIT, max(-_MOST_LOGIT, logit))


@dataclass(frozen=True, slots=True)
class FleetAnswer:
    """The ranking of the sites that could be asked, and why the others could not."""

    which: WhichSite
    not_asked: Mapping[str, str]


def ask_sites(
    sites: Sequence[Site],
    databases: Mapping[str, Targets],
    question: Question,
    *,
    top: int,
    camera: CameraConstants | None,
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
    site: Site, databases: Targets, question: Question, *, top: int, camera: CameraConstants | None
) -> Answer | str:
    """The answer of one site's map, or the reason why there is none."""
    try:
        for url in databases.urls:
            if exists(url) is False:
                segments_of(site.log)  # raises where there is no log to replay
                return f"there is no such database yet; `{advised('fleet', 'replay')}` makes it"
        with CandidateReader(databases) as reader:
            candidates = reader.candidates(question.crops)
        return rank(question, candidates, top=top, camera=camera)
    except MapfoldError as error:
        return str(error)
