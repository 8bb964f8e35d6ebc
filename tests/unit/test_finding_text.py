"""The lines of `mapfold log verify`."""

import pytest

from eventsrc.envelope.model import Offset
from eventsrc.log import Finding
from projections.surfaces.cli.log import finding_text


@pytest.mark.parametrize(("last", "where"), [(7, "offset 7"), (9, "offsets 7 to 9")])
def test_a_finding_names_its_offsets(last: int, where: str) -> None:
    finding = Finding("time", "stamps run backwards", None, Offset(7), Offset(last))
    assert finding_text(finding) == f"time      {where}: stamps run backwards"
