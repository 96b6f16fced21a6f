"""Numbers of contact detection: each with its unit and the reason for its value."""

from __future__ import annotations

# --- measurement noise

# Errors of a region's distance that last through a contact, metres, beside what the fits state: of
# shape, clothing and the two meshes; and those that change from frame to frame. Tuned on the
# studio.
LASTING_SIGMA, FRAME_SIGMA = 0.006, 0.004
# A lasting error is believed up to so many of its standard deviations. Tuned on the studio.
MAX_LASTING_SIGMAS = 3.0
# Speed of skin over a held surface that the fits' jitter explains, m/s. Tuned on the studio.
SLIP_SIGMA = 0.12
# The evidence of one frame repeats in its neighbours for about so many seconds: what does not last
# of the fits' errors.
# Tuned on the studio.
EVIDENCE_CORRELATION_S = 0.07
# Probability that the error of a touching region's distance is beyond the stated one: some
# millimetres more must not rule contact out. Tuned on the studio.
OUTLIER_PROBABILITY = 0.01

# Of a part of a sole that stands, after errors of the fits: speed, m/s, and height above the floor,
# metres; and of one that swings. Tuned on the studio.
STANDING_SPEED, SWING_SPEED = 0.06, 0.6
STANDING_HEIGHT, SWING_HEIGHT = 0.02, 0.15
# Share of what stands that stands on something else than the floor, or where the floor is not.
# Tuned on the studio.
STANDING_ELSEWHERE = 0.2

# --- human motion

# How often a second a part of a sole that swings comes to stand, and how long it stands, seconds.
# Tuned on the studio.
STANDING_BEGINS, STANDING_S = 0.18, 0.98
# How often a second a free region begins to touch, and how long it does, seconds: four contacts in
# five are brief (a sip, a kick), the others are holds. Tuned on the studio.
TOUCH_BEGINS = 0.6
TOUCH_S, TOUCH_SHARES = (0.3, 3.0), (0.8, 0.2)
# A free region near the object is anywhere within this distance of it, metres: on its way there or
# back, or beside one that touches. Tuned on the studio.
FREE_RANGE = 0.10
# An object moves when its surface does so faster than this, m/s: the track's jitter stays below.
# Tuned on the studio.
MOVING_SPEED = 0.12
# An object is off the floor from this height on, metres: above the floor's and the track's errors.
# Tuned on the studio.
LIFTED_HEIGHT = 0.03
# A fall's acceleration differs from gravity's by less than this, m/s^2: air, and the track's jitter
# between frames. Tuned on the studio.
FALL_TOLERANCE = 4.0
STANDARD_GRAVITY = 9.80665  # m/s^2, by definition
# Probability that no region holds an object that neither rests nor falls: it slides on furniture,
# or something that is not modelled holds it. Tuned on the studio.
UNHELD_PROBABILITY = 0.1

# --- decision

# Limit of the log odds that the slip of one frame gives: the model of it is rough. Tuned on the
# studio.
MAX_SLIP_LOGIT = 4.0
# Log odds of an annotation away from its ends: above all that distance and slip can say against it.
ANNOTATED_LOGIT = 12.0
# An annotated contact this far from the object is a mistake of one or the other, metres: beyond
# what the fits err by where they are not flagged. Tuned on the studio.
FAR_CONTACT = 0.15

# --- solver effort: how densely the skin is sampled

# Vertices kept of each region: fingers are thin and wrap around things, and what sits on an edge
# touches it with little of a large region. Tuned on the studio.
REGION_VERTICES = 240
# Depth over which the soft minimum of a region's distance fades, metres: what is this much farther
# than its nearest vertex counts a third. Tuned on the studio.
SOFT_MINIMUM = 0.004
