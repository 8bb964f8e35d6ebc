"""Names of places in a fold that goes on from a kept state, as a tail's does."""

from eventsrc.envelope.commands import Anchor, NamePlace
from eventsrc.envelope.model import Offset
from projections.fold.corrections import RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from tests.support.envelopes import envelope
from tests.support.folds import Folded, resumed


def test_a_resumed_fold_names_a_place_that_a_later_merge_joins() -> None:
    names = [
        NamePlace(
            command_id=f"c{k}",
            issued_by="ann@lab",
            place=Anchor(run_id="a", keyframe_id=k),
            name=name,
        )
        for k, name in ((0, "hall"), (3, "study"))
    ]
    corrections = compile_corrections(
        RecordedCommand(Offset(number), command) for number, command in enumerate(names)
    )
    documents = [envelope(k, x, 0.0, run_id="a") for k, x in enumerate((0.0, 2.0, 1.0, 1.5))]
    settings = Settings(eps_m=0.75, min_samples=1)
    whole = Folded.start(settings, corrections=corrections)
    whole.extend(documents)
    begun = Folded.start(settings, corrections=corrections)
    begun.extend(documents[:2])
    again = resumed(begun)
    assert again.map.names.given == begun.map.names.given != {}
    again.extend(documents[2:])
    assert map_digest(again.view) == map_digest(whole.view)
