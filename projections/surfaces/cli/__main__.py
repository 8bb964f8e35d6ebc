"""`python -m projections.surfaces.cli`: `mapfold` without its entry point installed."""

from . import main

main()
