"""Random logs that grow: drives through rooms by several runs, out of order, twice and in conflict;
several spaces, floors, cameras, depths, maps, refusals, losses, verbatim and old messages,
vectors given later, and every kind of command."""

import hashlib
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from eventsrc.envelope import commands
from eventsrc.envelope.commands import Command, CorrectedPose, RigidTransform, encode_command
from eventsrc.envelope.model import DetId
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    EMBEDDINGS_KEY,
    LOSS_KEY,
    MAP_KEY,
    Loss,
    NewVectors,
)
from eventsrc.log import NEVER, LogWriter, NewEvent, seal
from eventsrc.record.append import append_payload
from tests.support.envelopes import MODEL, embedding, payload
from tests.support.evidence_drives import DIM, Room
from tests.support.logs import KEY, WEIRD, anchor, mixed_event
from tests.support.maps import drawn_map

_RUNS = ("run-a", "run-b", "run $$'c")
_NEW_SPACE = "another/space"
_SETTINGS: tuple[dict[str, object], ...] = (
    {"eps_m": 1.1},
    {"min_samples": 2},
    {"places": "rooms"},
    {"fusion": "evidence"},
    {"fusion": "evidence", "evidence": {"range_m": 2.5}, "camera": {"hfov_deg": 80.0}},
    {"embedding_model": MODEL},
    {"embedding_model": _NEW_SPACE},
)


