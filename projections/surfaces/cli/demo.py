"""`mapfold demo`: record, replay, map and re-localise a simulated robot on one machine."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.adapters.sim import DEFAULT_SEED

from .options import Databases, JsonOption
from .terminal import emit, finish, say


def demo(
    *,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the log, the databases and map.png.")
    ] = Path("logs/demo"),
    seed: Annotated[
        int, typer.Option(metavar="N", help="Which simulated house.", min=0)
    ] = DEFAULT_SEED,
    speed: Annotated[
        float, typer.Option(metavar="X", help="Times real time.", min=1.0, max=1000.0)
    ] = 30.0,
    databases: Databases,
    json_: JsonOption = False,
) -> None:
    """Record, replay, map and re-localise a simulated robot on this machine.

    A robot explores a simulated house and is recorded through a Zenoh router; the log is replayed
    into databases; a second, lost robot asks where it is. The databases are the demo's own, in DIR,
    and yours are not touched; but in those that --db and --vector-db name, the demo's map replaces
    the one that is there.

    Exit 3 when log, databases and fold do not agree.
    """
    # Here and not above: the demo alone needs nearly everything, and that takes a while to import.
    from projections.surfaces.demo.play import run_demo

    numbers = run_demo(out, seed, speed, databases.db, databases.vector_db, say)
    if json_:
        emit(numbers)
    finish(findings=not numbers["sound"])
