"""`mapfold edit` and `mapfold edits`: corrections as events of the log, and a list of them.

`edit` is a group: each kind of command is a subcommand with arguments of its own, and the options
that all of them share (`edit_command`).
"""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import KeyframeId
from eventsrc.envelope.trajectory import read_trajectory
from eventsrc.log import LogReader
from eventsrc.record.importers.map_yaml import read_labels
from projections.edit import make
from projections.edit.correct_poses import (
    DEFAULT_SLACK_S,
    Span,
    by_trajectory,
    by_transform,
    join_frames,
)
from projections.edit.current import MapToEdit
from projections.edit.effect import edits_document, edits_text, effects_of
from projections.edit.make import Stamp
from projections.surfaces.text_encoders import with_text_encoder

from .edit_command import EditOptions, NewCommand
from .folded_log import AssignedSettings, LogArgument, LogSettings, settings_from
from .options import JsonOption, option
from .terminal import display, emit, say

PlaceArgument = Annotated[
    str,
    typer.Argument(metavar="PLACE", help="A place: p3, a name, a type of room, or RUN:KEYFRAME."),
]
OtherPlaceArgument = Annotated[
    str, typer.Argument(metavar="PLACE", help="Another one, the same way.")
]
ObjectArgument = Annotated[
    str, typer.Argument(metavar="OBJECT", help="An object's first six characters, class or det_id.")
]
OtherObjectArgument = Annotated[
    str, typer.Argument(metavar="OBJECT", help="Another one, the same way.")
]
RunArgument = Annotated[str, typer.Argument(metavar="RUN", help="The run's id.")]


edit = typer.Typer(
    no_args_is_help=True,
    help="Correct the map by an event in the log: it survives rebuilds, and can be undone.",
    rich_markup_mode=None,
)


@edit.callback()
def _log(context: typer.Context, log: LogArgument) -> None:
    context.obj = log


@edit.command("name-place")
def _name_place(
    *,
    place: PlaceArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="The name of the place.")],
    options: EditOptions,
) -> None:
    """Give a place a name; a reason is not needed."""
    options.record(
        lambda current, stamp: make.name_place(current, stamp, place, name), needs_reason=False
    )


@edit.command("keep-apart")
def _keep_apart(*, first: PlaceArgument, second: OtherPlaceArgument, options: EditOptions) -> None:
    """Keep two places apart, whatever joins them later."""
    options.record(lambda current, stamp: make.keep_apart(current, stamp, first, second))


@edit.command("undo-merge")
def _undo_merge(
    *,
    offset: Annotated[
        int,
        typer.Argument(
            metavar="OFFSET", help="The offset of the merge, from `mapfold merges LOG`."
        ),
    ],
    options: EditOptions,
) -> None:
    """Undo a merge of places and keep them apart."""
    options.record(lambda current, stamp: make.undo_merge(current, stamp, offset))


@edit.command("join")
def _join(*, first: PlaceArgument, second: OtherPlaceArgument, options: EditOptions) -> None:
    """Join two places into one.

    Also where no chain of poses connects them.
    """
    options.record(lambda current, stamp: make.join(current, stamp, first, second))


@edit.command("same-object")
def _same_object(
    *, first: ObjectArgument, second: OtherObjectArgument, options: EditOptions
) -> None:
    """Fuse two objects into one."""
    options.record(lambda current, stamp: make.same_object(current, stamp, first, second))


@edit.command("different-objects")
def _different_objects(
    *, first: ObjectArgument, second: OtherObjectArgument, options: EditOptions
) -> None:
    """Keep two objects apart.

    Two observations of one object, named by their det_ids, become two objects.
    """
    options.record(lambda current, stamp: make.different_objects(current, stamp, first, second))


@edit.command("drop-object")
def _drop_object(
    *,
    thing: Annotated[str, typer.Argument(metavar="OBJECT", help="The object, as its id or class.")],
    options: EditOptions,
) -> None:
    """Drop an object from the map, with the observations that it has now.

    The log keeps them.
    """
    options.record(lambda current, stamp: make.drop_object(current, stamp, thing))


@edit.command("drop-detection")
def _drop_detection(
    *,
    det_ids: Annotated[list[str], typer.Argument(metavar="DET_ID", help="The det_id of each.")],
    options: EditOptions,
) -> None:
    """Drop detections from the map; the log keeps them."""
    options.record(lambda current, stamp: make.drop_detection(current, stamp, det_ids))


@edit.command("forget-run")
def _forget_run(*, run: RunArgument, options: EditOptions) -> None:
    """Drop all keyframes of a run from the map; the log keeps them."""
    options.record(lambda current, stamp: make.forget_run(current, stamp, run))


@edit.command("forget-keyframes")
def _forget_keyframes(
    *,
    run: RunArgument,
    span: Annotated[
        str, typer.Argument(metavar="A..B", help="From keyframe A to keyframe B, both included.")
    ],
    options: EditOptions,
) -> None:
    """Drop some keyframes of a run from the map; the log keeps them."""
    options.record(lambda current, stamp: make.forget_keyframes(current, stamp, run, span))


_FromOption = Annotated[int | None, option("K", "From this keyframe of the run.", "--from")]
_ToOption = Annotated[int | None, option("K", "To this keyframe, included.", "--to")]


