"""Groups of options that several commands share, and their parsing: databases, Zenoh, questions.

What only some commands need (databases, re-localisation, pictures) is imported in the
function that uses it: the imports of all of them take longer than most commands.
"""

import getpass
import os
import socket
import sys
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, cast, get_args

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.record.transport.config import DEFAULT_ENDPOINT, ZenohOptions
from projections.fold.map_errors import QuestionError

if TYPE_CHECKING:
    from eventsrc.record.transport.session import Session
    from projections.fold.settings import CameraConstants
    from projections.localize.relocalize import Method, Question
    from projections.postgres.connection import Targets
    from projections.postgres.labels import SinkName


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """The option ``names`` (by default that of the parameter's name) for an ``Annotated`` type.
    ``more`` is for `typer.Option`."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


JsonOption = Annotated[bool, typer.Option("--json", help="JSON on stdout.")]
# Databases

DbOption = Annotated[
    str | None,
    option(
        "URL",
        "PostgreSQL with Apache AGE for the graph [env MAPFOLD_DB; default: embedded server].",
        "--db",
    ),
]
VectorDbOption = Annotated[
    str | None,
    option(
        "URL",
        "PostgreSQL with pgvector for the embeddings [env MAPFOLD_VECTOR_DB; default: --db].",
        "--vector-db",
    ),
]
LogOrDbArgument = Annotated[
    Path | None, typer.Argument(metavar="LOG", help="The log's folder; leave it out with --db.")
]
LiveDbOption = Annotated[
    str | None,
    option("URL", "Ask this database's live map, not a log; '' is the embedded server.", "--db"),
]
VectorsOption = Annotated[
    str | None, option("URL", "The database of the vectors [default: --db].", "--vector-db")
]


class Sinks(StrEnum):
    """The values of ``--only``."""

    graph = "graph"
    vectors = "vectors"


OnlyOption = Annotated[
    Sinks | None, option("graph|vectors", "Only the graph or the vectors.", "--only")
]


def only_of(only: Sinks | None) -> "SinkName | None":
    """The sink's name, None for both."""
    return None if only is None else only.value


@dataclass(frozen=True, kw_only=True)
class Databases:
    """``--db`` and ``--vector-db``."""

    db: DbOption = None
    vector_db: VectorDbOption = None

    def opened(self) -> "AbstractContextManager[Targets]":
        """The databases; an embedded server that this starts is stopped at the end."""
        from projections.postgres.connection import open_targets

        return open_targets(self.db, self.vector_db)


# Zenoh

_ZENOH_PANEL = "Zenoh"

