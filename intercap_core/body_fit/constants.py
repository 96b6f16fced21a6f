"""Numbers of the body fit, each with its unit and reason.

"Tuned on the studio" means: chosen on recordings of the synthetic studio; no source beyond that.
"""

from __future__ import annotations

from intercap_core.body.keypoints import BODY, CONTOUR, FACE, LEFT_HAND, RIGHT_HAND

# --- sensor: keypoint detections --------------------------------------------------------------

# Sigmas from which a keypoint counts as an outlier (rho of Geman and McClure). Tuned on the studio.
KEYPOINT_SCALE = 4.0
# m; what is left of a keypoint's error once its fixed offset is taken out: the start, which the
# residuals themselves refine. Tuned on the studio.
KEYPOINT_SIGMA_M = (
    (BODY, 0.02),
    (LEFT_HAND, 0.01),
    (RIGHT_HAND, 0.01),
    (slice(FACE.start, CONTOUR.stop), 0.008),
)
SIGMA_RANGE = (0.1, 4.0)  # bounds of the refined sigma, of its start; tuned on the studio
SMALLEST_SIGMA_PX = 1.0  # tuned on the studio
# Factor of sigma for errors that last over frames, which a fit's residuals hide. Tuned on the
# studio.
PERSISTENCE = 1.5
# m; sigma of a triangulated keypoint at the start of the fit. Tuned on the studio.
START_SIGMA_M = 0.04
# m; a detector's joint differs from the body model's by about this much. Tuned on the studio.
OFFSET_SIGMA_M = 0.010
# Of a learnt definition: the least deviation, what an offset is fitted to (decisions: joints to
# 3 mm), and the fewest people that it is learnt from, as a spread needs.
DEFINITION_SIGMA_M, DEFINITION_FEWEST_PEOPLE = 0.003, 3
# Detectors' errors grow as a power of falling confidence, which is measured on residuals: medians
# in so many bins of confidence, each of at least so many. Tuned on the studio.
CONFIDENCE_BINS = 6
FEWEST_IN_BIN = 30
LARGEST_CONFIDENCE_EXPONENT = 2.0  # tuned on the studio
LEAST_CONFIDENCE = 0.1  # below it, sigma no longer grows; tuned on the studio
# Factor of a view that disagrees with the triangulated point. Tuned on the studio.
OUTLIER_VIEW_TRUST = 0.2

# --- sensor: depth ----------------------------------------------------------------------------

# m in front of the background from which a pixel is the person's. Tuned on the studio.
BEFORE_BACKGROUND_M = 0.04
EVERY_PIXEL = 2  # of as many rows of a depth image is looked at: neighbours tell the same
NORMAL_BASE_PX = 3  # half the base over which a normal is measured; tuned on the studio
# A larger step between those pixels is an edge of the person. Tuned on the studio.
DEPTH_EDGE_M = 0.04
# Trust of points at such an edge, which may float between the person and the background. Tuned on
# the studio.
EDGE_TRUST = 0.3
# Bounds of the refined noise of the cloud, as factors of its start. Tuned on the studio.
NOISE_RANGE = (0.1, 1.5)
# Neighbouring samples lie on one fold of cloth: four make one measurement. Tuned on the studio.
SAMPLE_SHARE = 0.25
HALF_WEIGHT_POINTS = 2.0  # points with which a sample has half its weight; tuned on the studio
# Distance from the covering beyond which a point counts less. Tuned on the studio.
CLOUD_HUBER_M = 0.012
# Of a sample that sticks out of the person, a matched point's. Tuned on the studio.
FREE_SPACE_TRUST = 1.0
# Measured farther behind a vertex: not the person's surface. Tuned on the studio.
FREE_SPACE_BEHIND_M = 0.06
# Least cosine of normal and line of sight, about 84 degrees. Tuned on the studio.
FREE_SPACE_FACING = 0.1
# Least depth; the Azure Kinect's NFOV range starts at 0.5 m (data sheet).
FREE_SPACE_NEAREST_M = 0.3
FREE_SPACE_REACH_M = 0.05  # largest way in along the normal; tuned on the studio
FREE_SPACE_STEP_M = 0.01  # step of that search; tuned on the studio

# --- sensor: masks ----------------------------------------------------------------------------

OUTLINE_POINTS = 400  # of a rim, a third of its pixels where a person fills 720 lines: speed
OUTLINE_BLUR_PX = 3.0  # over which the rim's direction is measured; tuned on the studio
SHORTEST_OUTLINE_PX = 40  # rims of smaller spots and holes are the network's; tuned on the studio
# px outward of a rim of an image of 720 lines, at which another thing is looked for: masks are some
# pixels apart. Tuned on the studio.
BESIDE_AT_720P = (1.0, 4.0, 7.0)
OUTLINE_TRUST = 1.0  # of a point of the rim, a measured point's; tuned on the studio
# Largest cosine between the line of sight and the normal of what may be on the rim: two thirds of a
# limb's spacing of samples. Tuned on the studio.
OUTLINE_FACING = 0.6
OUTLINE_COSINE = 0.8  # least, of the normals of a rim's plane and its vertex; tuned on the studio

