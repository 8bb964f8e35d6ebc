"""Many logs, one a site: replay, state, verification and questions over all of them at once.

A *site* has a name, a log and a database of its own (`sites`, `site_databases`). What is done for
each is a *task*: a function of a request, run by an *engine*, which is a pool of processes on this
machine (`local_pool`) or a Dask cluster (`cluster`).

Nothing is imported here: each worker process would wait for it.
"""
