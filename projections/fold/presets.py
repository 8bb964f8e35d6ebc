"""Presets: settings by name, said once when a log is made."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

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
OLD_NAMES: Final = {"page": "classic"}
