"""What a replay left out of the map: how much, why, and what to do about it."""

from collections.abc import Iterator
from pathlib import Path

from eventsrc.words import counted
from projections.runner import ForeignEmbedding, RebuildReport
from projections.settings import Settings
from projections.sinks._advice import command


def left_out(log: Path, settings: Settings, report: RebuildReport) -> str | None:
    """One line, None when everything is in."""
    told = "; ".join(_told(log, settings, report))
    return f"left out: {told}" if told else None


def _told(log: Path, settings: Settings, report: RebuildReport) -> Iterator[str]:
    counts = report.counts
    if counts["duplicates"]:
        yield f"{counted(counts['duplicates'], 'keyframe')} that came twice"
    if counts["conflicts"]:
        yield (
            f"{counted(counts['conflicts'], 'keyframe')} that came again with other content (the"
            " first one stands; give every run a run_id of its own)"
        )
    if counts["det_ids_reused"]:
        yield (
            f"{counted(counts['det_ids_reused'], 'observation')} with the det_id of an earlier"
            " keyframe (leave det_id away, or make it unique)"
        )
    if report.foreign is not None:
        yield _foreign(log, settings, report, report.foreign)


def _foreign(log: Path, settings: Settings, report: RebuildReport, first: ForeignEmbedding) -> str:
    many = counted(report.counts["foreign_embeddings"], "embedding")
    chosen = settings.embedding_model is not None or settings.embedding_dim is not None
    why = "as the settings say" if chosen else "as the log's first one is"
    if first.map_dim is None:
        wanted = _space(settings.embedding_model or "any model", settings.embedding_dim)
    else:
        wanted = _space(first.map_model or "an unnamed model", first.map_dim)
    came = _space(first.model or "an unnamed model", first.dim)
    instead = command("replay", log, _of_space(settings, first))
    return (
        f"{many} of another space: the map's are of {wanted}, {why}, but that of {first.det_id} at"
        f" offset {first.offset:,} is of {came}; to map that space instead run: {instead}"
    )


def _space(model: str, dim: int | None) -> str:
    return model if dim is None else f"{model} with {counted(dim, 'dimension')}"


def _of_space(settings: Settings, first: ForeignEmbedding) -> Settings:
    update: dict[str, str | int | None] = {"embedding_dim": first.dim}
    if first.model != first.map_model or first.map_dim is None:
        update["embedding_model"] = first.model
    return settings.model_copy(update=update)
