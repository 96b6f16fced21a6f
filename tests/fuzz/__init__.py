"""Damaged files of every kind that a user supplies, thousands, each read in a process of its own.

One is accepted and plausible, or refused in one sentence that names it.

- ``kinds_*``: the kinds of files: a good one, its reader, and what holds of anything it accepts
- ``mutations``: how a file is damaged, from a seed
- ``forks``: reads a case in a child with limits of time and memory, and says how it ended
- ``run``: thousands of cases, `make fuzz`; ``test_fuzz`` runs a few hundred
"""
