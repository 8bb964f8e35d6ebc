"""Groups of options: a dataclass whose fields are options and arguments that several commands
share, and whose methods are what they are for.

A command takes a group as one keyword parameter; `flattened` gives typer its fields instead. The
options of a group stand where the group stands, its arguments before those of the command.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

from typer.models import ArgumentInfo

_KEYWORD = inspect.Parameter.KEYWORD_ONLY


def flattened(command: Callable[..., Any]) -> Callable[..., Any]:
    """``command`` with the fields of its groups as parameters; itself if it has no group."""
    own = inspect.signature(command, eval_str=True).parameters.values()
    groups = {p.name: list(_fields(p.annotation)) for p in own if _is_group(p.annotation)}
    if not groups:
        return command
    kinds = {p.name: p.annotation for p in own}

    @functools.wraps(command)
    def run(**values: Any) -> Any:
        for name, fields in groups.items():
            values[name] = kinds[name](**{field.name: values.pop(field.name) for field in fields})
        return command(**values)

    shared = [field for fields in groups.values() for field in fields if _is_argument(field)]
    others = (each for parameter in own for each in groups.get(parameter.name, [parameter]))
    parameters = shared + [each.replace(kind=_KEYWORD) for each in others if each not in shared]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def _fields(group: Any) -> Iterator[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    for field in dataclasses.fields(group):
        missing = field.default is dataclasses.MISSING
        default = inspect.Parameter.empty if missing else field.default
        yield inspect.Parameter(field.name, _KEYWORD, default=default, annotation=hints[field.name])


def _is_argument(parameter: inspect.Parameter) -> bool:
    found = getattr(parameter.annotation, "__metadata__", ())
    return any(isinstance(each, ArgumentInfo) for each in found)
