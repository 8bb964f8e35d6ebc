"""Replay, status, verification and questions over many sites.

A *site* is a log with a name and a database of its own (`sites`, `site_databases`). A *task* is a
function of one site's request; an *engine* runs tasks, in a pool of processes on this machine
(`engines`) or on a Dask cluster.

Nothing is imported here, because every worker process would import it too.
"""
