"""A file of settings, and the texts of --set: Settings, or SettingsError."""

import json
import random
from collections.abc import Sequence
from pathlib import Path

from projections.fold.map_errors import SettingsError
from projections.fold.settings import Settings
from projections.surfaces.cli.folded_log import settings_from
from scripts.programs.attack.corruption import corrupt_json
from scripts.programs.fuzz.scratch import scratch
from scripts.programs.fuzz.target import Target, check_message


class SettingsTarget(Target):
    """The bytes of the file; a JSON list is taken for the texts of --set."""

    def seeds(self) -> Sequence[bytes]:
        """Defaults, some, and assignments."""
        documents = (
            Settings().model_dump(),
            {"eps_m": 0.75, "min_samples": 8},
            ["eps_m=1.0", "embedding_model=none", "min_samples = 4"],
        )
        return [json.dumps(document).encode() for document in documents]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One value becomes another."""
        return corrupt_json(data, rng)

    def check(self, data: bytes) -> None:
        """What is accepted has a fingerprint, and that is stable."""
        file = scratch() / "settings.json"
        file.write_bytes(data)
        for settings in (self._read(file, []), self._read(None, _texts(data))):
            if settings is not None:
                again = Settings.model_validate_json(settings.model_dump_json())
                assert again.fingerprint() == settings.fingerprint()

    def _read(self, file: Path | None, texts: list[str]) -> Settings | None:
        try:
            return settings_from(file, texts)
        except SettingsError as error:
            check_message(error)
            return None


def _texts(data: bytes) -> list[str]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return []
    items = document if isinstance(document, list) else []
    return [item for item in items if isinstance(item, str)]