ConnectOption = Annotated[
    list[str] | None,
    option(
        "ENDPOINT",
        f"Router or peer to connect to; may be repeated. [default: {DEFAULT_ENDPOINT}]",
        "--connect",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ConnectBesideListenOption = Annotated[
    list[str] | None,
    option(
        "ENDPOINT",
        "Router or peer to connect to; may be repeated."
        f" [default: {DEFAULT_ENDPOINT}; none with --listen]",
        "--connect",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    option(
        "ENDPOINT",
        "Let others connect to this process there; may be repeated. Port 0 takes a free one.",
        "--listen",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ConfigOption = Annotated[
    Path | None,
    option(
        "FILE",
        "Zenoh configuration (JSON5) for the rest: TLS, access control, scouting.",
        "--zenoh-config",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
PublishKeyOption = Annotated[str, option("KEY", "Zenoh key to publish under.", "--key")]


@dataclass(frozen=True, kw_only=True)
class ZenohClient:
    """``--connect`` and ``--zenoh-config``."""

    connect: ConnectOption = None
    zenoh_config: ConfigOption = None

    @property
    def zenoh(self) -> ZenohOptions:
        """The Zenoh configuration."""
        return ZenohOptions(tuple(self.connect or ()), (), self.zenoh_config)

    def session(self) -> "AbstractContextManager[Session]":
        """A new session."""
        from eventsrc.record.transport.session import open_session

        return open_session(self.zenoh, mode=self.zenoh.mode)


@dataclass(frozen=True, kw_only=True)
class ZenohPeer:
    """``--connect``, ``--listen`` and ``--zenoh-config``."""

    connect: ConnectBesideListenOption = None
    listen: ListenOption = None
    zenoh_config: ConfigOption = None

    @property
    def zenoh(self) -> ZenohOptions:
        """The Zenoh configuration."""
        listen = tuple(self.listen or ())
        return ZenohOptions(tuple(self.connect or ()), listen, self.zenoh_config)


# Questions to the map

QuestionArgument = Annotated[
    str,
    typer.Argument(
        metavar="QUERY",
        help="JSON file with the crops: an envelope, a list of detections, or an object with"
        " crops or views; - reads stdin.",
    ),
]
OptionalQuestion = Annotated[
    str | None,
    typer.Argument(
        metavar="QUERY",
        help="JSON file with the crops: an envelope, a list of detections, or an object with"
        " crops or views; - reads stdin.",
        show_default=False,
    ),
]


def question_from(query: str) -> "Question":
    """The question of a file or of stdin. Raises QuestionError that names the file."""
    from projections.localize.relocalize import MAX_QUESTION_BYTES, parse_question

    try:
        if query == "-":
            payload = sys.stdin.buffer.read(MAX_QUESTION_BYTES + 1)
        else:
            payload = read_file(Path(query), MAX_QUESTION_BYTES)
    except FileFault as fault:
        raise QuestionError(f"{query}: {fault}; give a JSON file, or -") from None
    if len(payload) > MAX_QUESTION_BYTES:
        raise QuestionError(f"{query}: larger than {MAX_QUESTION_BYTES:,} bytes; send fewer crops")
    try:
        return parse_question(payload)
    except QuestionError as error:
        raise QuestionError(f"{query}: {error}") from None


_HfovOption = Annotated[
    float | None,
    option(
        "DEGREES",
        "Horizontal field of view of the robot's camera [default: that of the map's pictures].",
        "--hfov",
        show_default=False,
    ),
]
_ImageOption = Annotated[
    str | None,
    option(
        "WxH",
        "Size of the camera's pictures in pixels [default: that of the map's pictures].",
        "--image",
        show_default=False,
    ),
]


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """``--hfov`` and ``--image``."""

    hfov: _HfovOption = None
    image: _ImageOption = None

    @property
    def camera(self) -> "CameraConstants | None":
        """The camera that these describe; None without either of them, and with one alone the other
        is that of mapfold's defaults. Raises QuestionError for a bad size."""
        from projections.fold.settings import CameraConstants

        given = {} if self.hfov is None else {"hfov_deg": self.hfov}
        try:
            if self.image is not None:
                width, _, height = self.image.lower().partition("x")
                given |= {"width_px": float(width), "height_px": float(height)}
            return CameraConstants.model_validate(given) if given else None
        except ValueError:
            raise QuestionError(
                "no such camera: write --image as 640x400, in pixels, and --hfov, the horizontal"
                " field of view, as 1 to 170, in degrees"
            ) from None


# Pictures


def check_picture(out: Path | None) -> None:
    """Raises MisuseError when ``out`` is not the name of a picture; None is no picture."""
    if out is None:
        return
    from projections.adapters.drawing.sheet import check_suffix

    check_suffix(out)


def user_at_host() -> str:
    """``user@host``: who gives a command."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # a user id without a name
        name = str(os.getuid())
    return f"{name}@{socket.gethostname()}"


def method_from(text: str) -> "Method":
    """The method of re-localisation that an option names. Raises MisuseError."""
    from projections.localize.relocalize import Method

    if text in get_args(Method):
        return cast("Method", text)
    raise MisuseError(f"--method {text}: choose joint or plain")


# Robots with ROS 2

_DOMAIN_VARIABLE: Final = "ROS_DOMAIN_ID"
_MAX_DOMAIN: Final = 232


def domain_option(text: str, **more: Any) -> Any:
    """The option ``--domain``."""
    default = f" [default: {_DOMAIN_VARIABLE}, else 0]"
    return option("N", text + default, "--domain", min=0, max=_MAX_DOMAIN, **more)


DomainOption = Annotated[int | None, domain_option("The ROS domain of the node.")]


def domain_of(domain: int | None) -> int:
    """``--domain``, or that of ROS's environment. Raises MisuseError."""
    if domain is not None:
        return domain
    said = os.environ.get(_DOMAIN_VARIABLE) or "0"
    if not (said.isascii() and said.isdecimal() and len(said) < 9 and int(said) <= _MAX_DOMAIN):
        raise MisuseError(
            f"{_DOMAIN_VARIABLE} is {visible(said)[:80]}, not 0 to {_MAX_DOMAIN}; give --domain N"
        )
    return int(said)
