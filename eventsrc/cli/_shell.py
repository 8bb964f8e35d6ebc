"""What every command shares: data on stdout, people on stderr, findings as an exit code."""

import json
import sys
from collections.abc import Iterable
from typing import Any

import typer
from rich.console import Console

EXIT_FAILED = 1
EXIT_FINDINGS = 3


people = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
"""Plain text: ids and reasons may hold anything, so markup is off."""


def say(message: str) -> None:
    """One line for people."""
    people.print(message)


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    json.dump(document, sys.stdout, ensure_ascii=False, allow_nan=False, indent=2)
    sys.stdout.write("\n")


def emit_lines(documents: Iterable[Any]) -> None:
    """JSON lines on stdout, each as soon as it is there."""
    for document in documents:
        sys.stdout.write(json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n")


def finish(*, findings: bool) -> None:
    """End the command with exit 3 when something was lost or found, else let it return 0."""
    if findings:
        raise typer.Exit(EXIT_FINDINGS)
