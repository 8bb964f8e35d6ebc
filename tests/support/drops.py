"""Wait until the server has dropped what rebuilds replaced."""

from projections.postgres.connection import Targets, connect
from projections.postgres.replaced_tables import wait_for_drop


def wait_for_drops(targets: Targets) -> None:
    """Wait until the sessions that drop have ended, in all databases of the target."""
    for url in {targets.graph_url, targets.vector_url}:
        with connect(url) as connection:
            wait_for_drop(connection, "graph")
            wait_for_drop(connection, "vectors")
