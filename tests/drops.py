"""Waiting for what a rebuild leaves the server to do: dropping what was replaced."""

from projections.database.connection import Targets, connect
from projections.database.swap import wait_for_drop


def wait_for_drops(targets: Targets) -> None:
    """Until the sessions that drop have ended, in whichever database they are."""
    for url in {targets.graph_url, targets.vector_url}:
        with connect(url) as connection:
            wait_for_drop(connection, "graph")
            wait_for_drop(connection, "vectors")
