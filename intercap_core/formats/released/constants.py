"""Numbers of the imports, each with its unit and reason."""

from __future__ import annotations

# --- plausible values -------------------------------------------------------------------------

MOST_M = 100.0  # a place beyond this is in other units
MOST_RAD = 100.0  # as is a rotation vector
PERSON_EXTENT_M = (0.5, 3.0)  # largest side of a person's box, crouched to with an arm up

# --- matching ---------------------------------------------------------------------------------

# Names of BEHAVE's folders round times to milliseconds; images come 33 ms apart at the least.
SAME_TIME_US = 5_000

# --- conversion of a body ---------------------------------------------------------------------

# Frames, spread evenly, that settle the one shape: on a studio's person the skin is then within
# 0.1 mm of what 48 frames give.
SHAPE_FRAMES = 16
FRAMES_TOGETHER = 32  # fitted at once once the shape is known: memory
# Rounds of finding correspondences, each with one step of Gauss-Newton: in the first fingers keep
# the pose that was found for the other body, until hands lie on hands; else a finger goes to its
# neighbour, which is 20 mm beside it.
HELD_ROUNDS, FREE_ROUNDS = 6, 6  # with the shape
POSE_HELD_ROUNDS, POSE_FREE_ROUNDS = 4, 4  # once the shape is known
# What two body models differ by where pose and shape agree: the studio's people on another mesh
# end 1.4 to 2.7 mm beside the open body in the mean, 4 to 8 in the 95th percentile.
SURFACE_SIGMA_M = 0.004
REACH_M = 0.20  # the farthest correspondence; arms start that far beside
# A correspondence as far as this counts a quarter (Geman and McClure): of the body, and of hands
# whose fingers are free, where what is farther may be the next finger.
FAR_M, HAND_FAR_M = 0.03, 0.008
# rad, about the rotations that were found for the other body: rest poses and joints of the two
# differ by some degrees. They decide what the surface does not: turns about a limb's own axis, and
# fingers in a fist. From rotations 8 degrees off, joints end 3 mm beside the true ones in the mean.
POSE_SIGMA, FINGER_SIGMA, HELD_SIGMA = 0.25, 0.08, 0.01

# Beyond these a frame is flagged: four times what it ends at otherwise (see SURFACE_SIGMA_M).
FAR_MEAN_M = 0.010
FAR_MOST_M = 0.030  # 95th percentile

# --- the object -------------------------------------------------------------------------------

# 95th percentile of how far the released placement is from ours, beyond which the mesh is another
# one than the poses belong to. Closed and simplified copies of a template are nearer.
OTHER_MESH_M = 0.010
CHECKED_FRAMES = 5
