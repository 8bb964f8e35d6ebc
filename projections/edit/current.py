"""The current map of a log under its corrections, and look-up of user input in it."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, DetId, KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import Event, LogReader
from projections.fold.corrections import Corrections, Keyframe, RecordedCommand, compile_corrections
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.objects import object_id
from projections.fold.settings import Settings
from projections.map.naming import NoSuchThing, ShortIds, Thing, thing_called, things_of
from projections.map.parsing import read_commands
from projections.map.records import KeyframeRecord, ObjectRecord, ObservationRecord
from projections.map.view import MapView
from projections.store.history_recorder import HistoryRecorder, map_after
from projections.store.history_records import Merge
from projections.store.timeline_cache import TimelineCache

SettingsOf = Callable[[Corrections], Settings]
"""The settings of the map, given the log's corrections."""


class MapToEdit:
    """A log, the commands in it, and the map that it is folded to under ``settings_of`` these.

    With ``until`` it is the log as of its first ``until`` events. ``note`` is called with a
    message for each part of a kept history that could not be used. ``commands`` are those before
    ``until`` and ``corrections`` what they compile to, where the caller has them.
    """

    def __init__(
        self,
        reader: LogReader,
        settings_of: SettingsOf,
        *,
        until: Offset | None = None,
        commands: Sequence[RecordedCommand] | None = None,
        corrections: Corrections | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.reader = reader
        self.settings_of = settings_of
        self.end = reader.next_offset if until is None else until
        self.commands = read_commands(reader, self.end) if commands is None else commands
        if corrections is None:
            corrections = compile_corrections(self.commands)
        self.corrections = corrections
        self.settings = settings_of(self.corrections)
        self.note = note
        self._view: MapView | None = None
        self._map_of: Callable[[], MapView] = lambda: self.fold(corrections, self.settings)

    @property
    def known_at(self) -> Offset:
        """The offset after the last command; 0 without commands."""
        return Offset(self.commands[-1].offset + 1) if self.commands else FIRST_OFFSET

    def command_events(self) -> Iterator[Event]:
        """The events of the commands, in order."""
        return self.reader.read(FIRST_OFFSET, self.end, keys={COMMAND_KEY})

    def find_command(self, command_id: str) -> RecordedCommand | None:
        """The command with this id, whether undone or not."""
        return next((c for c in self.commands if c.command.command_id == command_id), None)

    def fold(self, corrections: Corrections, settings: Settings) -> MapView:
        """The map under other corrections or settings."""
        return map_after(self.reader, settings, self.end, corrections=corrections, note=self.note)

    @property
    def view(self) -> MapView:
        """The map; folded at the first use."""
        if self._view is None:
            self._view = self.another_view()
        return self._view

    def another_view(self) -> MapView:
        """The map once more, for the caller to change."""
        return self._map_of()

    def use_maps(self, map_of: Callable[[], MapView]) -> None:
        """Take the map from ``map_of`` instead of folding it; each call gives another one."""
        self._map_of = map_of

    def set_view(self, view: MapView) -> None:
        """Use ``view`` as the map instead of folding it."""
        self._view = view

    @cached_property
    def merges(self) -> list[Merge]:
        """Every merge of places, in order."""
        cache = TimelineCache(self.reader, self.settings, self.corrections, self.note)
        recorder = HistoryRecorder(self.reader, self.settings, self.corrections, cache, None)
        merges = recorder.history(self.end).merges
        return [merge for merge in merges if merge.cause.offset < self.end]

    @cached_property
    def keyframes(self) -> dict[Keyframe, KeyframeRecord]:
        """The keyframes of the map."""
        return {Keyframe(k.run_id, k.keyframe_id): k for k in self.view.keyframes}

    @cached_property
    def observations(self) -> dict[DetId, ObservationRecord]:
        """The observations of the map."""
        return {o.det_id: o for o in self.view.observations}

    @cached_property
    def _short_ids(self) -> ShortIds:
        return ShortIds.of(things_of(self.view))

    def shortened(self, text: str) -> str:
        """A text with short ids, once the map is folded."""
        return text if self._view is None else self._short_ids.text(text)

    def run(self, run_id: str) -> list[KeyframeRecord]:
        """The keyframes of a run. Raises NoSuchThing with the runs there are."""
        view = self.view
        number = next((r.ordinal for r in view.runs if r.run_id == run_id), None)
        if number is None:
            raise NoSuchThing("run", run_id, (r.run_id for r in view.runs))
        return [k for k in view.keyframes if k.run == number]

    def place_of(self, keyframe: Keyframe) -> PlaceOrdinal | None:
        """The place that a keyframe is in now; None for none, or if it is not in the map."""
        record = self.keyframes.get(keyframe)
        return None if record is None else record.place

    def founder(self, place: PlaceOrdinal) -> Keyframe:
        """The keyframe that founded a place."""
        record = self.view.keyframes[self.view.all_places[place].founder]
        return Keyframe(record.run_id, record.keyframe_id)

    def find_place(self, text: str) -> Keyframe:
        """The keyframe that stands for a place: of ``run:keyframe`` this keyframe, for the place
        that it is in; of what else may name a place, also an absorbed one, that which founded it.

        Raises NoSuchThing, SeveralThings, or MisuseError for a keyframe in no place.
        """
        view = self.view
        run_id, colon, number = text.rpartition(":")
        is_keyframe = bool(colon) and any(run.run_id == run_id for run in view.runs)
        keyframe = _keyframe(run_id, number) if is_keyframe else None
        if keyframe is None or keyframe not in self.keyframes:
            try:
                return self.founder(
                    PlaceOrdinal(thing_called(text, things_of(self.view), ("place",)).ordinal)
                )
            except NoSuchThing:
                if not is_keyframe:
                    raise
            names = (f"{run_id}:{k.keyframe_id}" for k in self.run(run_id))
            raise NoSuchThing("keyframe", text, names)
        if self.place_of(keyframe) is None:
            why = "has no pose" if self.keyframes[keyframe].pose is None else "is noise"
            raise MisuseError(
                f"keyframe {text} is in no place, because it {why}; name a place or a keyframe in "
                f"one (`{advised('state')}` lists the places)"
            )
        return keyframe

    def place_name(self, keyframe: Keyframe) -> str:
        """The id of the place that a keyframe is in now, or ``no place``."""
        return self.view.place_id(self.place_of(keyframe)) or "no place"

    def find_observation(self, text: str) -> ObservationRecord:
        """An observation by its det_id; of what names an object, also an absorbed one, the
        observation that founded it. Raises NoSuchThing, SeveralThings, or MisuseError for an
        observation without an object."""
        observation = self.observations.get(DetId(text))
        is_id = any(each.object_id == text for each in self.view.all_objects)
        if observation is None or is_id:
            found = self._object_called(text)
            founding = (o for o in self.view.observations if object_id(o.det_id) == found.id)
            return next(founding)
        if observation.object is None:
            raise MisuseError(
                f"observation {text!r} is of no object: it has no embedding or no pose; "
                "name an object, or an observation that is of one"
            )
        return observation

    def find_object(self, text: str) -> ObjectRecord:
        """The object that ``text`` names, for an absorbed one the object that it is part of now.
        Raises NoSuchThing and SeveralThings."""
        found = ObjectOrdinal(self._object_called(text).ordinal)
        return self.view.objects[self.view.object_survivors.find(found)]

    def _object_called(self, text: str) -> Thing:
        try:
            return thing_called(text, things_of(self.view), ("object",))
        except NoSuchThing:
            if text.startswith("obj-") or not self.observations:
                raise
            raise NoSuchThing("observation", text, self.observations) from None


_NUMBER = re.compile(r"-?[0-9]{1,19}")


def _keyframe(run_id: str, number: str) -> Keyframe | None:
    if _NUMBER.fullmatch(number) is None:
        return None
    return Keyframe(RunId(run_id), KeyframeId(int(number)))
