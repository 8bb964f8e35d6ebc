"""The log and the options that the server was started with."""

from dataclasses import dataclass
from pathlib import Path

from projections.history.timeline import SettingsChoice
from projections.localize.evaluate.truth import Truth


@dataclass(frozen=True, slots=True)
class Opened:
    """A log and the options of the debugger.

    ``settings`` gives those of the map under some corrections: of ``settings_file`` or the log,
    changed by ``sets`` (``name=value``). ``truth``, of ``truth_files``, scores what-ifs. ``edits``:
    the log may be changed. ``token_needed``: every question needs the token. ``cache``: histories
    are read and kept beside the log.
    """

    log: Path
    settings: SettingsChoice
    sets: tuple[str, ...] = ()
    settings_file: Path | None = None
    truth_files: tuple[Path, ...] = ()
    truth: Truth | None = None
    edits: bool = False
    token_needed: bool = False
    cache: bool = True

    def words(self, *sets: str) -> list[str]:
        """The options that give a command the same settings, changed by ``sets``."""
        words = [] if self.settings_file is None else ["--settings", str(self.settings_file)]
        return words + [word for text in (*self.sets, *sets) for word in ("--set", text)]

    def base_words(self) -> list[str]:
        """The options that give ``mapfold whatif`` the same base."""
        words = [] if self.settings_file is None else ["--settings", str(self.settings_file)]
        words += ["--base", " ".join(self.sets)] if self.sets else []
        return words + [word for file in self.truth_files for word in ("--truth", str(file))]