# --- human motion -----------------------------------------------------------------------------

MAX_SPEED = 6.0  # m/s; hands and feet reach some 5 in everyday tasks; tuned on the studio
# m/s along one coordinate where nothing is known: a walk; and the least that is believed of
# somebody standing, who sways.
WALKING_SPEED = 1.0
STANDING_SPEED = 0.1
LARGEST_BRIDGED_SIGMA_M = 0.5  # an arm's length
# s; a velocity is that to the nearest known frame between these: nearer ones show the fit's noise,
# farther ones another motion. Tuned on the studio.
VELOCITY_WINDOW_S = (0.045, 0.15)
# Weight of that velocity over the bridge's mean velocity. On hidden stretches of 1 to 15 frames at
# 15 Hz of the studio anything from 0.7 to 1 is best.
VELOCITY_WEIGHT = 0.85
VELOCITY_WEIGHT_UNTIL_S = 1.0  # bridges beyond this length were not measured: the weight fades
FEWEST_BRIDGES = 5  # over known frames, to tell a bridge's error; tuned on the studio
# s; a body without a trunk's three points starts between frames so near, when so many of the 25
# body keypoints are triangulated. Tuned on the studio.
NEAR_START_S = 1.0
ENOUGH_KEYPOINTS = 6
# Around a moment hands swing off the straight by half of 30 m/s^2 times (0.1 s)^2 = 0.15 m, and
# fits scatter by less than 0.1 m: farther from the median of the window is a jump.
JUMP_WINDOW_S = 0.21  # half of it; six frames at 30 Hz
JUMP_M = 0.25

# --- solver effort ----------------------------------------------------------------------------

CLOUD_REACH_M = (0.10, 0.06, 0.05)  # of correspondences, by round; tuned on the studio
# Factors of the keypoints' sigma in the first rounds, while the limbs are far off. Tuned on the
# studio.
WIDENED = (5.0, 2.0)
RECOVER_TRIALS = 10  # steps of a frame that jumped; tuned on the studio
# Frames whose whole surface is posed at once: memory.
FRAMES_POSED = 16
# Frames whose surface is kept for the next matching: a quarter megabyte each.
FRAMES_KEPT = 256

# --- decision ---------------------------------------------------------------------------------

# Priors on parameters that never change count so many times in every frame: their data's errors
# persist over frames. One frame of a shape of its own has 1. Tuned on the studio.
OFFSET_PRIOR_PER_FRAME = 0.3
SHAPE_PRIOR_PER_FRAME = 0.3
COVERING_PRIOR_PER_FRAME = 0.7
# Frames whose cost exceeds the median by this factor are tried turned around. Tuned on the studio.
TURN_WORSE = 1.5
# A jumped frame's new fit is kept if its cost is below factor * before + slack. Tuned on the
# studio.
RECOVERED_COST_FACTOR = 1.2
RECOVERED_COST_SLACK = 5.0
# m; what ten shape components cannot say about a person's joints: 1.3 mm in the mean over adults
# that the open body was not made from (docs/body.md), along one coordinate.
MODEL_SIGMA_M = 0.001
# m; half of the joints of this deviation are more than 40 mm off (MEDIAN_CHI_3), a bad body.
LARGEST_SIGMA_M = 0.026
# m; fingers lie 20 mm apart (anatomy): half of a hand's joints are then taken for a neighbour's.
LARGEST_HAND_SIGMA_M = 0.013
# Share of a part's keypoints beyond the robust scale from which the part is called wrong: most.
DISAGREEING_SHARE = 0.5
FACE_VISIBLE_SHARE = 0.5  # of the face's landmarks, by some view; tuned on the studio
# Of a part's samples, from which depth holds it: half of what one view sees of a limb, a third.
MEASURED_SHARE = 0.15
# m, along one coordinate: a limb seen by one view leans towards it or away, mirrored. The ends of a
# forearm are then up to 2 x 0.25 m apart, of a leg's segments 2 x 0.4 m, of a finger 2 x 0.08 m
# (anatomy); these are such distances in the mean square, judged, not measured.
MIRRORED_SIGMA_M = {"arm": 0.10, "leg": 0.15, "hand": 0.03}
# m, along one coordinate: a limb that no view bears out may be anywhere in its reach, a wrist
# 0.55 m from the shoulder, an ankle 0.85 m from the hip (anatomy). The linear covariance of prior
# and fit would state less.
UNSEEN_SIGMA_M = {"arm": 0.20, "leg": 0.25}
# Median error of the trunk's keypoints: not this person's body. Tuned on the studio.
WRONG_TRUNK_M = 0.06
BAD_BODY_M = 0.040  # m; mean error of the surface that the metrics call a bad body
