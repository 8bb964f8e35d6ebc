"""What is said once of a log: its settings, which become its first event, and the classes that it
drops (`eventsrc.envelope.dropped_classes`), which any later recording may add to.

A log is new as long as it has no events. A command with other settings than a log has is refused;
the error names the `edit` that changes them.
"""

import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import ValidationError

from eventsrc.base.errors import LogDamaged, MapfoldError, MisuseError
from eventsrc.base.text import command_line, visible
from eventsrc.envelope.commands import UseSettings, encode_command
from eventsrc.envelope.dropped_classes import MAX_CLASSES, ClassDropper, DropClasses
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.envelope.model import FIRST_OFFSET, MAX_ID_LENGTH, Offset
from eventsrc.envelope.system_events import COMMAND_KEY, DROP_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.append import dropped_classes
from projections.fold.corrections import RecordedCommand, compile_corrections
from projections.fold.map_errors import FoldError
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings
from projections.map.parsing import read_commands
from projections.map.state_output import camera_advice

from .folded_log import NamedSettings, complete_preset
from .options import option, user_at_host
from .terminal import say

if TYPE_CHECKING:
    from eventsrc.record.importers.known_log import LogCommands

ROS_PRESET: Final = "full"
_ROS_REASON: Final = "the preset of ROS input"
_TOLD_REASON: Final = "said when the log was made"
_PANEL: Final = "Settings of a new log"


DropClassOption = Annotated[
    list[str] | None,
    option(
        "CLASS",
        "Never store detections of this class, nor their vectors and crops; may be repeated. Said"
        " once: all later recordings of the log obey, and nothing takes it back.",
        "--drop-class",
    ),
]


def drop_event(classes: Sequence[str] | None) -> DropClasses | None:
    """The event that says ``--drop-class``; None without it. Raises MisuseError."""
    named = tuple(dict.fromkeys(classes or ()))
    if not named:
        return None
    try:
        return DropClasses(classes=named, issued_by=user_at_host())
    except ValidationError:
        raise MisuseError(
            f"--drop-class {visible(', '.join(named)[:80])}: name at most {MAX_CLASSES:,} classes,"
            f" each of 1 to {MAX_ID_LENGTH} characters, none of them a control character"
        ) from None


@dataclass(frozen=True, kw_only=True)
class NewLogOptions:
    """``--preset`` and ``--set`` of commands that make a log."""

    preset: Annotated[
        str | None,
        option(
            "|".join(PRESETS),
            "What a new log begins with, and every fold of it uses: classic, places by"
            " DBSCAN; rooms, places that are rooms; full, rooms and objects by evidence. [default:"
            f" {ROS_PRESET} for input of ROS, else classic]",
            "--preset",
            autocompletion=complete_preset,
            rich_help_panel=_PANEL,
        ),
    ] = None
    set_: Annotated[
        list[str] | None,
        option(
            "NAME=VALUE",
            "A setting on top, as eps_m=1.0 or camera.hfov_deg=90; may be repeated.",
            "--set",
            rich_help_panel=_PANEL,
        ),
    ] = None

    @property
    def assignments(self) -> list[str]:
        """Settings as NAME=VALUE. Raises SettingsError for a preset that does not exist."""
        return NamedSettings(preset=self.preset).around(self.set_)

    def check(self) -> None:
        """Raise SettingsError for settings that no map can have, MisuseError for a text encoder
        that cannot be read."""
        _assigned(Settings(), self.assignments)

    def command(self) -> UseSettings | None:
        """The command that a new log begins with; None where nothing is chosen. Raises
        SettingsError."""
        return _command(self.assignments, _TOLD_REASON) if self.assignments else None

    def for_file(self, out: Path | None) -> UseSettings | None:
        """`command`, as the first line of a file of JSON lines. Raises MisuseError without one."""
        command = self.command()
        if command is not None and out is None:
            raise MisuseError(
                f"{self.words()[0]} goes into a file of --out; where a recorder makes the log, give"
                f" it to `{command_line('record', 'LOG')}`"
            )
        return command

    def words(self) -> list[str]:
        """The options as they were typed."""
        preset = [] if self.preset is None else ["--preset", self.preset]
        return [*preset, *(word for text in self.set_ or () for word in ("--set", text))]


