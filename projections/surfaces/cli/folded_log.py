"""The log that a command folds, the point up to which, and the settings of the fold.

``--preset`` and ``--space`` are short for assignments of ``--set``: a preset comes before them, so
that ``--set`` changes it; ``--space NAME`` is ``--set embedding_model=NAME`` and comes behind them.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from msgspec.structs import replace

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, command_line, visible
from eventsrc.base.user_files import FileFault
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.map_errors import SettingsError
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings, preset_assignments, read_settings
from projections.map.parsing import read_corrections
from projections.map.view import MapView

from .options import option
from .terminal import say

LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")]
MOST_LINES = 5
"""Things of a kind that a text answer names without --all."""

AllOption = Annotated[
    bool, typer.Option("--all", help=f"List all changes, not only {MOST_LINES} of a kind.")
]

# Points of a log

W = "number of events, ISO time, RUN:KEYFRAME (inclusive) or end"
"""The forms of W, for help texts."""


def point(reader: LogReader, text: str) -> Offset:
    """The number of events that W means in this log; warns when times run backwards in it."""
    return resolve(reader, text, note=say)


FoldToOption = Annotated[str, option("W", f"Fold to here: {W}.", "--at")]
AtOption = Annotated[str, option("W", f"Use the map as of here: {W}.", "--at")]
KnownAtOption = Annotated[
    str | None,
    option(
        "V",
        "Apply only the commands recorded before here [default: the end of the map].",
        "--known-at",
    ),
]


def known_point(reader: LogReader, text: str | None, end: Offset) -> Offset:
    """The point of ``--known-at``; the map's own ``end`` without it."""
    return end if text is None else point(reader, text)


# Settings of the fold


def complete_preset() -> list[str]:
    """What completes ``--preset``."""
    return list(PRESETS)


PresetOption = Annotated[
    str | None,
    option(
        "|".join(PRESETS),
        "Named settings: classic, places by DBSCAN; rooms, places that are rooms; full, rooms"
        " and objects by evidence. --set goes on top.",
        "--preset",
        autocompletion=complete_preset,
    ),
]
SpaceOption = Annotated[
    str | None,
    option(
        "NAME",
        "The embedding space of the map, by its model's name [default: that of the log's first"
        " vector]; see `mapfold reembed`.",
        "--space",
    ),
]
SetOption = Annotated[
    list[str] | None,
    option(
        "NAME=VALUE",
        "Change a setting of the fold, as eps_m=1.0 or camera.hfov_deg=90; may be repeated.",
        "--set",
    ),
]
SettingsOption = Annotated[
    Path | None,
    option(
        "FILE",
        "JSON object of settings instead of those that the log names; --set goes on top.",
        "--settings",
    ),
]
NoCacheOption = Annotated[
    bool,
    typer.Option("--no-cache", help="Do not use the cached history beside the log, nor write it."),
]


@dataclass(frozen=True, kw_only=True)
class NamedSettings:
    """``--preset`` and ``--space``."""

    preset: PresetOption = None
    space: SpaceOption = None

    def around(self, assignments: list[str] | None) -> list[str]:
        """All of them as assignments, with those of ``--set`` in between. Raises SettingsError for
        a preset that does not exist."""
        preset = () if self.preset is None else (_preset(self.preset),)
        space = () if self.space is None else (f"embedding_model={self.space}",)
        return [*preset, *(assignments or ()), *space]


def _preset(name: str) -> str:
    try:
        preset_assignments(name)
    except SettingsError as error:
        raise SettingsError(f"--preset: {error}") from None
    return f"preset={name}"


@dataclass(frozen=True, kw_only=True)
class AssignedSettings(NamedSettings):
    """The options that stand for assignments."""

    set_: SetOption = None

    @property
    def assignments(self) -> list[str]:
        """Settings as NAME=VALUE."""
        return self.around(self.set_)


@dataclass(frozen=True, kw_only=True)
class FoldSettings(AssignedSettings):
    """The settings of a fold: those of ``--settings``, else those that the log names
    (``use-settings``), else the defaults; assignments change them."""

    settings_file: SettingsOption = None

    def settings(self, corrections: Corrections = NO_CORRECTIONS) -> Settings:
        """The settings under the corrections of a log. Raises SettingsError naming file and
        field."""
        return settings_from(self.settings_file, self.assignments, corrections)

    def checked(self) -> Callable[[Corrections], Settings]:
        """`settings`, for corrections that are read later. Raises SettingsError for invalid options
        at once."""
        self.settings()
        return self.settings

    def of_past_map(self, log: Path | None, corrections: Corrections = NO_CORRECTIONS) -> Settings:
        """The settings to fold ``log`` with, for a question to a past map.

        Raises MisuseError when there are settings but no log: the live map keeps its own.
        """
        if log is None and (self.settings_file is not None or self.assignments):
            raise MisuseError(
                "--preset, --set and --settings are for folding a log, and the live map keeps the"
                " settings it was made with; give --log LOG too, or run"
                f" `{advised('replay')}`"
            )
        return self.settings(corrections)


