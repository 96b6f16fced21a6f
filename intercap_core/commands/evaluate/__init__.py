"""Virtual recordings held to their truth: `intercap evaluate`.

``evaluate`` runs the parts, ``part`` is what they have in common (stage, measure, figures, tables),
``captures``, ``objects``, ``bodies`` and ``sequences`` are the four of them. ``workflows`` brings
their artefacts up to date, ``budget`` holds minutes, ``reference`` compares with recorded figures.
"""