class GrowingLog:
    """The log of ``seed``, of about ``count`` events. A shorter one has the same first events."""

    def __init__(self, path: Path, seed: int, count: int) -> None:
        self.path, self._count = path, count
        self._rng = random.Random(f"log {seed}")
        self._rooms = [Room(self._rng.randrange(10**6), 3) for _ in range(3)]
        self._floors = self._rng.random() < 0.3
        self._spaces = self._rng.random() < 0.3
        self._fault = self._rng.randrange(60) if self._rng.random() < 0.15 else None
        self._sent: list[dict[str, Any]] = []
        self._commands: list[str] = []
        self._options: dict[str, Any] = {"rotate_events": self._rng.choice((15, 40, 10_000))}
        self._chunk_bytes = self._rng.choice((2_000, seal.CHUNK_BYTES))

    def grow(self) -> Iterator[int]:
        """Write the log in steps; the number of events after each."""
        done = 0
        while done < self._count:
            size = min(self._rng.choice((1, 5, 15, 30)), self._count - done)
            with (
                patch.object(seal, "CHUNK_BYTES", self._chunk_bytes),
                LogWriter(self.path, fsync=NEVER, **self._options) as writer,
            ):
                for _ in range(size):
                    self._append(writer)
                    done += 1
                    if self._rng.random() < 0.1:
                        writer.sync()
                if self._rng.random() < 0.4:  # the reader finds it growing
                    writer.sync()
                    yield writer.next_offset
                    continue
            yield writer.next_offset

    def _append(self, writer: LogWriter) -> None:
        if self._fault == writer.next_offset:
            writer.append(self._rng.choice((KEY, MAP_KEY)), b'{"run_id": "broken"}')
        kind, number = self._rng.random(), writer.next_offset
        if kind < 0.72:
            append_payload(writer, KEY, payload(self._keyframe()), logged_ns=10**9 * number + 7)
        elif kind < 0.76:
            bad = (b"{", b"[1]", b'{"run_id": NaN}', b"\xff\x00", payload({"run_id": ""}))
            append_payload(writer, KEY, self._rng.choice(bad))
        elif kind < 0.78:
            gap = Loss(publisher="run-a", first=1, last=2, count=2, cause="keyframe_gap")
            writer.append(LOSS_KEY, gap.model_dump_json().encode())
        elif kind < 0.80:
            drawing = self._rng.choice(("##########. #........#. #........#.", "..# ### ..."))
            writer.append(MAP_KEY, drawn_map(drawing).encode())
        elif kind < 0.83:
            writer.append_all([mixed_event(4 * number + self._rng.randrange(3))])
        elif kind < 0.85:
            bare = [{"class_name": WEIRD[0], "confidence": 0.5, "bbox": [0.0, 0.0, 4.0, 4.0]}]
            writer.append_all([NewEvent("old/camera", payload(bare), number, number, 1)])
        elif kind < 0.87:
            self._give_vectors(writer)
        elif self._sent:
            self._command(writer, self._random_command())

    def _keyframe(self) -> dict[str, Any]:
        rng = self._rng
        if self._sent and rng.random() < 0.12:
            again = rng.choice(self._sent)  # twice, or in conflict
            return again if rng.random() < 0.6 else {**again, "map_x": rng.uniform(0, 20)}
        at = rng.randrange(len(self._rooms))
        number = max(0, len(self._sent) + rng.choice((0, 0, 0, 3, -4)))
        found = self._rooms[at].keyframe(number, rng.choice(_RUNS))
        if found.get("map_x") is not None:
            found["map_x"] += 7.0 * at if rng.random() > 0.1 else rng.uniform(0.0, 15.0)
        if self._floors:
            found["floor"] = rng.choice((0, "attic"))
        if rng.random() < 0.1:
            found["pose_covariance"] = [0.01, 0, 0, 0, 0.02, 0, 0, 0, 0.001]
        for seen in found["detections"]:
            if self._spaces and rng.random() < 0.3:
                seen |= _vector([rng.gauss(0, 1) for _ in range(3)])
            if rng.random() < 0.1:
                seen["det_id"] = f"det ' {rng.randrange(10**9)}"
        self._sent.append(found)
        return found

    def _det_ids(self) -> list[str]:
        return [
            seen.get("det_id", f"{sent['run_id']}_kf{sent['keyframe_id']}_d{index}")
            for sent in self._sent
            for index, seen in enumerate(sent["detections"])
        ]

    def _give_vectors(self, writer: LogWriter) -> None:
        """Vectors of another space for some detections, and the command that puts them in force."""
        det_ids = tuple(map(DetId, dict.fromkeys(self._det_ids())))[-8:]
        if not det_ids:
            return
        drawn = np.random.default_rng(self._rng.randrange(10**6))
        vectors = drawn.normal(size=(len(det_ids), DIM)).astype(np.float32)
        content = NewVectors(_NEW_SPACE, "0" * 64, det_ids, vectors).encode()
        first = writer.append(EMBEDDINGS_KEY, content)
        given = {"first": first, "end": first + 1, "detections": len(det_ids), "dim": DIM}
        sha256 = hashlib.sha256(content).hexdigest()
        self._command(
            writer, self._made(commands.Reembed, space=_NEW_SPACE, sha256=sha256, **given)
        )

    def _command(self, writer: LogWriter, given: Command) -> None:
        self._commands.append(given.command_id)
        stamp_ns = 1_774_400_000_000_000_000
        writer.append(COMMAND_KEY, encode_command(given), stamp_ns=stamp_ns)

    def _made(self, kind: type[Any], **values: Any) -> Any:
        return kind(command_id=f"c{len(self._commands)}", issued_by="ann@lab", **values)

    def _random_command(self) -> Command:
        rng, made = self._rng, self._made
        det_ids = self._det_ids() or ["none"]
        keyframes = [(sent["run_id"], sent["keyframe_id"]) for sent in self._sent]
        one, two, three = (rng.choice(keyframes) for _ in range(3))
        places = tuple(anchor(keyframe, run) for run, keyframe in (one, two, three))
        pair = rng.choice(det_ids), rng.choice(det_ids)
        pose = CorrectedPose(keyframe_id=one[1], x=rng.uniform(0, 15), y=1.0, yaw=0.3)
        moved = RigidTransform.of(rng.choice((0.7, -2.1)), 0.0, 0.5)
        kinds: list[Callable[[], Command]] = [
            lambda: made(commands.NamePlace, place=places[0], name=rng.choice(WEIRD[:3])),
            lambda: made(commands.KeepApart, places=places[:2]),
            lambda: made(commands.Join, places=places[:2]),
            lambda: made(commands.UndoMerge, merge_offset=0, places=places),
            lambda: made(commands.SameObject, det_ids=pair),
            lambda: made(commands.DifferentObjects, det_ids=pair),
            lambda: made(commands.DropObject, det_ids=pair),
            lambda: made(commands.DropDetection, det_ids=pair[:1]),
            lambda: made(commands.ForgetKeyframes, run_id=one[0], first=one[1], last=one[1] + 3),
            lambda: made(commands.CorrectPoses, run_id=one[0], poses=(pose,)),
            lambda: made(commands.CorrectPoses, run_id=one[0], transform=moved),
            lambda: made(commands.UseSettings, settings=dict(rng.choice(_SETTINGS))),
        ]
        if rng.random() < 0.1:
            return made(commands.ForgetRun, run_id=one[0])
        if self._commands and rng.random() < 0.25:
            return made(commands.Undo, undone=rng.choice(self._commands))
        return rng.choice(kinds)()


def _vector(values: list[float]) -> dict[str, Any]:
    return embedding(values) | {"embedding_model": "of three numbers"}
