"""The options of every command that speaks Zenoh, in one place."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.transport.config import DEFAULT_ENDPOINT
from eventsrc.transport.session import ZenohOptions

_PANEL = "Zenoh"

ConnectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        help=f"Router or peer to connect to; may be repeated. [default: {DEFAULT_ENDPOINT}]",
        rich_help_panel=_PANEL,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        metavar="ENDPOINT",
        help="Let others connect to this process there; may be repeated. Port 0 takes a free one.",
        rich_help_panel=_PANEL,
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-config",
        metavar="FILE",
        help="Zenoh configuration (JSON5) for the rest: TLS, access control, scouting.",
        rich_help_panel=_PANEL,
    ),
]


def zenoh_options(
    connect: list[str] | None, listen: list[str] | None, config: Path | None
) -> ZenohOptions:
    """What the three options above say."""
    return ZenohOptions(tuple(connect or ()), tuple(listen or ()), config)