def settings_from(
    file: Path | None, assignments: list[str] | None, corrections: Corrections = NO_CORRECTIONS
) -> Settings:
    """The settings of a file, else of the corrections, else the defaults, changed by assignments.

    Raises SettingsError naming file and field.
    """
    logged = corrections.settings or Settings()
    settings = logged if file is None else _settings_of_file(file)
    return settings.with_assignments(assignments or ())


def _settings_of_file(file: Path) -> Settings:
    try:
        return read_settings(file)
    except (FileFault, SettingsError) as error:
        raise SettingsError(f"--settings {file}: {error}") from None


def say_defaults(settings: Settings) -> None:
    """Print, after a fold with default settings, that the live map may have others."""
    if settings == Settings():
        say("folded with the default settings; if the live map has others, give them by --set")


# A log and its settings


class OpenLog(NamedTuple):
    """A log that is open, and what to fold of it: the first ``end`` events under the commands of
    the first ``known``."""

    reader: LogReader
    end: Offset
    known: Offset
    corrections: Corrections
    settings: Settings


@dataclass(frozen=True, kw_only=True)
class LogSettings(FoldSettings):
    """A log, and the settings that it is folded with."""

    log: LogArgument

    @contextlib.contextmanager
    def opened(self, at: str = "end", known_at: str | None = None) -> Iterator[OpenLog]:
        """The log and its part up to W. Raises SettingsError for invalid options before the log is
        opened."""
        self.checked()
        with LogReader(self.log) as reader:
            end = point(reader, at)
            known = known_point(reader, known_at, end)
            corrections = read_corrections(reader, known)
            yield OpenLog(reader, end, known, corrections, self.settings(corrections))


@dataclass(frozen=True, kw_only=True)
class CachedLog(LogSettings):
    """A log whose history is kept beside it."""

    no_cache: NoCacheOption = False


def classes_advice(log: Path) -> str:
    """One line for a log whose classes are all numbers."""
    named = command_line("edit", log, "relabel", "--labels", "FILE")
    return f"all classes are numbers: `{visible(named)}` names them"


UNNAMED = "-"
"""The value of `--floor` for the floor of poses whose envelopes name none."""


def view_of_floor(view: MapView, floor: str) -> MapView:
    """A view of the places, Objects and poses on a floor. Keyframes elsewhere are in it without
    their pose, so all ordinals hold. Raises MisuseError for a floor that is not in the map."""
    name = None if floor == UNNAMED and UNNAMED not in view.floors else floor
    posed = [k for k in view.keyframes if k.pose is not None]
    if all(k.floor != name for k in posed):
        unnamed = [UNNAMED] if any(k.floor is None for k in posed) else []
        known = ", ".join(map(visible, [*view.floors, *unnamed])) or "no floor"
        raise MisuseError(f"no floor {floor!r} in this map; it has {known}")
    found = MapView(view.settings, keep_embeddings=False, corrections=view.corrections)
    found.advance(view.next_offset)
    found.runs, found.observations = view.runs, view.observations
    found.keyframes = [k if k.floor == name else replace(k, pose=None) for k in view.keyframes]
    found.all_places, found.survivors = view.all_places, view.survivors
    found.places = {p: each for p, each in view.places.items() if view.floor_of(p) == name}
    found.all_objects, found.object_survivors = view.all_objects, view.object_survivors
    found.objects = {
        number: each
        for number, each in view.objects.items()
        if view.keyframes[view.observations[each.observations[0]].keyframe].floor == name
    }
    found.adjacency = {
        (a, b): count
        for (a, b), count in view.adjacency.items()
        if a in found.places and b in found.places
    }
    if (given := view.maps_in_force().get(name)) is not None:
        found.maps[None] = given  # the only floor is the first
    found.floors, found.contents = view.floors, view.contents
    return found


def warn_of_no_truth(log: Path, scores: Mapping[str, Any] | None) -> None:
    """Warn if none of a map's keyframes and observations has truth; None stands for no scores."""
    if scores is not None and not (scores["places"]["rooms"] or scores["objects"]["instances"]):
        say(
            f"no truth for any keyframe of {log}: its places and objects are not scored; see"
            " --truth"
        )
