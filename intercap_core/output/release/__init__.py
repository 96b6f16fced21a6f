"""Files that accompany a published dataset: its card with splits, and the list of its files."""
