"""A folder with the embedded server running, and a log of awkward names, for a module of tests."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.acceptance.awkward_run import awkward_payloads
from tests.support.commands import Commands
from tests.support.servers import furnish


@pytest.fixture(scope="module")
def mapfold(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    """The command, in a folder of its own, with its embedded server left running."""
    commands = Commands.in_folder(tmp_path_factory.mktemp("user"))
    furnish(commands.home)
    commands("db", "start")
    yield commands
    commands("db", "stop")


@pytest.fixture(scope="module")
def awkward_log(mapfold: Commands) -> Path:
    """A log of two runs whose names try to break out of every query language."""
    log = mapfold.folder / "awkward"
    mapfold("import", log, "-", stdin=b"\n".join(awkward_payloads()) + b"\n")
    return log
