"""The comparison of calibrated constants with the priors: the settings it makes and its table."""

from pathlib import Path

import pytest

from eventsrc.envelope.ingest import Accepted, ingest_all
from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.localize.calibrate.rounds import calibrate
from scripts.programs.bench.truth.calibrating import calibrated_settings, calibration_table
from scripts.programs.bench.truth.scoring import ObjectScores
from scripts.programs.bench.truth.tables import Row
from tests.support.envelopes import payload
from tests.support.logs import write_log
from tests.support.seen_rooms import drive


def _scores(v: float, *errors: float) -> ObjectScores:
    return ObjectScores(10, 10, v, v, errors, len(errors))


def _row(name: str, before: ObjectScores, after: ObjectScores | None) -> Row:
    return Row(name, 100, before, before, 1.0, 2.0, calibrated=after, calibrated_s=0.5)


@pytest.mark.slow
def test_envelopes_are_calibrated_as_their_log_is(tmp_path: Path) -> None:
    documents = drive(4, "run-a", 60)
    events = [each for each in ingest_all([*map(payload, documents)]) if isinstance(each, Accepted)]
    settings = Settings(fusion="evidence", eps_m=0.9)
    found, seconds = calibrated_settings(events, settings, ask=True)
    with LogReader(write_log(tmp_path / "log", documents)) as reader:
        assert found == calibrate(reader, settings).calibrated
    assert found != settings
    assert seconds > 0.0


def test_the_worst_comes_last_and_robots_have_a_verdict() -> None:
    rows = [
        _row("rover hall", _scores(0.90, 0.2), _scores(0.95, 0.3)),
        _row("rover flat", _scores(0.90, 0.2), _scores(0.92, 0.3)),
        _row("scout hall", _scores(0.99, 0.2), _scores(0.97, 0.1)),
        _row("tripod hall", _scores(0.99, 0.2), _scores(0.985, 0.3)),
        _row("house-a", _scores(0.50), _scores(0.51)),
        _row("not tried", _scores(0.10), None),
    ]
    lines = calibration_table(rows).splitlines()
    names = [line[:26].strip() for line in lines[1:]]
    assert names[:5] == ["rover hall", "rover flat", "house-a", "tripod hall", "scout hall"]
    assert names[5:] == ["mean", "rover", "scout", "tripod"]
    assert lines[1].split()[2:] == [
        "0.900", "0.950", "+0.050", "0.200", "0.300", "1.00", "1.00", "1.00", "1.00", "0.5",
    ]  # fmt: skip
    assert [line.split()[-1] for line in lines[-3:]] == ["+", "+!", "-"]


def test_the_mean_is_over_buildings_without_the_house() -> None:
    rows = [
        _row("rover hall", _scores(0.8, 0.1), _scores(0.9, 0.2)),
        _row("house-a", _scores(0.2), _scores(0.2)),
    ]
    mean = next(line for line in calibration_table(rows).splitlines() if line.startswith("mean"))
    assert [float(value) for value in mean.split()[1:3]] == pytest.approx([0.8, 0.9])
