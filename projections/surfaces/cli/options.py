"""Options and arguments that several commands share, and their parsing.

What only some commands need (databases, re-localisation, pictures) is imported in the
function that uses it: the imports of all of them take longer than most commands.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eventsrc.base.advised import advised
from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from eventsrc.record.transport.config import DEFAULT_ENDPOINT, ZenohOptions
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.errors import QuestionError, SettingsError
from projections.fold.settings import Settings, read_settings

from .terminal import say

if TYPE_CHECKING:
    from projections.localize.relocalize import Camera, Question
    from projections.postgres.connection import Targets

JsonOption = Annotated[bool, typer.Option("--json", help="JSON on stdout.")]
NoCacheOption = Annotated[
    bool,
    typer.Option("--no-cache", help="Do not use the cached history beside the log, nor write it."),
]
LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")]

# Points of a log

W = "number of events, ISO time, RUN:KEYFRAME (inclusive) or end"
"""The forms of W, for help texts."""


def point(reader: LogReader, text: str) -> Offset:
    """The number of events that W means in this log; warns when times run backwards in it."""
    return resolve(reader, text, note=say)


KnownAtOption = Annotated[
    str | None,
    typer.Option(
        "--known-at",
        metavar="V",
        help="Apply only the commands recorded before here [default: the end of the map].",
    ),
]


def known_point(reader: LogReader, text: str | None, end: Offset) -> Offset:
    """The point of ``--known-at``; the map's own ``end`` without it."""
    return end if text is None else point(reader, text)


# Settings of the fold

SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a setting of the fold, as eps_m=1.0 or camera.hfov_deg=90; may be repeated.",
    ),
]
SettingsOption = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="FILE",
        help="JSON object of settings instead of those that the log names; --set goes on top.",
    ),
]


def settings_from(
    file: Path | None, assignments: list[str] | None, corrections: Corrections = NO_CORRECTIONS
) -> Settings:
    """The settings of a command: those of ``--settings``, else those that the log names
    (``use-settings``), else the defaults; ``--set`` changes them.

    Raises SettingsError naming file and field.
    """
    logged = corrections.settings or Settings()
    settings = logged if file is None else _settings_of_file(file)
    return settings.with_assignments(assignments or ())


def settings_of(
    file: Path | None, assignments: list[str] | None
) -> Callable[[Corrections], Settings]:
    """`settings_from` as a function of the corrections, which are read later. Raises SettingsError
    for invalid options at once."""
    settings_from(file, assignments)
    return partial(settings_from, file, assignments)


def _settings_of_file(file: Path) -> Settings:
    try:
        return read_settings(file)
    except (FileFault, SettingsError) as error:
        raise SettingsError(f"--settings {file}: {error}") from None


def past_settings(
    log: Path | None,
    file: Path | None,
    assignments: list[str] | None,
    corrections: Corrections = NO_CORRECTIONS,
) -> Settings:
    """The settings to fold ``log`` with, for a question to a past map.

    Raises MisuseError when there are settings but no log: the live map keeps its own.
    """
    if log is None and (file is not None or assignments):
        raise MisuseError(
            "--preset, --set and --settings are for folding a log, and the live map keeps the"
            " settings it was made with; give --log LOG too, or run"
            f" `{advised('replay')}`"
        )
    return settings_from(file, assignments, corrections)


def say_defaults(settings: Settings) -> None:
    """Print, after a fold with default settings, that the live map may have others."""
    if settings == Settings():
        say("folded with the default settings; if the live map has others, give them by --set")


# Databases

DbOption = Annotated[
    str | None,
    typer.Option(
        "--db",
        metavar="URL",
        help="PostgreSQL with Apache AGE for the graph [env MAPFOLD_DB; default: embedded server].",
    ),
]
VectorDbOption = Annotated[
    str | None,
    typer.Option(
        "--vector-db",
        metavar="URL",
        help="PostgreSQL with pgvector for the embeddings [env MAPFOLD_VECTOR_DB; default: --db].",
    ),
]


@contextlib.contextmanager
def databases(db: str | None, vector_db: str | None) -> "Iterator[Targets]":
    """The databases a command uses; an embedded server it started is stopped, also by a signal."""
    from projections.postgres.connection import open_targets

    with open_targets(db, vector_db) as targets:
        yield targets


# Zenoh

_ZENOH_PANEL = "Zenoh"

ConnectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        help=f"Router or peer to connect to; may be repeated. [default: {DEFAULT_ENDPOINT}]",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ConnectBesideListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        help="Router or peer to connect to; may be repeated."
        f" [default: {DEFAULT_ENDPOINT}; none with --listen]",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        metavar="ENDPOINT",
        help="Let others connect to this process there; may be repeated. Port 0 takes a free one.",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-config",
        metavar="FILE",
        help="Zenoh configuration (JSON5) for the rest: TLS, access control, scouting.",
        rich_help_panel=_ZENOH_PANEL,
    ),
]
PublishKeyOption = Annotated[
    str, typer.Option("--key", metavar="KEY", help="Zenoh key to publish under.")
]


def zenoh_options(
    connect: list[str] | None, listen: list[str] | None, config: Path | None
) -> ZenohOptions:
    """The Zenoh configuration of ``--connect``, ``--listen`` and ``--zenoh-config``."""
    return ZenohOptions(tuple(connect or ()), tuple(listen or ()), config)


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
HfovOption = Annotated[
    float | None,
    typer.Option(
        "--hfov",
        metavar="DEGREES",
        help="Horizontal field of view of the robot's camera [default: that of the map's"
        " settings].",
        show_default=False,
    ),
]
ImageOption = Annotated[
    str | None,
    typer.Option(
        "--image",
        metavar="WxH",
        help="Size of the camera's pictures in pixels [default: that of the map's settings].",
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


def camera_from(hfov: float | None, image: str | None) -> "Camera | None":
    """The camera that ``--hfov`` and ``--image`` describe; None without either of them, and with
    one alone the other is that of mapfold's defaults. Raises QuestionError for a bad size."""
    from projections.localize.relocalize import DEFAULT_CAMERA, Camera

    if hfov is None and image is None:
        return None
    hfov = DEFAULT_CAMERA.hfov_deg if hfov is None else hfov
    if image is None:
        return Camera(DEFAULT_CAMERA.width_px, DEFAULT_CAMERA.height_px, hfov)
    width, _, height = image.lower().partition("x")
    try:
        return Camera(float(width), float(height), hfov)
    except ValueError:
        raise QuestionError(f"--image {image}: write it as 640x400, in pixels") from None


# Pictures


def check_picture(out: Path | None) -> None:
    """Raises MisuseError when ``out`` is not the name of a picture; None is no picture."""
    if out is None:
        return
    from projections.adapters.drawing.canvas import check_suffix

    check_suffix(out)
