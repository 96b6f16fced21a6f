"""Tuned numbers of stage ``person``, by kind, each with its unit and where it comes from.

"tuned on the studio" = chosen so that the simulated captures of ``intercap_core.studio`` come out
right; no measurement of people or detectors stands behind it. Lengths in pixels are for an image
1080 pixels high and scale with it.
"""

from __future__ import annotations

# --- sensor: depth at a keypoint (lifting)
KEYPOINT_REACH_M = 0.03  # half side, across the ray, of where depth is read; tuned
MIN_DEPTH_SAMPLES = 4  # depth pixels; tuned on the studio
# Quantile of the samples that counts as nearest: nearer ones may float between body and background.
NEAREST_QUANTILE = 0.2  # tuned on the studio
SURFACE_M = 0.05  # samples this far behind the nearest are another surface; tuned on the studio
AT_BACKGROUND_MM = 40  # within this of the scene's background a pixel shows it; tuned on the studio
DEPTH_STRIDE = 2  # pixels and rows; a quarter of the depth image is enough around a joint

# --- anatomy
# How deep a keypoint lies under the skin, metres: measured on the open body (`body.loading`),
# standing, the median over all horizontal directions. What is not named lies on the skin.
INSET_M = {
    "neck": 0.065,
    "shoulder": 0.060,
    "elbow": 0.046,
    "wrist": 0.026,
    "mid_hip": 0.13,
    "hip": 0.106,
    "knee": 0.059,
    "ankle": 0.040,
}
HAND_INSET_M = 0.008  # half a finger's thickness
# Between shoulders, between hips, metres, half of an adult's breadth: nearer, one occludes the
# other.
OCCLUDED_BREADTH_M = (0.18, 0.09)
# How far adults' thighs, shanks, upper arms, forearms, shoulders (from joint to joint) and trunks
# are spread, metres: standard deviations over the open body's shapes.
BUILD_SPREADS_M = (0.034, 0.027, 0.015, 0.023, 0.033, 0.025)
# A median length errs by as much however many sets tell: detectors' biases by pose; tuned
BUILD_FLOOR_M = 0.012
MIN_BUILD_SETS = 5  # that know a bone; also so many neighbouring sets err alike; tuned
BODY_DEPTH_M = 0.25  # from the body's middle, along the ray, an unmoving part may lie; tuned
SHORT_BONE_M = 0.03  # vectors shorter than this have no reliable direction; tuned on the studio
HAND_ROOT_APART_M = 0.08  # body's and hand's wrist of one arm are nearer together; tuned

# --- human motion
MAX_BODY_SPEED_M_S = 4.0  # of a body's centre; people run slower indoors
# Hands reach some 5 m/s in everyday tasks and people stand two metres from a capture ring's
# cameras: what moves faster in an image is another detection. Radians a second.
MAX_IMAGE_SPEED_RAD_S = 2.5
# Over at most this a person is followed by place alone; longer gaps are a matter of build, too.
FOLLOWED_GAP_S = 0.4  # tuned on the studio
# Over at most this a single view takes somebody for who was last known there, and a joined track
# is not in doubt; tuned on the studio.
MAX_LINK_GAP_S = 2.0
WALKING_SPEED_M_S = 1.2  # of who is not seen for a while
LINK_SLACK_M = 0.25  # scatter of a person's centre between sets; tuned on the studio
MOTION_MEMORY_S = 0.5  # motion is judged over gaps of at most this; tuned on the studio
STEP_M = 0.04  # motion from set to set that costs 1 (negative log likelihood); tuned on the studio
LARGEST_STEP_M = 0.3  # motion from set to set counts as this at most; tuned on the studio

# --- solver effort
EXCHANGE_ROUNDS = 2  # of exchanging limbs and triangulating again
MAX_AGREEING_VIEWS = 10  # all 2^(C-1) assignments of sides are tried over so many views
SAME_PERSON_SHARE = 0.5  # of a candidate's mask within the subject's: the same person; judged
OUTSIDE_GRID = 64  # steps along the longer side of a mask on whose grid its outside is counted

