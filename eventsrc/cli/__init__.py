"""The commands about the log: record, import, simulate, router, log …"""

import typer

from . import import_, log, record, router, simulate


def register(app: typer.Typer) -> None:
    """Add this package's commands to ``app``, in the order ``--help`` lists them."""
    record.register(app)
    import_.register(app)
    log.register(app)
    router.register(app)
    simulate.register(app)
