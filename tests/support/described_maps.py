"""A small map in which every key of the service's answers is: names, floors, types, estimates."""

import json
from pathlib import Path
from typing import Any

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from tests.support.commands_in_logs import append_command, name_place
from tests.support.logs import write_log

SAMPLE = Path(__file__).parents[2] / "logs" / "sample"
SETTINGS = Settings(fusion="evidence")
KEYFRAMES = 60
RUN = "sim-7-a"
MODEL = "mapfold-simulated-512"


def documents(count: int = KEYFRAMES) -> list[dict[str, Any]]:
    """The first keyframes of the sample log, on a floor with a name."""
    with LogReader(SAMPLE) as reader:
        found = [json.loads(event.payload) for event in reader.read(0, count)]
    return [{**document, "floor": "ground"} for document in found]


def build(folder: Path, targets: Targets) -> Path:
    """The log of `documents`, with a named place, projected; the log's path."""
    log = write_log(folder / "log", documents())
    append_command(log, name_place(1, "bath", RUN))
    rebuild(log, targets, SETTINGS)
    return log
