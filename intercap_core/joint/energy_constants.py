"""Numbers of the terms of the joint energy: each with its unit and the reason for its value."""

from __future__ import annotations

# --- contact and penetration of body and object

# A vertex counts in its patch, and a patch in its region, by how much farther it is than the
# nearest, metres: skin yields and meshes are some millimetres wrong, so contact is an area of this
# depth. Tuned on the studio.
CONTACT_SOFTNESS = 0.006
# Distance at which a patch starts to count as an outlier, metres: the accuracy that keypoints and
# depth leave to a hand. Tuned on the studio.
CONTACT_OUTLIER = 0.02
# Nearer than this is contact and costs nothing, metres: half the distance (4.5 mm) at which
# ``contact_mm`` of the settings calls it contact, rounded down. Tuned on the studio.
CONTACT_TOLERANCE = 0.002
# Contact leaves the mesh up to this deep in the surface, metres: skin yields. Tuned on the studio.
PENETRATION_TOLERANCE = 0.001
# Points of the object deeper than this inside the body are left out, metres: half of a hand's
# thickness (anatomy), beyond which the nearest skin may be that of its far side.
DEEPEST_IN_BODY = 0.015
# Points so far outside the skin may enter it during a round, metres. Tuned on the studio.
WATCHED_OUTSIDE = 0.003
# Farther from the object's box than this, metres, the box stands for the surface: many times what
# any term or contact asks about.
FAR_FROM_BOX = 0.25
# Nearer to the surface than this, metres, the direction to the closest point is noise: the face's
# normal is used. Tuned on the studio.
ON_SURFACE = 1e-4
