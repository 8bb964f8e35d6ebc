"""Scores of places, Objects and re-localisation against ground truth."""

from .evaluation import Evaluation, evaluate
from .truth import Truth, read_truth

__all__ = ["Evaluation", "Truth", "evaluate", "read_truth"]
