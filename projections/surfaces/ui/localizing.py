"""Re-localisation in the map at W: the pose from which some crops are seen; and the crops of a
mapped keyframe as such a question.

The search needs the map with its embeddings, which histories do not have, so a question about
another W folds the log again. The last such map is kept if it is small.
"""

import math
import re
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any, Final

import numpy as np
import pybase64
from starlette.datastructures import QueryParams

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.forms import read_envelopes
from eventsrc.envelope.ingest import Rejected, Vector
from eventsrc.envelope.model import Offset
from eventsrc.log import Event
from eventsrc.log.seek import resolve
from projections.fold.corrections import map_fingerprint
from projections.fold.deltas import KeyframeOrdinal
from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import (
    ExactIndex,
    MapCandidates,
    Match,
    QuestionCrop,
    parse_question,
    rank,
)
from projections.localize.relocalize.layout import Hypotheses
from projections.map.parsing import read_corrections
from projections.store.columns import NONE
from projections.store.history_recorder import map_after

from .log_map import LogMap, Opened, PrefixReader
from .requests import AskedPoint, assignments_of, command_line, shell_line, text_of
from .search import keyframe_of

MOST_BYTES: Final = 1_000_000
_KEPT_OBSERVATIONS: Final = 20_000
"""Most observations of a map whose search matrix is kept: at 512 dimensions it takes 80 MB."""
_MOST_TOP: Final = 20
_MATCHES: Final = 8
_AS_NEAR_M: Final = 1.0
"""Keyframes this much farther from a point than the nearest count as near as that."""
_APART_M: Final = 1.5
_MOST_SPOTS: Final = 5
_LEAST_SHARE: Final = 0.02
"""Alternatives are this far apart, metres, at most so many, each of this share of the weight."""


class Localizer:
    """Answers questions; keeps the last map that it searched. Not for several threads at once."""

    def __init__(self, opened: Opened) -> None:
        self._opened = opened
        self._kept: tuple[object, ExactIndex] | None = None

    def answer(
        self, through: Offset, query: QueryParams, payload: bytes, go_on: Callable[[], None]
    ) -> dict[str, Any]:
        """Ranked places, a pose, all weighed poses (x, y, yaw, weight), and the matches of each
        crop."""
        started = perf_counter()
        question = parse_question(payload)
        crops = question.crops
        top = text_of(query, "top", "3")
        if not re.fullmatch("[0-9]{1,9}", top) or not 1 <= int(top) <= _MOST_TOP:
            raise QuestionError(f"top is {top[:40]!r}; give a number from 1 to {_MOST_TOP}")
        end, index = self._index(through, query, go_on)
        candidates = index.search(crops)
        found = rank(question, candidates, top=int(top))
        words = ["question.json", "--log", str(self._opened.log), "--as-of", str(end)]
        settings = self._opened.words(*assignments_of(query))
        return {
            "through": through,
            "at": end,
            "known_at": end,
            **found.document(),
            "poses": _poses(found.hypotheses),
            **_floors(found.hypotheses),
            "spots": _spots(found.hypotheses),
            "crops": [
                _crop(crop, matches, candidates)
                for crop, matches in zip(crops, candidates.matches, strict=True)
            ],
            "seconds": round(perf_counter() - started, 3),
            "command": shell_line("mapfold", "relocalize", *words, *settings),
        }

    def _index(
        self, through: Offset, query: QueryParams, go_on: Callable[[], None]
    ) -> tuple[Offset, ExactIndex]:
        """The map at W under the commands before it, to be searched."""
        with PrefixReader(self._opened.log, through, go_on) as reader:
            end = resolve(reader, text_of(query, "at", "end"))
            corrections = read_corrections(reader, end)
            settings = self._opened.settings(corrections)
            settings = settings.with_assignments(assignments_of(query), "set")
            key = reader.log_id, end, map_fingerprint(settings, corrections)
            if self._kept is not None and self._kept[0] == key:
                return end, self._kept[1]
            self._kept = None
            view = map_after(
                reader,
                settings,
                end,
                corrections=corrections,
                cache=self._opened.cache and not assignments_of(query),
                embeddings=True,
            )
        index = ExactIndex(view)
        if len(view.observations) <= _KEPT_OBSERVATIONS:
            self._kept = key, index
        return end, index


def _poses(found: Hypotheses | None) -> list[list[float]]:
    """x, y, yaw and weight of each, likeliest first."""
    if found is None:
        return []
    rows: list[list[float]] = np.column_stack((found.poses, found.weights)).tolist()
    return rows


def _spots(found: Hypotheses | None) -> list[dict[str, Any]]:
    """Where the robot may be, likeliest first: a pose with the weight of all about it, each of
    which counts for the first such pose only."""
    if found is None:
        return []
    spots = list[dict[str, Any]]()
    weights = found.weights.copy()
    floors = np.array([name or "" for name in found.floors])
    while len(spots) < _MOST_SPOTS and weights.any():
        best = int(weights.argmax())
        offsets = found.poses[:, :2] - found.poses[best, :2]
        about = (np.hypot(*offsets.T) <= _APART_M) & (floors == floors[best])
        x, y, _ = found.poses[best].tolist()
        spots.append(
            {"x": x, "y": y, "floor": found.floors[best], "share": float(weights[about].sum())}
        )
        weights[about] = 0.0
    spots.sort(key=lambda spot: -spot["share"])
    return [spot for spot in spots if spot["share"] >= _LEAST_SHARE]


