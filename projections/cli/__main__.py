"""`python -m projections.cli`: the ``mapfold`` command without its entry point installed."""

from . import main

main()
