"""``--preset`` and ``--space``: settings with a name, for every command that takes ``--set``.

Both stand for assignments of ``--set``. A preset comes before them, so ``--set`` changes it;
``--space NAME`` is ``--set embedding_model=NAME`` and comes behind them.
"""

import functools
import inspect
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Any

import typer
from typer.models import OptionInfo

from projections.fold.settings import PRESETS

Preset = StrEnum("Preset", list(PRESETS))  # type: ignore[misc]
"""The values of ``--preset``."""

PresetOption = Annotated[
    Preset | None,
    typer.Option(
        "--preset",
        metavar="|".join(PRESETS),
        help="Named settings: page, for places by DBSCAN, or rooms, for places that are rooms;"
        " --set goes on top.",
    ),
]

SpaceOption = Annotated[
    str | None,
    typer.Option(
        "--space",
        metavar="NAME",
        help="The embedding space of the map, by its model's name [default: that of the log's first"
        " vector]; see `mapfold reembed`.",
    ),
]


def add_presets(app: typer.Typer) -> None:
    """Give ``--preset`` and ``--space`` to each command of the program that has ``--set``."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = _with_preset(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            add_presets(group.typer_instance)


def _with_preset(command: Callable[..., Any]) -> Callable[..., Any]:
    parameters = list(inspect.signature(command, eval_str=True).parameters.values())
    at = next((i for i, each in enumerate(parameters) if _is_set(each)), None)
    if at is None or any(each.name == "preset" for each in parameters):
        return command
    name = parameters[at].name

    @functools.wraps(command)
    def with_preset(*, preset: str | None = None, space: str | None = None, **values: Any) -> Any:
        if preset is not None:
            values[name] = [*PRESETS[preset], *(values[name] or ())]
        if space is not None:
            values[name] = [*(values[name] or ()), f"embedding_model={space}"]
        return command(**values)

    added = [
        inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        for option, kind in (("preset", PresetOption), ("space", SpaceOption))
    ]
    keywords = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    keywords[at:at] = added
    with_preset.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    with_preset.__annotations__ = {each.name: each.annotation for each in keywords}
    return with_preset


def _is_set(parameter: inspect.Parameter) -> bool:
    """Whether a parameter is the option ``--set``; typer keeps an option's first name as if it were
    a default."""
    found = getattr(parameter.annotation, "__metadata__", ())
    return any(
        isinstance(each, OptionInfo) and "--set" in (each.default, *(each.param_decls or ()))
        for each in found
    )
