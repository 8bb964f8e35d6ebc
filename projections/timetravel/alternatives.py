"""Which settings a what-if tries: from ``--set``, ``--try`` and ``--grid`` to `Settings`."""

from collections.abc import Sequence
from itertools import product

from projections.errors import SettingsError
from projections.settings import Settings

MOST_ALTERNATIVES = 200


def alternatives(
    base: Settings, sets: Sequence[str], tries: Sequence[str], grids: Sequence[str]
) -> list[Settings]:
    """The settings to try beside ``base``, each once, in the order given.

    ``sets`` together make one alternative (``eps_m=1.0``), and hold for all of the grid; each of
    ``tries`` is one of its own, several assignments in it parted by spaces or commas; ``grids``
    (``eps_m=0.5,1.0``) make every combination. Raises SettingsError that names the bad one.
    """
    common = base.with_assignments(sets)
    axes = [_axis(text) for text in grids]
    size = len(tries)
    for axis in axes:
        size = max(size, 1) * len(axis)
    if size > MOST_ALTERNATIVES:
        raise SettingsError(f"--grid: {size:,} combinations; try at most {MOST_ALTERNATIVES}")
    found = [common] if sets and not axes else []
    found += [assigned(base, text, "--try") for text in tries]
    if axes:
        found += [common.with_assignments(each, "--grid") for each in product(*axes)]
    return list(dict.fromkeys(found))


def assigned(settings: Settings, text: str, option: str) -> Settings:
    """``settings`` changed by several assignments in the text of an option, parted by spaces or
    commas."""
    return settings.with_assignments(text.replace(",", " ").split(), option)


def _axis(text: str) -> list[str]:
    """``eps_m=0.5,1.0`` → ``eps_m=0.5``, ``eps_m=1.0``."""
    name, equals, values = text.partition("=")
    if not equals or not values.strip():
        raise SettingsError(f"--grid {text}: write it as name=value,value such as eps_m=0.5,1.0")
    return [f"{name}={value}" for value in values.split(",")]


def changed_settings(base: Settings, other: Settings) -> dict[str, object]:
    """The settings in which ``other`` differs from ``base``, with its values."""
    before = base.model_dump()
    return {name: value for name, value in other.model_dump().items() if value != before[name]}


def settings_name(base: Settings, other: Settings) -> str:
    """``eps_m=1.0 min_samples=8``: what is different from the base."""
    changed = changed_settings(base, other)
    return " ".join(f"{name}={value}" for name, value in changed.items()) or "no change"
