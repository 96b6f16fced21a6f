"""The object-only tracker: evidence of a frame, pose fit, pose search, passes over time."""
