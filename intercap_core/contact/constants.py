"""Numbers of contact detection: each with its unit and the reason for its value."""

from __future__ import annotations

# --- measurement noise

# Standard deviation of the distance between a region and the object, metres, at least: errors of
# skin, clothing and the two meshes. Tuned on the studio.
MIN_DISTANCE_SIGMA = 0.008
# Speed of skin over a held surface that the fits' jitter explains, m/s. Tuned on the studio.
SLIP_SIGMA = 0.12
# Fit errors last: the evidence of one frame repeats in its neighbours for about so many seconds.
# Tuned on the studio.
EVIDENCE_CORRELATION_S = 0.2
# Probability that the error of a touching region's distance is beyond the stated one: some
# millimetres more must not rule contact out. Tuned on the studio.
OUTLIER_PROBABILITY = 0.01

# Of a part of a sole that stands, after errors of the fits: speed, m/s, and height above the floor,
# metres; and of one that swings. Tuned on the studio.
STANDING_SPEED, SWING_SPEED = 0.06, 0.6
STANDING_HEIGHT, SWING_HEIGHT = 0.02, 0.15

# --- human motion

# Changes between free and touching, per second and region: an interaction of a few seconds has a
# handful of them. Tuned on the studio.
CHANGES_PER_SECOND = 0.6
# Share of frames in which a region touches, before anything is seen. Tuned on the studio.
TOUCHING_PRIOR = 0.15
# A free hand is anywhere within this distance of the object, metres: half an arm's length. Tuned on
# the studio.
FREE_RANGE = 0.40
# An object moves when its surface does so faster than this, m/s: the track's jitter stays below.
# Tuned on the studio.
MOVING_SPEED = 0.12
# An object that moves faster than so many times ``MOVING_SPEED`` is held. Tuned on the studio.
HELD_SPEED_FACTOR = 2.0

# --- decision

# Limit of the log odds that the slip of one frame gives: the model of it is rough. Tuned on the
# studio.
MAX_SLIP_LOGIT = 4.0
# Log odds that a moving object adds to the region that follows it best. Tuned on the studio.
HOLDER_LOGIT = 2.0
# Distance, in standard deviations, within which a region may hold the object. Tuned on the studio.
HOLDER_REACH = 4.0
# Frames by which people err at the ends of an annotated interval: a third of a second at 15 fps.
# Tuned on the studio.
ANNOTATION_SLACK = 5
# Log odds of an annotation away from its ends: wrong once in 400. Tuned on the studio.
ANNOTATED_LOGIT = 6.0

# --- solver effort: how densely the skin is sampled

# Vertices kept of each region: fingers are thin and wrap around things, and what sits on an edge
# touches it with little of a large region. Tuned on the studio.
REGION_VERTICES = 240
# Vertices nearest to the object whose mean is a region's distance and slip. Tuned on the studio.
NEAREST_VERTICES = 6
