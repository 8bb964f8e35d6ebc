"""``--preset`` and the warning that names it."""

from pathlib import Path

import pytest

from projections.fold.settings import PRESETS, Settings
from tests.docs.commands_page import commands
from tests.support.commands import Commands
from tests.support.envelopes import envelope
from tests.support.logs import write_log


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A corridor of 30 m, which the preset page makes one place."""
    return write_log(tmp_path / "log", [envelope(k, 0.5 * k, 0.0) for k in range(60)])


def test_every_command_with_settings_takes_a_preset() -> None:
    having = {}
    for name, command in commands():
        options = {option for p in command.params for option in p.opts}
        if "--set" in options:
            having[name] = "--preset" in options
        else:
            assert "--preset" not in options, name
    assert len(having) > 20
    assert all(having.values()), [name for name, has in having.items() if not has]


def test_presets_are_settings() -> None:
    assert Settings().with_assignments(PRESETS["page"]) == Settings()
    assert Settings().with_assignments(PRESETS["rooms"]) == Settings(places="rooms")
    other = Settings(places="rooms", eps_m=0.5, min_samples=9, fusion="evidence")
    assert other.with_assignments(PRESETS["page"]) == Settings(fusion="evidence")


def test_a_preset_is_overridden_by_set_and_changes_what_the_log_says(
    mapfold: Commands, log: Path
) -> None:
    def settings(*options: str) -> Settings:
        found = mapfold("state", log, "--json", *options).json["settings"]
        return Settings.model_validate(found)

    rooms = Settings(places="rooms")
    assert settings("--preset", "rooms") == rooms
    for order in (
        ("--preset", "rooms", "--set", "places=page"),
        ("--set", "places=page", "--preset", "rooms"),
    ):
        assert settings(*order) == Settings()
    changed = settings("--preset", "rooms", "--set", "rooms.drive_m=2.5", "--set", "eps_m=1.0")
    assert (changed.rooms.drive_m, changed.eps_m, changed.places) == (2.5, 1.0, "rooms")
    mapfold("edit", log, "use-settings", "--preset", "rooms", "--reason", "these are rooms")
    assert settings() == rooms
    assert settings("--preset", "page") == Settings()
    said = mapfold("state", log, "--preset", "house", code=2).err
    assert "'house' is not one of 'page', 'rooms'" in said


def test_a_preset_is_an_alternative_of_whatif(mapfold: Commands, log: Path) -> None:
    table = mapfold("whatif", log, "--preset", "rooms").out
    assert "places=rooms" in table


@pytest.mark.slow
def test_state_and_replay_warn_and_name_the_preset(log: Path, pg_url: str) -> None:
    mapfold = Commands.in_folder(log.parent, MAPFOLD_DB=pg_url)
    told = (
        "all 60 keyframes with a pose are in one place; if that is more than one room,"
        " --preset rooms tells them apart\n"
    )
    assert mapfold("state", log).err.endswith(told)
    assert mapfold("state", log, "--json").err.endswith(told)
    assert told not in mapfold("state", log, "--digest").err
    assert mapfold("replay", log).err.endswith(told)
    for command in ("state", "replay"):
        assert "one place" not in mapfold(command, log, "--preset", "rooms").err
        noisy = mapfold(command, log, "--set", "eps_m=0.1")
        assert "60 of 60 keyframes with a pose are in no place; --preset rooms" in noisy.err
    assert mapfold("state", log, "--preset", "rooms", "--json").json["counts"]["noise"] == 0
