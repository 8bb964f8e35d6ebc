"""`mapfold ui --db`: how far the tails of a database are."""

from pathlib import Path

from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from tests.support.commands import Commands
from tests.support.logs import walk, write_log
from tests.support.ui_page import showing


def test_the_lag_of_a_database(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(10, seed=3))
    rebuild(log, one_database, Settings())
    write_log(log, walk(4, seed=3, first=10))
    mapfold = Commands.in_folder(tmp_path)
    with showing(mapfold, log, "--db", one_database.graph_url) as server, server.live() as heard:
        told = next(each for each in heard if each["sinks"])
        assert [(s["sink"], s["condition"], s["lag"]) for s in told["sinks"]] == [
            ("graph", "behind", 4),
            ("vectors", "behind", 4),
        ]
        assert told["database_problem"] is None
        assert "postgresql" not in str(told)


def test_a_database_that_is_away(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(3))
    mapfold = Commands.in_folder(tmp_path)
    url = "postgresql://user:secret@127.0.0.1:1/none"
    with showing(mapfold, log, "--db", url) as server, server.live() as heard:
        told = next(each for each in heard if each["sinks"] or each["database_problem"])
        assert "secret" not in str(told)
        assert "secret" not in server.text
        assert {s["condition"] for s in told["sinks"]} == {"unreachable"}
        assert server.api("digest")["at"] == 3  # the rest goes on
    assert "--db" in mapfold("ui", log, "--vector-db", url, code=2).err
