"""`intercap dev evaluate`: virtual recordings compared with their truth.

- ``run``: the command; runs the workflows, measures, prints and writes the figures.
- ``part``: the type of a part of the evaluation.
- ``tables``: tables of the figures.
- ``sequences``, ``captures``, ``objects``, ``bodies``, ``field_scenes``, ``field``,
  ``detector``, ``rig``, ``scan``: the nine parts.
- ``workflows``: brings the artefacts of all projects up to date, and measures the minutes of each
  part.
- ``seeds``: the same recordings with new random seeds.
- ``constants``: counts the constants of the package.
- ``reference``: the regression gate of the quick evaluation.
"""
