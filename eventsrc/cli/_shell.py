"""What every command shares: data on stdout, people on stderr, errors as one line, exit codes.

Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings.
"""

import json
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any

import typer
from rich.console import Console

from eventsrc.errors import MapfoldError

EXIT_FAILED = 1
EXIT_FINDINGS = 3
EXIT_INTERRUPTED = 130

people = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
"""Where people read. Plain text: ids and reasons may hold anything, so markup is off."""


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


def run_app(app: Callable[..., Any]) -> None:
    """Run a typer app as a program: our errors are one line, a closed pipe is no error."""
    try:
        app()
        sys.stdout.flush()
    except MapfoldError as error:
        people.print(f"mapfold: {error}")
        sys.exit(error.exit_code)
    except BrokenPipeError:
        # `mapfold log cat L | head`: the reader has seen enough. Point stdout elsewhere so that
        # the interpreter's own flush at exit does not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        people.print("mapfold: interrupted")
        sys.exit(EXIT_INTERRUPTED)
