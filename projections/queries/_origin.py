"""Graph and vectors are one map only if the same log and the same settings made both.

Each carries a checkpoint of its own, and ``replay --only`` or ``tail --only`` may have made one of
them from something else. Numbers of observations then name other things on the other side, and an
answer made of both would be wrong without anybody noticing.
"""

from projections.errors import ProjectionMismatch


def refuse_mixed(
    vectors: str | None, graph: str | None, vectors_place: str, graph_place: str
) -> None:
    """Raise ProjectionMismatch unless both origins, each ``log id, space, fingerprint``, agree."""
    if vectors is None or graph is None or vectors == graph:
        return
    log, _, _ = vectors.rpartition(" ")
    graph_log, _, _ = graph.rpartition(" ")
    told = (
        f"made with other settings than the graph, both from log {log}"
        if log == graph_log
        else f"made from log {log}, the graph from log {graph_log}"
    )
    where = "" if vectors_place == graph_place else f" (the graph is in {graph_place})"
    raise ProjectionMismatch(
        f"{vectors_place}: the vectors there were {told}{where}; run mapfold replay LOG without"
        " --only, so that one log and one set of settings make both"
    )
