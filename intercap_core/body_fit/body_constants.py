"""Numbers of the body's energy terms, each with its unit and reason.

"Tuned on the studio" means: chosen on recordings of the synthetic studio; no source beyond that.
The coverings' thickness stands with its source in :mod:`.body_samples`.
"""

from __future__ import annotations

import math

# --- sensor -----------------------------------------------------------------------------------

# Metres that a turn of one radian between normals counts as in a match. Tuned on the studio.
NORMAL_LENGTH_M = 0.06
# Metres beside the normal's line beyond which a point matches no vertex. Tuned on the studio.
MATCH_SIDEWAYS_M = 0.03
# Least cosine between the normals of a point and its vertex. Tuned on the studio.
MATCH_COSINE = 0.3
BODY_SPACING_M = 0.045  # between samples of the skin; tuned on the studio
HAND_SPACING_M = 0.015  # the same on hands, where fingers are as wide (anatomy)
PATCH_VERTICES = 20  # around a sample, where a point looks for its nearest; tuned on the studio

# --- the body ---------------------------------------------------------------------------------

# 1/rad; ranges of joints are means plus two deviations of people, a soft edge of 4 degrees. Tuned
# on the studio.
LIMIT_WEIGHT = 1 / math.radians(4)
# The penalty exp(sign theta) is 1 at the straight limb, where it should cost little. Tuned on the
# studio.
BENDING_WEIGHT = 1 / 6
# Floor of the deviation of hand components that hardly vary among grasps. Tuned on the studio.
SMALLEST_HAND_DEVIATION = 0.03
SELF_TOLERANCE_M = 0.003  # skin yields by some millimetres under pressure; tuned on the studio
# Error of the fitted skin on either side: measured on the studio (docs/decisions.md).
SELF_SIGMA_M = 0.008
SELF_REACH_M = 0.015  # depth at which the penalty levels off (rho); tuned on the studio
# 1/m^2; neighbouring samples penetrate together: four make one measurement. Tuned on the studio.
SELF_WEIGHT = 0.25 / SELF_SIGMA_M**2
# Samples nearer over the surface than this times the mean thickness of what they lie on are joined;
# flesh meets flesh where a joint closes, so parts on both sides of one are joined farther. Tuned on
# the studio.
JOINED_THICKNESSES = 1.6
JOINED_HINGE_THICKNESSES = 3.2
DEEPEST_THICKNESSES = 0.5  # deeper than half of a part is behind its far side (geometry)
DEEPEST_M = 0.06  # the same in metres, for the trunk; tuned on the studio
WATCHED_M = 0.004  # outside by less: may penetrate before pairs are found anew; tuned on the studio
SPACING_RANK = 6  # a vertex of a triangle mesh has six neighbours in the mean (Euler)

# --- solver effort ----------------------------------------------------------------------------

SAMPLES_TOGETHER = 24  # samples whose distance to a point is bounded at once: speed
GEODESIC_ROUNDS = 12  # searches over the surface, each as far as its own vertices need: speed