def _assigned(settings: Settings, assignments: Sequence[str]) -> Settings:
    """Changed settings, with the SHA-256 of a text encoder as `edit use-settings` records it."""
    changed = settings.with_assignments(assignments)
    if changed.text_encoder is None:
        return changed
    # Imported here: it takes long, and few logs begin with a text encoder.
    from projections.surfaces.text_encoders import identified

    return identified(changed)


def _command(assignments: Sequence[str], reason: str) -> UseSettings:
    document = _assigned(Settings(), assignments).model_dump(mode="json")
    return UseSettings(
        command_id=uuid.uuid4().hex, issued_by=user_at_host(), reason=reason, settings=document
    )


@dataclass(frozen=True)
class LogStart:
    """What an opened log begins with, and what to tell people of it.

    ``is_new`` if it has no events; ``command`` is then the one that it begins with, None if it says
    nothing. ``commands`` are those of a log with events, and ``known`` the settings that they say,
    None if they say none.
    """

    log: Path
    options: NewLogOptions
    is_new: bool
    is_ros: bool
    known: Settings | None = None
    command: UseSettings | None = None
    commands: tuple[RecordedCommand, ...] = ()
    drops: DropClasses | None = None
    dropped: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        log: Path,
        writer: LogWriter,
        options: NewLogOptions,
        *,
        is_ros: bool,
        drops: DropClasses | None = None,
    ) -> "LogStart":
        """The start of the log that ``writer`` has opened; ``is_ros`` if it gets input of ROS, and
        ``drops`` are classes that it is to drop. Raises MisuseError if settings are chosen and the
        log has others."""
        asked = frozenset(() if drops is None else drops.classes)
        if writer.next_offset > 0:
            with LogReader(log) as reader:
                dropped = dropped_classes(reader)
            commands = _known_commands(log, is_needed=bool(options.assignments))
            known = compile_corrections(commands).settings
            _check_same(log, known or Settings(), options)
            return cls(
                log,
                options,
                is_new=False,
                is_ros=is_ros,
                known=known,
                commands=tuple(commands),
                drops=None if asked <= dropped else drops,
                dropped=dropped | asked,
            )
        command = options.command()
        if command is None and is_ros:
            command = _command([f"preset={ROS_PRESET}"], _ROS_REASON)
        return cls(
            log,
            options,
            is_new=True,
            is_ros=is_ros,
            command=command,
            drops=drops,
            dropped=asked,
        )

    def dropper(self) -> ClassDropper[Any]:
        """What leaves out the classes that the log drops."""
        return ClassDropper(self.dropped, compile_corrections(self.commands).labels)

    def for_import(self) -> "LogCommands":
        """The same for an importer."""
        document = None if self.known is None else self.known.model_dump(mode="json")
        if self.command is not None:
            document = self.command.settings
        labels = compile_corrections(self.commands).labels
        given = [recorded.command for recorded in self.commands]
        dropped = self.drops, self.dropped
        from eventsrc.record.importers.known_log import LogCommands  # here: it loads all importers

        return LogCommands(self.command, document, labels, given, self._differs, *dropped)

    def _differs(self, here: Mapping[str, object] | None, there: Mapping[str, object]) -> str:
        """Why the settings of a source are not those of the log; empty if they are the same."""
        known = Settings() if here is None else Settings.from_document(here)
        source = Settings.from_document(there)
        changed = source.changed_from(known)
        if not changed:
            return ""
        differing = ", ".join(f"{name}={_shown(value)}" for name, value in changed.items())
        preset = next((p for p in PRESETS if known.with_assignments([f"preset={p}"]) == source), "")
        words = ["--preset", preset] if preset else []
        for name, value in () if preset else changed.items():
            words += ["--set", f"{name}={'' if value is None else value}"]
        edit = command_line("edit", self.log, *_change(words))
        return f"the source has {differing:.300}, this log has not; to change it: `{edit}`"

    def record(self, writer: LogWriter) -> None:
        """Append the command; it is durable when this returns."""
        if self.command is not None:
            writer.append(COMMAND_KEY, encode_command(self.command))
        if self.drops is not None:
            writer.append(DROP_KEY, self.drops.encode())
        writer.sync()
        self.say()

    @contextmanager
    def said_on_error(self, writer: LogWriter) -> Iterator[None]:
        """Print the line also if an error ends an import that has recorded the settings."""
        try:
            yield
        except MapfoldError:
            self.say_recorded(writer)
            raise

    def say_recorded(self, writer: LogWriter, *, as_source: bool = False) -> None:
        """`say`, of an import that did not end, if the log has got settings by it."""
        if as_source or (self.command is not None and writer.next_offset > 0):
            self.say(as_source=as_source)

    def say(self, *, as_source: bool = False) -> None:
        """Print one line on the settings of a new log, ``as_source`` if it took those of a source.
        Also where ROS goes into a log that says nothing. And one on the classes that it drops."""
        if self.dropped:
            named = ", ".join(sorted(self.dropped))
            say(visible(f"{self.log}: detections of {named} are not stored in this log"))
        if self.command is not None:
            named = " ".join(self.options.words()) or f"--preset {ROS_PRESET}, for input of ROS"
            say(visible(f"{self.log}: a new log with {named}, said at offset 0"))
        elif as_source:
            say(visible(f"{self.log}: a new log with the settings that its source begins with"))
        elif self.is_new or (self.is_ros and self.known is None):
            what = "a new log" if self.is_new else "a log"
            change = command_line("edit", self.log, *_change(["--preset", ROS_PRESET]))
            line = (
                f"{self.log}: {what} of --preset classic; with --preset {ROS_PRESET} places are"
                f" rooms and objects have positions: `{change}`"
            )
            say(visible(line))


