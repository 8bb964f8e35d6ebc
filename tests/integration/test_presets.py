"""``--preset`` and the warning that names it."""

from pathlib import Path

import pytest
from mapfold import Timeline, fold

from projections.fold.map_errors import SettingsError
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings
from tests.docs.commands_page import commands
from tests.support.commands import Commands
from tests.support.envelopes import envelope
from tests.support.logs import write_log


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A corridor of 30 m, which the preset classic makes one place."""
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
    assert list(PRESETS) == ["classic", "rooms", "full"]
    assert Settings().with_assignments(["preset=classic"]) == Settings()
    assert Settings().with_assignments(["preset=rooms"]) == Settings(places="rooms")
    full = Settings(places="rooms", fusion="evidence")
    assert Settings().with_assignments(["preset=full"]) == full
    assert Settings().with_assignments(["preset=full", "fusion=page"]) == Settings(places="rooms")
    assert full.with_assignments(["preset=rooms"]) == Settings(places="rooms")
    other = Settings(places="rooms", eps_m=0.5, fusion="evidence", fusion_similarity=0.9)
    for name in ("classic", "page"):
        assert other.with_assignments([f"preset={name}"]) == Settings()
    with pytest.raises(SettingsError, match=r"^--try preset=house: no preset 'house'; there are c"):
        full.with_assignments(["preset=house"], "--try")


def test_python_takes_a_preset(log: Path) -> None:
    full = Settings(places="rooms", fusion="evidence")
    assert fold(log, preset="full").view.settings == full
    assert fold(log, settings={"eps_m": 0.5}, preset="rooms").view.settings == Settings(
        places="rooms", eps_m=0.5
    )
    with Timeline(log, preset="full", cache=False) as timeline:
        assert timeline.at().view.settings == full
    with pytest.raises(SettingsError, match="no preset 'house'; there are classic, rooms, full"):
        fold(log, preset="house")


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
    assert settings("--preset", "page") == settings("--preset", "classic") == Settings()
    assert settings("--set", "preset=full") == settings("--preset", "full")
    said = mapfold("state", log, "--preset", "house", code=2).err
    assert "--preset: no preset 'house'; there are classic, rooms, full" in said


def test_a_preset_is_an_alternative_of_whatif(mapfold: Commands, log: Path) -> None:
    table = mapfold("whatif", log, "--preset", "rooms").out
    assert "places=rooms" in table


@pytest.mark.slow
def test_state_and_replay_warn_and_name_the_preset(log: Path, pg_url: str) -> None:
    mapfold = Commands.in_folder(log.parent, MAPFOLD_DB=pg_url)
    told = (
        "all 60 keyframes with a pose are in one place; if that is more than one room,"
        " --preset full tells them apart\n"
    )
    assert mapfold("state", log).err.endswith(told)
    assert mapfold("state", log, "--json").err.endswith(told)
    assert told not in mapfold("state", log, "--digest").err
    assert mapfold("replay", log).err.endswith(told)
    for command in ("state", "replay"):
        assert "one place" not in mapfold(command, log, "--preset", "rooms").err
        noisy = mapfold(command, log, "--set", "eps_m=0.1")
        assert "60 of 60 keyframes with a pose are in no place; --preset full" in noisy.err
    assert mapfold("state", log, "--preset", "rooms", "--json").json["counts"]["noise"] == 0
