"""The log's public names."""

import subprocess
import sys

import eventsrc.log


def test_all_names_are_sorted_and_exist() -> None:
    names = eventsrc.log.__all__
    constants = [n for n in names if n.isupper()]
    classes = [n for n in names if n[0].isupper() and not n.isupper()]
    functions = [n for n in names if n.islower()]
    assert names == [*sorted(constants), *sorted(classes), *sorted(functions)]
    assert all(hasattr(eventsrc.log, name) for name in names)


def test_the_log_loads_without_network_or_database() -> None:
    program = "import sys, eventsrc.log; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = set(done.stdout.split())
    assert not loaded & {"zenoh", "psycopg", "pgserver", "matplotlib", "typer", "projections"}
