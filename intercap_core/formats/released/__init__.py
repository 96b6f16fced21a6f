"""Results that another program made, read so that metrics, statistics, viewer and report run on
them."""