def _floors(found: Hypotheses | None) -> dict[str, Any]:
    """The floor of each of the poses, where any has a name."""
    named = found is not None and any(name is not None for name in found.floors)
    return {"pose_floors": list(found.floors)} if found is not None and named else {}


def _crop(
    crop: QuestionCrop, matches: tuple[Match, ...], candidates: MapCandidates
) -> dict[str, Any]:
    return {
        "det_id": crop.det_id,
        "class_name": crop.class_name,
        "bbox": None if crop.bbox is None else list(crop.bbox),
        "matches": [_match(each, candidates) for each in matches[:_MATCHES]],
    }


def _match(match: Match, candidates: MapCandidates) -> dict[str, Any]:
    place = match.keyframe_place if match.object_place is None else match.object_place
    return {
        "det_id": match.det_id,
        "run_id": match.run_id,
        "similarity": match.similarity,
        "pose": None if match.pose is None else list(match.pose),
        "class_name": match.class_name,
        "object_id": match.object_id,
        "place_id": None if place is None else candidates.places[place].place_id,
    }


def question_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The crops of a mapped keyframe as a question, and its pose in the map, the ``truth``.

    The keyframe is that of ``number`` or ``keyframe``; with ``near`` the one that has crops nearest
    to a point of the ``floor``, of several one of the latest run; without any of them the one of
    the last run with most crops. ``ask_at`` is the W before its run began, if there was a place by
    then, else the end: ``whole`` says that it is the map which has these very crops.
    """
    asked = AskedPoint.of(shown, query)
    history = asked.known.history
    ordinal = _keyframe_to_ask(asked, query)
    keyframe = history.keyframes[ordinal]
    pose = keyframe.pose
    first = next(k.offset for k in history.keyframes if k.run == keyframe.run)
    event = next(shown.reader.read(keyframe.offset, Offset(keyframe.offset + 1)), None)
    if event is None:
        raise MapfoldError(f"the event at offset {keyframe.offset} cannot be read any more")
    crops = _crops_of(event)
    if not crops:
        raise QuestionError(
            f"keyframe {keyframe.run_id}:{keyframe.keyframe_id} has no detection, so nothing can be"
            " asked with it; pick another"
        )
    whole = all(place.formed.offset >= first for place in history.places)
    return {
        **asked.document(),
        "keyframe": f"{keyframe.run_id}/{keyframe.keyframe_id}",
        "number": ordinal,
        "offset": keyframe.offset,
        "ask_at": shown.through if whole else first,
        "whole": whole,
        "question": {"crops": crops},
        "truth": None if pose is None else [pose.x_m, pose.y_m, pose.yaw_rad],
        "command": command_line(
            shown.opened, "log", "cat", "--from", str(keyframe.offset), "--to",
            str(keyframe.offset + 1),
        ),
    }  # fmt: skip


def _keyframe_to_ask(asked: AskedPoint, query: QueryParams) -> KeyframeOrdinal:
    """The keyframe that `question_answer` is asked for, or that it picks."""
    history, near = asked.known.history, query.get("near")
    if near is None and (query.get("number") or query.get("keyframe")):
        return keyframe_of(history, query)
    observed = history.tables.integers("observation", "keyframe")
    counts = np.bincount(observed, minlength=len(history.keyframes))
    looks = observed[history.tables.integers("observation", "crc") != NONE]
    if len(looks):
        counts = np.bincount(looks, minlength=len(history.keyframes))
    posed = history.tables.column("keyframe", "pose") != 0
    usable = np.flatnonzero((counts > 0) & posed)
    if not len(usable):
        raise QuestionError("no keyframe with a pose has a detection, so nothing can be asked")
    runs = history.tables.integers("keyframe", "run")
    if near is None:
        last = usable[runs[usable] == runs[usable].max()]
        return KeyframeOrdinal(int(last[counts[last].argmax()]))
    x, y = _point(near)
    if floor := query.get("floor"):
        here = [each for each in usable.tolist() if history.keyframes[each].floor == floor]
        usable = np.array(here or usable, np.int64)
    at = [history.keyframes[each].pose for each in usable.tolist()]
    away = np.array([math.inf if p is None else math.hypot(p.x_m - x, p.y_m - y) for p in at])
    close = away <= away.min() + _AS_NEAR_M
    latest = close & (runs[usable] == runs[usable[close]].max())
    return KeyframeOrdinal(int(usable[np.where(latest, away, math.inf).argmin()]))


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise QuestionError(f"near is {text[:40]!r}; give it as X,Y in metres")
    return x, y


def _crops_of(event: Event) -> list[dict[str, Any]]:
    """The detections of an envelope that have an embedding, in the form of a question; where none
    has, all by their classes."""
    accepted = read_envelopes([event], max_bytes=sys.maxsize)[0]
    if isinstance(accepted, Rejected):
        return []
    rows = zip(accepted.det_ids, accepted.envelope.detections, accepted.vectors, strict=True)
    is_bare = all(vector is None for vector in accepted.vectors)
    return [
        {
            "det_id": det_id,
            "class": seen.class_name,
            "bbox": list(seen.bbox),
            **({} if vector is None else _look(vector, seen.embedding_model)),
        }
        for det_id, seen, vector in rows
        if is_bare or vector is not None
    ]


def _look(vector: Vector, model: str | None) -> dict[str, Any]:
    return {
        "embedding": pybase64.b64encode(vector.astype("<f4").tobytes()).decode(),
        "embedding_dim": len(vector),
        **({} if model is None else {"embedding_model": model}),
    }
