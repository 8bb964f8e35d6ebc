"""What a command must hold beyond its model, checked before it is recorded."""

from eventsrc.commands import Command, UseSettings
from projections.settings import Settings


def check_command(command: Command) -> None:
    """Raises SettingsError for settings that no fold could have: recorded, they would stop all."""
    if isinstance(command, UseSettings):
        Settings.from_document(command.settings)
