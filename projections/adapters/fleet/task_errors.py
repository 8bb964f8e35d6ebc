"""Error messages of tasks: advised command lines with the site's databases, and file errors."""

import contextlib
from collections.abc import Collection, Iterator, Sequence

from eventsrc.base.advised import complete_by
from projections.postgres.connection import url_without_secrets

from .site_databases import SiteDatabases
from .sites import Site


@contextlib.contextmanager
def advice_for(databases: SiteDatabases) -> Iterator[None]:
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


def os_error_text(error: OSError, site: Site) -> str:
    """The text of a file error, with its path."""
    return f"{error.filename or site.log}: {error.strerror or error}"
