"""Which settings a command runs with: of a file, of the log, or the defaults, changed by --set."""

import json
from pathlib import Path

from eventsrc.envelope.commands import UseSettings
from eventsrc.envelope.model import Offset
from projections.fold.corrections import NO_CORRECTIONS, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.surfaces.cli.folded_log import settings_from

LOGGED = compile_corrections(
    [
        RecordedCommand(
            Offset(3),
            UseSettings(command_id="c1", issued_by="ann@lab", settings={"eps_m": 0.75}),
        )
    ]
)


def test_the_log_s_settings_are_used_unless_a_file_is_given(tmp_path: Path) -> None:
    file = tmp_path / "settings.json"
    file.write_text(json.dumps({"min_samples": 9}))
    assert settings_from(None, None, NO_CORRECTIONS) == Settings()
    assert settings_from(None, None, LOGGED) == Settings(eps_m=0.75)
    assert settings_from(file, None, LOGGED) == Settings(min_samples=9)


def test_set_changes_the_log_s_settings() -> None:
    assert settings_from(None, ["min_samples=5"], LOGGED) == Settings(eps_m=0.75, min_samples=5)
    assert settings_from(None, ["eps_m=1.0"], LOGGED) == Settings(eps_m=1.0)
