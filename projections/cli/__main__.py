"""`python -m projections.cli`: the ``mapfold`` command without its entry point installed."""

from projections.cli import main

main()
