"""Damaged files of every kind that a user supplies.

A damaged file must be accepted with plausible content, or refused in one sentence that names it.

- ``kinds``, ``kinds_recordings``: good files of each kind and their readers
- ``damage``: strategies of hypothesis that damage a file
- ``child``: reads a case in a child process with limits of time and memory
- ``plausible``: what no reader may return
- ``run``: thousands of cases, `make fuzz`; ``test_fuzz`` runs a few of each kind
"""
