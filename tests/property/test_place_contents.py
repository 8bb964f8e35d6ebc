"""What is in a place is counted as a recount does, live and in past maps."""

import tempfile
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import Offset
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.map.view import MapView
from tests.property.test_floors import buildings
from tests.support.evidence_drives import drives
from tests.support.folds import Folded
from tests.support.logs import write_log
from tests.support.rows import recounted_contents


def check(view: MapView) -> None:
    for place in view.places:
        weights = {name: n for name, n in view.contents.of(place).items() if n}
        assert weights == recounted_contents(view, place)


@given(building=buildings())
def test_contents_under_the_page_rule(
    building: tuple[dict[str, Any], list[dict[str, Any]]],
) -> None:
    raw, documents = building
    check_all(Settings(**raw), documents)


@given(documents=drives(), places=st.sampled_from(["page", "rooms"]))
def test_contents_under_fusion_by_evidence(documents: list[dict[str, Any]], places: Any) -> None:
    check_all(Settings(fusion="evidence", eps_m=1.0, places=places), documents)


def check_all(settings: Settings, documents: list[dict[str, Any]]) -> None:
    folded = Folded.start(settings)
    for document in documents:
        folded.extend([document])
        check(folded.view)
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        with LogTimeline(log, settings) as timeline:
            for end in {0, len(documents) // 2, len(documents)}:
                check(timeline.at(Offset(end)))
