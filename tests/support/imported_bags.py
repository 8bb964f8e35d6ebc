"""A drive as bags, bags imported, and the envelopes in a log."""

import json
from pathlib import Path
from typing import Any

from eventsrc.log import LogWriter
from eventsrc.record.importers import BagOptions, ImportReport, import_files
from tests.support.fixtures_log import read_log
from tests.support.ros_bags import Drive

DRIVE = Drive(40)


def imported(log: Path, *names: Path, **options: Any) -> ImportReport:
    """Import into a log."""
    with LogWriter(log) as writer:
        return import_files(writer, [*map(str, names)], bags=BagOptions(**options))


def envelopes(log: Path) -> list[Any]:
    """The JSON of a log's envelopes."""
    return [json.loads(e.payload) for e in read_log(log) if not e.key.startswith("mapfold/")]
