"""Settings of drives with fusion by evidence, and recounts of their maps."""

from collections import Counter
from typing import Any

from hypothesis import HealthCheck, settings

from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset
from projections.fold import deltas as d
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.map.view import MapView
from tests.support.folds import Folded, recounted_adjacency, recounted_places
from tests.support.thorough import examples

EVIDENCE = Settings(fusion="evidence", eps_m=1.0)
SLOW = settings(
    deadline=None,
    max_examples=examples(40),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def recounted_votes(view: MapView, deltas: list[d.Delta]) -> list[int | None]:
    """The place of each Object, from the keyframes that saw it since its last relocation."""
    votes: dict[int, list[int]] = {}
    for delta, following in zip(deltas, [*deltas, None][1:], strict=True):
        if isinstance(delta, d.ObjectSeen):
            keyframe = view.observations[delta.observation].keyframe
            votes.setdefault(delta.object, []).append(keyframe)
        elif isinstance(delta, d.ObjectsMerged):
            if isinstance(following, d.ObjectRelocated):
                votes[delta.survivor] = []
            votes[delta.survivor] += votes.pop(delta.absorbed)
    located: list[int | None] = []
    for ordinal in view.objects:
        cast = Counter(view.keyframes[keyframe].place for keyframe in votes[ordinal])
        del cast[None]
        located.append(min(cast, key=lambda p: (-cast[p], p or 0), default=None))
    return located


def check_recounts(folded: Folded, same: bool = False) -> None:
    """Check the numbers of each Object against a recount from its observations."""
    view, deltas = folded.view, [delta for each in folded.deltas for delta in each]
    seen_beside = {  # what a few pictures showed as two may still be one
        view.object_survivors.find(delta.survivor)
        for delta in deltas
        if isinstance(delta, d.ObjectsMerged)
        and delta.evidence
        and delta.evidence.pictures_with_both
    }
    assert view.adjacency == recounted_adjacency(view)
    assert [found.place for found in view.objects.values()] == recounted_votes(view, deltas)
    assert {
        p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()
    } == recounted_places(view)
    for found in view.objects.values():
        seen = [view.observations[number] for number in found.observations]
        keyframes = [view.keyframes[each.keyframe] for each in seen]
        assert found.observations == sorted(found.observations)
        assert all(each.object == found.ordinal for each in seen)
        assert found.obs_count == len(seen)
        poses = [k.pose for k in keyframes if k.pose is not None]
        assert found.sum_x_um == sum(pose.x_um for pose in poses)
        assert found.sum_y_um == sum(pose.y_um for pose in poses)
        times = [k.timestamp for k in keyframes]
        assert (found.first_seen, found.last_seen) == (min(times), max(times))
        votes = Counter(each.class_name for each in seen)
        assert votes[found.class_name] == max(votes.values())
        assert votes == view.class_counts(found)
        if not same and found.ordinal not in seen_beside:
            assert len({each.keyframe for each in seen}) == len(seen), "two of one picture"
        at = found.estimate
        assert at is not None
        assert at.spots >= 1
        assert at.var_xx_um2 > 0
        assert at.var_yy_um2 > 0
        assert at.var_xx_um2 * at.var_yy_um2 >= at.var_xy_um2**2


def compiled(*commands: Command) -> Corrections:
    """Corrections by these commands, recorded one after the other."""
    return compile_corrections(RecordedCommand(Offset(n), c) for n, c in enumerate(commands))


def det_ids(documents: list[dict[str, Any]]) -> list[str]:
    """Those that can be of an Object, each once."""
    named = (
        f"{e['run_id']}_kf{e['keyframe_id']}_d{i}"
        for e in documents
        for i, seen in enumerate(e["detections"])
        if e.get("map_x") is not None and seen.get("embedding") is not None
    )
    return list(dict.fromkeys(named))
