"""Notes of `mapfold log cat` and `state`: events of other times inside a range between times, and
keys without events."""

import pytest

from eventsrc.log import LogWriter
from projections.surfaces.cli.event_text import iso_time
from tests.support.commands import Commands
from tests.support.fixtures_log import KEY, envelope

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    """Commands beside the log L: run new at seconds 100 to 104, then run old at seconds 0 to 4,
    with a loss in between; and the empty log E."""
    folder = tmp_path_factory.mktemp("sessions")
    with LogWriter(folder / "L") as writer:
        for k in range(5):
            writer.append(KEY, envelope(k, "new"), stamp_ns=(100 + k) * SECOND)
        writer.append("mapfold/loss", b'{"publisher": "new", "count": 1, "cause": "queue_full"}')
        for k in range(5):
            writer.append(KEY, envelope(k, "old"), stamp_ns=k * SECOND)
    with LogWriter(folder / "E"):
        pass
    return Commands.in_folder(folder)


def at(second: int) -> str:
    return iso_time(second * SECOND)


def test_events_of_other_times_are_counted(run: Commands) -> None:
    said = run("log", "cat", "L", "--from", at(1), "--to", at(2))
    assert len(said.out.splitlines()) == 9
    (line,) = said.err.splitlines()
    assert line.startswith(
        f"L: 6 events of these are stamped before {at(1)} or after {at(2)}: stamps run backwards"
    )
    assert "5 events of these are stamped before" in run("log", "cat", "L", "--from", at(100)).err


def test_exact_ranges_get_no_note(run: Commands) -> None:
    for bounds in (("--to", "new:3"), ("--from", "old:2"), ("--from", "3", "--to", "7"), ()):
        assert run("log", "cat", "L", *bounds).err == ""
    assert run("log", "cat", "L", "--to", at(104), "--key", "mapfold/loss").err == ""


def test_a_map_at_a_time_reports_later_events_in_it(run: Commands) -> None:
    said = run("state", "L", "--at", at(2), "--digest")
    (line,) = said.err.splitlines()
    assert line.startswith(f"L: of the 9 events up to {at(2)}, 5 are stamped later: stamps run")
    assert run("state", "L", "--at", "old:2", "--digest").out == said.out
    for command in (
        ("diff", "L", "0"),
        ("bisect", "L", "place_count > 9", "--to"),
        ("whatif", "L", "--set", "eps_m=1.0", "--at"),
        ("draw", "L", "--out", "map.svg", "--at"),
        ("evaluate", "--map", "L", "--at"),
    ):
        assert "5 are stamped later" in run(*command, at(2)).err


def test_an_unknown_key_is_reported_with_the_known_ones(run: Commands) -> None:
    said = run("log", "cat", "L", "--key", "nokey", "--key", KEY)
    assert len(said.out.splitlines()) == 10
    assert said.err == f"L: no event has the key 'nokey'; there are mapfold/loss, {KEY}\n"
    assert run("log", "cat", "E", "--key", "k").err.endswith(
        "there are none, as the log is empty\n"
    )
    assert run("log", "cat", "L", "--key", "mapfold/loss", "--from", "7").err == ""
