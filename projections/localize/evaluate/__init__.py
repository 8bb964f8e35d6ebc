"""Scores of places, Objects and re-localisation against ground truth."""