# --- decision: who is the subject
MIN_COMMON_POINTS = 5  # body points; fewer do not tell two people apart; tuned on the studio
# Median distance within which a view shows the same person, px: detectors' biases and calibration
# stay well under it, another person half a metre away (160 px at 2.6 m) is well over it.
SAME_PERSON_PX_AT_1080P = 60.0
MOVED_PX_FACTOR = 2.0  # that limit is this much wider where the subject has moved since
SAME_PERSON_GAP_M = 0.12  # median distance of two views' rays; tuned on the studio
SAME_PERSON_M = 0.3  # between centres, of people who share a detection; nobody stands nearer
LIFTED_SUPPORT = 0.5  # of a point that one view lifts by depth; triangulated, it counts about two
CENTRE_RANGE_M = 1.5  # support counts half so far from the ring's middle; tuned on the studio
# Support of who touches the object most counts so much more, others' by how much they touch it;
# where nobody touches it in this share of the images that show both, nothing is said; judged.
HANDLING_WEIGHT, LEAST_HANDLING = 4.0, 0.05
TOUCH_REACH = 0.03  # of a person's height in an image, beyond the keypoints: a hand's breadth
# Support of another person, seen at the same time, over the subject's, from which it is said that
# it might be the one; judged.
RIVAL_SHARE = 0.5
# Logarithms of how much more likely two tracks are of one person than of two, by build: below the
# first they are not joined, below the second, after a gap, it is said.
OTHER_BUILD, SURE_BUILD = -3.0, 1.0
NAMED_REACH = 0.15  # of a person's height in an image, from bones to the point that names it
ENOUGH_TRIANGULATED = 8  # body points; a set with so many needs no lifting; tuned on the studio
MIN_MOVING_POINTS = (
    6  # points before the background; with fewer, the person is taken for part of it
)

# --- decision: left and right, views made to agree
# Gap between rays of one point beyond which a pair of views says nothing more, metres; arms, legs,
# head, hands. Rays of one point pass each other by a few centimetres (detectors' biases,
# calibration), those of a left and a right point by up to a body's breadth, or a face's.
SIDE_GAPS_M = (0.12, 0.12, 0.05, 0.12)
UNKNOWN_SIDE_COST = 0.25  # squared share of that gap, where there is nothing to compare; tuned
# Cost of each view exchanged: more than noise alone gains on a small limb; tuned on the studio.
EXCHANGED_VIEW_COST = 0.5

# --- decision: left and right, by the body's build; negative log likelihoods, tuned on the studio
# The body's build is certain, a turned head and a twisted back (each up to some 80 degrees) less
# so; detectors exchange the sides in most views of about one set in twenty.
HINGE_COST, HEAD_COST, TWIST_COST, NOSE_COST = 8.0, 6.0, 6.0, 3.0
DETECTED_COST = 3.0  # of contradicting the detector in all views: -log(1/20)
CHANGE_COST = 1.0  # of a limb's sides changing from set to set
CROSSED_HANDS_RATIO = 0.5  # hands are exchanged where the other arm is nearer by this factor

# --- decision: left and right, one view at a time
MUCH_BETTER = 0.5  # cost exchanged over cost as detected, at most; tuned on the studio
# Mean truncated squared error, in units of the inlier limit, from which a limb may be exchanged:
# half of its points are off by the limit or more.
MIN_LIMB_COST = 0.25
# In units of the inlier limit; well beyond it, so that an exchange differs from another mistake.
TRUNCATED_AT = 4.0
MIN_LIMB_POINTS = 2  # of a limb that is compared
FEW_VIEWS = 4  # with at most so many, limbs that jump between the sides are steadied; tuned
EXCHANGED_PX_AT_1080P = 3.0  # cost of a set exchanged: detectors are mostly right; tuned
# Cost of an exchange with which the recording begins or ends: it shows one jump alone, as a fast
# turn does. Tuned on the studio.
OPEN_EXCHANGE_PX_AT_1080P = 100.0
JUMP_PX_AT_1080P = 120.0  # motion from set to set counts as this at most; tuned on the studio

# --- decision: which mask is the subject's; tuned on the studio
MIN_INSIDE_SHARE = 0.5  # of the subject's points inside the mask
LABEL_BONUS = 0.15  # share of points; labels are mostly right, one that fits much better still wins
OUTSIDE_COST = 0.5  # share of points, for a mask that lies wholly outside the subject's box
BOX_MARGIN = 0.25  # share of the box of the points, for what has none: hair, soles, clothes
MIN_MASK_POINTS = 4  # points and middles of bones
