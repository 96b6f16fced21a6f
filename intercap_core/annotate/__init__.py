"""Correction of a sequence's annotation in the browser, and runs with the corrected annotation."""