def say_camera(log: Path, start: Offset = FIRST_OFFSET) -> None:
    """Print a line where the positions of things depend on the camera and the log's first keyframe
    that shows something states none. Only if that is at ``start`` or later: the command that
    records it says so once. Damage is passed over."""
    settings = compile_corrections(_known_commands(log, is_needed=False)).settings
    if settings is None or not settings.wants_camera:
        return
    with LogReader(log) as reader:
        for event in reader.read(on_gap=lambda _: None):
            found = ingest(event.payload, max_bytes=sys.maxsize) if event.is_envelope else None
            if isinstance(found, Accepted) and found.envelope.detections:
                if event.offset >= start and found.envelope.camera is None:
                    say(camera_advice(f"by the keyframe at offset {event.offset}", settings, log))
                return


def _change(options: Sequence[str]) -> list[str]:
    return ["use-settings", *options, "--reason", "WHY"]


def _known_commands(log: Path, *, is_needed: bool) -> list[RecordedCommand]:
    """The commands of the log; none if, unless they are needed, they cannot be read."""
    try:
        with LogReader(log) as reader:
            return read_commands(reader)
    except (LogDamaged, FoldError):
        if is_needed:
            raise
        return []


def _check_same(log: Path, known: Settings, options: NewLogOptions) -> None:
    asked = _assigned(known, options.assignments)
    if asked == known:
        return
    here = known.by_name()
    differing = ", ".join(
        f"{name}={_shown(here.get(name))}, not {_shown(value)}"
        for name, value in asked.changed_from(known).items()
    )
    raise MisuseError(
        f"{log} has {differing}; a log's settings are said when it is made. To change them:"
        f" `{command_line('edit', log, *_change(options.words()))}`"
    )


def _shown(value: object) -> str:
    return "unset" if value is None else str(value)
