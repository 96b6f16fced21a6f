"""What goes with a dataset that is given away: splits, its card, and the list of its files."""
