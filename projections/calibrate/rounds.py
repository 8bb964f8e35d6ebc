"""A calibration: fold the log by evidence, read the constants, fold with them, read again.

The first fold uses the constants that the settings have. Both readings are drawn towards the
priors, never towards constants read before: what a map shows counts once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.corrections import NO_CORRECTIONS, Corrections
from projections.deltas import KeyframeOrdinal
from projections.evidence import EvidenceConstants
from projections.model.fold import READ_AHEAD, fold_parsed, gc_paused, parse_events
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Camera, Settings

from .reading import Round, read
from .sightings import Row, Sightings, sightings_of

ROUNDS = 2


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a log shows. ``settings`` are those that it was calibrated under; `calibrated` are the
    same with its constants. Counts are of the last fold: keyframes with a pose, observations that
    were fused, Objects, runs. ``unboxed`` observations have an empty box; ``beyond`` boxes reach
    beyond the picture."""

    settings: Settings
    last: Round
    runs: int
    keyframes: int
    observations: int
    objects: int
    unboxed: int
    beyond: int

    @property
    def calibrated(self) -> Settings:
        """The settings with the constants that were read."""
        return self.settings.model_copy(update={"evidence": self.last.constants})


Progress = Callable[[int, int], None]
"""Told how many events of how many are folded, over all rounds."""


def calibrate(
    reader: LogReader,
    settings: Settings,
    corrections: Corrections = NO_CORRECTIONS,
    until: Offset | None = None,
    progress: Progress = lambda _done, _total: None,
) -> Calibration:
    """Calibrate the map of a log's first ``until`` events, all of them for None; folded by
    evidence whatever rule the settings name. Raises FoldError, LogDamaged."""
    end = reader.next_offset if until is None else min(until, reader.next_offset)
    constants, prior = settings.evidence, EvidenceConstants()
    for number in range(ROUNDS):
        used = settings.model_copy(update={"fusion": "evidence", "evidence": constants})

        def folded(done: int, before: int = number * end) -> None:
            progress(before + done, ROUNDS * end)

        view, cameras = _fold(reader, used, corrections, end, folded)
        seen = _sightings(view, cameras, settings.camera)
        last = read(seen, constants, prior)
        constants = last.constants
    return Calibration(
        settings,
        last,
        runs=len(view.runs),
        keyframes=sum(keyframe.pose is not None for keyframe in view.keyframes),
        observations=len(seen),
        objects=len(view.objects),
        unboxed=int((~seen.boxed).sum()),
        beyond=seen.beyond,
    )


def _fold(
    reader: LogReader,
    settings: Settings,
    corrections: Corrections,
    end: Offset,
    folded: Callable[[int], None],
) -> tuple[MapView, dict[KeyframeOrdinal, Camera]]:
    """The map, and the cameras of the keyframes whose envelope states one."""
    semantic_map = SemanticMap(settings, corrections=corrections)
    view = MapView(settings, corrections=corrections)
    cameras: dict[KeyframeOrdinal, Camera] = {}
    coming = iter(reader.read(FIRST_OFFSET, end))
    with gc_paused():
        while chunk := list(islice(coming, READ_AHEAD)):
            for event in parse_events(chunk):
                deltas = fold_parsed(event, semantic_map)
                view.apply_event(event.offset, deltas)
            folded(view.next_offset)
    return view, cameras


def _sightings(view: MapView, cameras: dict[KeyframeOrdinal, Camera], default: Camera) -> Sightings:
    return sightings_of(_rows(view, cameras, default))


def _rows(view: MapView, cameras: dict[KeyframeOrdinal, Camera], default: Camera) -> Iterator[Row]:
    for observation in view.observations:
        keyframe = view.keyframes[observation.keyframe]
        if observation.object is None or keyframe.pose is None or observation.embedding is None:
            continue
        yield Row(
            picture=keyframe.ordinal,
            run=keyframe.run,
            pose=keyframe.pose,
            camera=cameras.get(keyframe.ordinal, default),
            class_name=observation.class_name,
            bbox=observation.bbox,
            look=observation.embedding,
            thing=observation.object,
        )
