"""The engine that ``--engine`` names."""

from eventsrc.errors import MisuseError

from .engine import Engine, usable_cores
from .local_pool import LocalPool


def open_engine(engine: str, jobs: int | None, tasks: int) -> Engine:
    """``local``, with ``jobs`` processes, or ``dask://HOST:PORT``. Raises MisuseError for anything
    else."""
    if engine == "local":
        return LocalPool(min(jobs or usable_cores(), max(1, tasks)))
    scheme, _, address = engine.partition("://")
    if scheme != "dask" or not address:
        raise MisuseError(f"--engine {engine}: there are local and dask://HOST:PORT")
    if jobs is not None:
        raise MisuseError("--jobs is of --engine local; a cluster runs as many as it has workers")
    from .cluster import DaskCluster  # its package is an extra

    return DaskCluster(address)