@edit.command("correct-poses")
def _correct_poses(
    *,
    run: RunArgument,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A trajectory: TUM, CSV with a header, JSON lines."),
    ] = None,
    dx: Annotated[float | None, option("METRES", "Shift in x.", "--dx")] = None,
    dy: Annotated[float | None, option("METRES", "Shift in y.", "--dy")] = None,
    dyaw: Annotated[
        float | None, option("RADIANS", "Turn about the map's origin.", "--dyaw")
    ] = None,
    first: _FromOption = None,
    last: _ToOption = None,
    slack: Annotated[
        float,
        option(
            "SECONDS", "How far a keyframe may lie outside the stamps of FILE.", "--slack", min=0.0
        ),
    ] = DEFAULT_SLACK_S,
    ignore_missing: Annotated[
        bool,
        typer.Option(
            "--ignore-missing", help="Skip poses of keyframes that the run does not have."
        ),
    ] = False,
    options: EditOptions,
) -> None:
    """Correct the poses of a run.

    By a trajectory file, or by one rigid transform. Keyframes that the file has no pose for keep
    theirs.
    """
    transform = [value for value in (dx, dy, dyaw) if value is not None]
    if (file is None) == (not transform):
        raise MisuseError("give either FILE or some of --dx, --dy and --dyaw")
    span = Span(_keyframe_id(first), _keyframe_id(last))
    if file is None:
        moves = (dx or 0.0, dy or 0.0, dyaw or 0.0)
        options.record(lambda current, stamp: by_transform(current, stamp, run, span, *moves))
        return
    trajectory = read_trajectory(file)
    options.record(
        lambda current, stamp: by_trajectory(
            current, stamp, run, trajectory, span, slack, ignore_missing=ignore_missing, note=say
        )
    )


@edit.command("join-frames")
def _join_frames(
    *,
    frame: Annotated[str, typer.Argument(metavar="FRAME", help="The map frame to move.")],
    into: Annotated[
        str | None, option("FRAME", "The frame to move it into [default: the map's own].", "--into")
    ] = None,
    dx: Annotated[float, option("METRES", "Shift in x.", "--dx")] = 0.0,
    dy: Annotated[float, option("METRES", "Shift in y.", "--dy")] = 0.0,
    dyaw: Annotated[float, option("RADIANS", "Turn about the frame's origin.", "--dyaw")] = 0.0,
    options: EditOptions,
) -> None:
    """Join all keyframes in a map frame that is held apart to the map, by one rigid transform.

    `mapfold merges LOG --frames` lists the frames; `mapfold align` finds the transform.
    """
    options.record(lambda current, stamp: join_frames(current, stamp, frame, into, dx, dy, dyaw))


def _keyframe_id(number: int | None) -> KeyframeId | None:
    return None if number is None else KeyframeId(number)


@edit.command("relabel")
def _relabel(
    *,
    named: Annotated[
        list[str] | None,
        typer.Argument(metavar="LABEL=NAME", help="A recorded label and its name: 17=chair."),
    ] = None,
    file: Annotated[
        Path | None,
        option(
            "FILE",
            "Names by label: JSON, YAML, or a name in each line, the first that of 0.",
            "--labels",
        ),
    ] = None,
    options: EditOptions,
) -> None:
    """Give classes names, where a detector recorded numbers or words of its own.

    A label is what the log has, whatever it was called since; of those in FILE it need not have
    all. Types of rooms that change by it are printed. A reason is not needed.
    """
    listed = {} if file is None else read_labels(file)
    given = make.labels_of(named or ())
    if not (listed or given):
        raise MisuseError("give LABEL=NAME or --labels FILE")
    options.record(
        lambda current, stamp: make.relabel(current, stamp, given, listed), needs_reason=False
    )


@edit.command("use-settings")
def _use_settings(
    *,
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="JSON object of settings.")
    ] = None,
    chosen: AssignedSettings,
    options: NewCommand,
) -> None:
    """Change the settings of the map.

    To those of FILE, else those in force, changed by --preset and --set.
    """
    if file is None and not chosen.assignments:
        raise MisuseError("give FILE, --preset NAME or --set NAME=VALUE")

    def command(current: MapToEdit, stamp: Stamp) -> Command:
        settings = settings_from(file, chosen.assignments, current.corrections)
        return make.use_settings(current, stamp, with_text_encoder(settings, current))

    options.record(command)


@edit.command("undo")
def _undo(
    *,
    undone: Annotated[str, typer.Argument(metavar="COMMAND_ID", help="From `mapfold edits LOG`.")],
    options: EditOptions,
) -> None:
    """Undo a command, as if it had never been given.

    Undoing an undo restores the command.
    """
    options.record(lambda current, stamp: make.undo(current, stamp, undone))


def edits(
    *,
    effects: Annotated[
        bool,
        typer.Option(
            "--effects", help="Compute the effects that are not known yet: two folds for each."
        ),
    ] = False,
    json_: JsonOption = False,
    source: LogSettings,
) -> None:
    """List the commands in a log: who gave which when and why, what it changed, what is undone.

    An effect counts the places, objects and keyframes that were changed in the map of the events
    before the command. `mapfold edit` keeps the effect of its command beside the log.
    """
    with LogReader(source.log) as reader:
        current = MapToEdit(reader, source.settings, note=say)
        found = effects_of(current, known_only=not effects)
        times = {event.offset: event.logged_ns for event in current.command_events()}
    if json_:
        emit(edits_document(found, times))
    else:
        display(edits_text(found, times))
