"""Presets: settings by name, said once when a log is made."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from .map_errors import SettingsError

_MAX_SHOWN: Final = 80

PRESETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "classic": (
            *("places=page", "eps_m=1.5", "min_samples=3"),
            *("fusion=page", "fusion_radius_m=3.0", "fusion_similarity=0.7"),
        ),
        "rooms": ("places=rooms", "fusion=page"),
        "full": ("places=rooms", "fusion=evidence"),
    }
)
"""Settings by name, as assignments: each names the rules of places and of fusion."""
_OLD_NAMES: Final = {"page": "classic"}


def preset_assignments(name: str) -> tuple[str, ...]:
    """The assignments of a preset, also by its old name. Raises SettingsError."""
    found = PRESETS.get(_OLD_NAMES.get(name, name))
    if found is None:
        raise SettingsError(f"no preset {name[:_MAX_SHOWN]!r}; there are {', '.join(PRESETS)}")
    return found
