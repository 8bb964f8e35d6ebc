# Sourced by the scripts beside it: makes .venv with mapfold and its tools, and is quick when it is
# up to date already. Needs Python 3.11 or later with pip and venv, nothing else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# Where this is set, as in many containers, every process compiles all modules that it imports, which
# takes longer than most commands and tests.
unset PYTHONDONTWRITEBYTECODE

find_python() {
    local candidate
    for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11 python; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "mapfold needs Python 3.11 or later; none was found. Install it or set PYTHON=/path/to/python" >&2
    exit 1
}

ensure_venv() { # ensure_venv [run: mapfold with its web debugger | a group of pyproject.toml's]
    local stamp want
    stamp=".venv/.installed-${1:-run}"
    want=$(cksum pyproject.toml | cut -d' ' -f1)
    if [ ! -x .venv/bin/python ]; then
        "$(find_python)" -m venv .venv
    fi
    if [ "$(cat "$stamp" 2>/dev/null || true)" != "$want" ]; then
        echo "installing mapfold into .venv …" >&2
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1' >&2
        if [ "${1:-run}" != run ]; then
            .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable . --group "$1" >&2
        else
            .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[ui]' >&2
        fi
        echo "$want" >"$stamp"
    fi
}
