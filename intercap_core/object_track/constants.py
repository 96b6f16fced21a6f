"""Numbers of the object's tracker by kind, each with its unit and its reason.

"Tuned on the studio" means: chosen so that synthetic recordings are tracked well, with no other
source; what such a number does on real recordings is known from bench and evaluation alone. Shares
have no unit. A pair of a length and an angle in one line is tested or applied together.
"""

from __future__ import annotations

import numpy as np

# --- sensor: masks -------------------------------------------------------------------------------

# Standard deviation of a detector's contour, pixels at full resolution. Tuned on the studio.
CONTOUR_SIGMA_PX = 2.0
# By how much the borders of two masks of one person differ, pixels at full resolution. Tuned on
# the studio.
MASK_BORDER_PX = 6.0
# A candidate that holds this share of the person's pixels holds the person. Tuned on the studio.
BLOB_PERSON_SHARE = 0.25
# Share of such a candidate's pixels that have to be left beside the person. Tuned on the studio.
BLOB_MIN_REST_SHARE = 0.01
# A silhouette's pixel this close to a person or the image's edge may be cut off there: pixels of
# the reduced image, one for the rounding of either mask.
OUTLINE_CUT_PX = 2
# A candidate is the person if more than this share of its pixels is on the person and it has the
# label, or more than PERSON_SIZED_SHARE of the person's pixels. Tuned on the studio.
ON_PERSON_SHARE = 0.6
PERSON_SIZED_SHARE = 0.3
# Errors of masks last about so long, seconds: frames closer than that are one observation. Tuned on
# the studio.
ERROR_LASTING_S = 0.3

# --- sensor: depth -------------------------------------------------------------------------------

# Standard deviation of one view's depth, metres: systematic ranging error and calibration, not
# pixel noise. Azure Kinect's data sheet states a systematic error below 11 mm + 0.1 % of the
# distance; half of that bound is a guess at its standard deviation.
DEPTH_SIGMA_M = 0.005
# Measured this much behind the render, metres: known background. Above the sensor's systematic
# error and the pose's own; tuned on the studio.
FREE_SPACE_M = 0.03
# A depth pixel off by this agrees by half, metres: about the data sheet's systematic error.
AGREEMENT_SCALE_M = 0.010
# A pixel measured farther from the render shows something else, metres; for reports only.
REPORT_DEPTH_M = 0.1
# Weight of a depth pixel at the rendered depth that the candidate leaves out; tuned on the studio.
OUTSIDE_MASK_WEIGHT = 0.3

# --- sensor: how much the pixels of a view say together ------------------------------------------

# The lambdas of equation 1: a view's pixels err together, so each term of a view counts as so many
# independent samples. Tuned on the studio.
DEPTH_SAMPLES = 4.0
CONTOUR_SAMPLES = 3.0
# The depth term of a view counts half of DEPTH_SAMPLES at so many pixels. Tuned on the studio.
DEPTH_HALF_SAMPLES_PX = 120
# Overlap (IoU) of candidate and render up to which the contour has the least weight, the range over
# which its weight grows to 1, and the least. Tuned on the studio.
CONTOUR_TRUST_OVERLAP, CONTOUR_TRUST_RANGE, CONTOUR_TRUST_MIN = 0.3, 0.4, 0.1
# Total variance of the views' errors (common and independent) over the independent part; the same
# of rotations: errors common to all views (calibration, masks that are too large) shift the object
# rather than rotate it. Tuned on the studio.
COMMON_ERROR_VARIANCE = 4.0
COMMON_TURN_VARIANCE = 1.5
# Variance of the views' errors over the stated one is taken as at least this: a few views may agree
# by chance. Tuned on the studio.
MIN_NOISE_VARIANCE = 0.05
# Independent looks at an object at rest, however long: errors of masks and calibration do not
# average out while nothing moves.
REST_SAMPLES = 1.0

# --- human and object motion ---------------------------------------------------------------------

# Distance of the object from a camera of a capture ring where nothing tells, metres.
TYPICAL_DISTANCE_M = 2.5
# Standard deviations of the pose around a prediction where none is given, metres and radians.
# Tuned on the studio.
PRIOR_SIGMA_M, PRIOR_SIGMA_RAD = 0.06, float(np.radians(15))
# Slower than this in a frame the object rests: no motion is predicted. Above the jitter of fits;
# tuned on the studio.
STILL_M, STILL_RAD = 0.004, np.radians(1.5)
# Standard deviation of a frame's motion from rest, metres and radians. Tuned on the studio.
ONSET_M, ONSET_RAD = 0.02, np.radians(5)
# Share of the last step that may be missing or added in the next. Tuned on the studio.
ONSET_STEP_SHARE = 0.5
# Standard deviation added for every lost frame: 1.2 m/s at 30 Hz. Tuned on the studio.
GROWTH_LOST_M, GROWTH_LOST_RAD = 0.04, np.radians(8)
# Standard deviation of accelerations of a carried object (m/s^2, rad/s^2); a kick is an outlier.
# Tuned on the studio.
ACCELERATION_M_S2 = 6.0
ACCELERATION_RAD_S2 = 20.0
# Standard deviation of speeds between frames, where a sequence of hypotheses is chosen: a hand that
# carries something moves at about 1.5 m/s, 4 rad/s. Tuned on the studio.
SEQUENCE_SPEED_RAD_S, SEQUENCE_SPEED_M_S = 4.0, 1.5
# Drift of a tracked rotation from the true one in a second, standard deviation. Tuned on the
# studio.
SLIDE_RAD_S = np.radians(80)
# Motion in one frame that no hand can cause: 4.5 m/s at 30 Hz.
JUMP_M, JUMP_DEG = 0.15, 45.0
# Shortest rest, seconds. Tuned on the studio.
MIN_REST_S = 0.25
# Frames within which an object cannot move away and back: a tenth of a second at 30 Hz.
BLIP_FRAMES = 2
# Distance from the nearest joint to the object's surface, metres: within reach, and out of reach.
# Tuned on the studio.
AT_HAND_M, OUT_OF_REACH_M = 0.10, 0.45
# Quantile, over frames, of the distance to the person that counts as their approach: nobody is near
# the object all the time. Tuned on the studio.
NEAREST_QUANTILE = 0.1

# --- solver effort: images -----------------------------------------------------------------------

# The object is compared at about this many pixels across: more cost time and carry no more
# information, since neighbouring pixels of a mask or a depth image err together.
REDUCED_SILHOUETTE_PX = 110
REDUCED_DEPTH_PX = 80
MAX_REDUCTION = 4  # every n-th pixel at most
# Faces of the mesh that is rendered; kept within 0.5 mm of the full one (rigid.constants).
TRACKING_FACES = 600
# Bytes of views kept: 90 frame sets of six unreduced depth images, 360 of a suitcase's.
VIEW_CACHE_BYTES = 800_000_000
# The pose may move this far before measured points leave the patch, metres: farther than a fit's
# first scale.
PATCH_MARGIN_M = 0.08

# --- solver effort: the fit of a frame -----------------------------------------------------------

# Geman-McClure scales, first and last: from the size of a start's error to a few standard
# deviations of the noise. Metres; pixels at full resolution. Tuned on the studio.
DEPTH_SCALES_M = (0.050, 0.012)
CONTOUR_SCALES_PX = (30.0, 6.0)
SCALE_SHRINKAGE = 0.5  # of the scales from step to step
GATE_SCALES = 2.5  # correspondences farther than this many robust scales weigh below 2 %: left out
REPORT_CONTOUR_SCALE = 4.0  # times the last contour scale: residuals that a report counts
FIT_ROUNDS = (4, 5)  # Gauss-Newton steps at most after each choice of candidates, from a far start
PASS_ROUNDS = (3, 3)  # the same from the frame before
PASS_SCALE = 0.5  # of the first robust scales, from the frame before
FIT_MAX_STEP_M, FIT_MAX_STEP_RAD = 0.06, np.radians(20)  # of a Gauss-Newton step
FIT_CONVERGED_M, FIT_CONVERGED_RAD = 5e-4, np.radians(0.1)  # 0.2 px of 1080p at 2.5 m
# A pose this near to the one drawn last is a quarter of a pixel off: steps on from the same
# renderings, whose residuals are linear in so small a motion.
REDRAWN_M, REDRAWN_RAD = 1.5e-3, np.radians(0.3)
FIT_DAMPING = 1e-3  # of the diagonal

# --- solver effort: the search of a frame --------------------------------------------------------

GRID_ROTATIONS = 240  # of a trivial group: about 40 degrees apart, inside the fit's basin
GRID_SPACING_DEG = 12.0  # equivalent rotations nearer than this are one; twice that with an axis
UPRIGHT_TURNS = 24  # about the vertical of the standing pose, 15 degrees apart
OUTLINE_DIRECTIONS = 16  # of the image in which a silhouette's reach is taken
OUTLINE_MIN_DEPTH_M = 0.1  # smaller depths are clamped to this: keeps divisions finite
ALIGNED_POINTS = 150  # of all views together
ICP_STEPS = 6  # iterations of the alignment
ICP_SCALES_M = (0.08, 0.015)  # Geman-McClure scale: the grid's error at a hand's width, the noise
ICP_MAX_TURN_RAD, ICP_MAX_SHIFT_M = np.radians(15), 0.05  # of a step
ICP_DAMPING = 1e-3  # of the diagonal
# Weight, and least residual in metres, of a measured point whose nearest face looks away from the
# camera, which cannot be. Tuned on the studio.
FACING_AWAY_WEIGHT = 0.1
FACING_AWAY_MIN_M = 0.01
ICP_MAX_RESIDUAL_M = 0.05  # residuals beyond count as this much
OUTLINE_ALIGNED_VIEWS = 2  # up to so many views silhouettes also align where depth measures
SEARCH_COMPARED = 16  # poses rendered after ICP
SEARCH_FITTED = 6  # poses fitted after rendering
OWN_TURN_STEPS = 12  # angles of a full turn about each axis of the best pose, compared with it
TURNS_FITTED = 4  # of them
MAX_GROUPS = 3  # groups of candidates that are searched
SEARCH_GOOD_VALUE = (
    0.55  # value above which less likely groups are not searched; tuned on the studio
)

# --- solver effort: the track --------------------------------------------------------------------

# Searches of a pass are due after so many frames in doubt, and then every SEARCH_EVERY_FRAMES.
RECOVERY_WAIT_FRAMES = (0, 2, 5, 9, 14, 20, 30, 45, 60)
SEARCH_EVERY_FRAMES = 30
SEARCHES_MAX = 12  # that find nothing, and one more in SEARCH_EVERY_FRAMES: a pass must end
SEED_SEARCHES = 3  # frames searched for the seed, more while nothing is found
SEED_SEARCHES_MAX = 10
SEED_RIVALS = 5  # hypotheses of the seed frame, compared over its neighbours
SEED_RIVAL_FRAMES = 3  # neighbours on each side
ANNOTATION_FRAMES = 5  # by which an annotation's frame may be off
SURVEYED_FRAMES = 12  # looked at before tracking, spread over the recording
SURVEYED_GROUPS = 6  # groups of candidates in each of them
AUDIT_WINDOW_FRAMES = 12  # one search in each
# Audits of a recording, the least sound windows first; of a long one, one in so many frames.
AUDITS_MIN, AUDIT_EVERY_FRAMES = 8, 45
WEAK_FRAME_TURN_RAD = np.radians(25)  # by which the starts of a weakly seen frame are turned
WEAK_FRAME_FITS = 2  # of the turned starts, fitted beside the pose itself
KEY_FRAME_S = 0.2  # seconds between the frames in which turns are compared
NEAR_TURN_STEPS = 12  # angles of a full turn that are tried for a near symmetry
NEAR_TURN_FINE_RAD = np.pi / NEAR_TURN_STEPS  # beside no turn, where a slow slide is caught first
NEAR_TURN_POINTS = 500  # of the surface
NEAR_TURN_ICP_STEPS = 8
NEAR_TURN_ICP_START = 6.0  # robust scale that placing starts from, over the last
NEAR_TURN_POINT_WEIGHT = 0.05  # of point-to-point beside point-to-plane residuals
REST_FRAMES_SEEN_AGAIN = 12  # frames of a rest that are looked at again
MAX_REST_FRAMES = 900  # tested against one pose
SMOOTH_STEPS = 12  # Gauss-Newton
SMOOTH_CONVERGED = np.repeat([1e-5, 1e-6], 3)  # rad, metres
SMOOTH_MAX_TURN_RAD = 0.5  # of a step
INVERTED_NODES, INVERTED_MARGIN = 64, 40  # nodes inverted at once, and neighbours that matter

# --- decision: what a view says ------------------------------------------------------------------

MIN_RENDERED_PX = 12  # fewer rendered pixels say nothing
MIN_CONTOUR_MATCHES = 3  # correspondences of a contour
SUPPORTING_PX = 36  # visible pixels from which depth alone may support a pose ...
SUPPORTING_AGREEMENT = 0.5  # ... that it agrees with by more than this. Tuned on the studio
LIKELY_LABEL_BONUS = 0.05  # of overlap: breaks ties between candidates. Tuned on the studio
ASSESS_MIN_OVERLAP = 0.1  # of a candidate that a pose is compared with, before it is fitted
SEARCH_MIN_OVERLAP = 0.2  # of a candidate that a searched pose is fitted to, at most

# --- decision: which candidates may be the object ------------------------------------------------

# Extents, of the object's diameter, of a candidate that may be it, partly hidden or with something
# that it touches; a slack in metres. Tuned on the studio.
CANDIDATE_MIN_EXTENT, CANDIDATE_MAX_EXTENT, CANDIDATE_SLACK_M = 0.25, 1.4, 0.05
SIGHTING_MIN_POINTS = 15  # of a candidate's cloud, or pixels of its mask
CLOUD_MAX_SPREAD = 0.75  # of the diameter, from a candidate's centre to its points
CLOUD_PERCENTILE = 90  # of its points' distances from the centre, compared with that
# Measured centres of one object's two sides are nearer than this share of the diameter. Tuned on
# the studio, as the others of this block.
SAME_OBJECT_SHARE = 0.6
GROUP_SLACK_M = 0.03  # added to all sizes that groups are tested by
RAY_MISS_SHARE = 0.35  # of the diameter: a ray through a mask's middle from the object's
# Width of a mask over the diameter, in the object's place: seen end on, half hidden; smeared.
OUTLINE_MIN_WIDTH, OUTLINE_MAX_WIDTH = 0.12, 1.25
OTHER_LABEL_PRIOR = 0.5  # of a candidate with another class's label; detectors err
NO_LABEL_PRIOR = 0.8  # of one that no detector named
NEAR_COST_PER_M = 2.0  # of a group away from where the object was seen, in labelled candidates
SHARED_SIGHTINGS = 0.5  # share of a group's candidates in another one, up to which they are two

# --- decision: where in the room the object may be (tuned on the studio) -------------------------

# Places nearer than this share of the diameter and metres are one: views see now one side, now
# another.
SAME_PLACE_SHARE, SAME_PLACE_M = 0.3, 0.05
# Shares of the frames: always there, there for a while only.
ALWAYS_PRESENT, SOMETIMES_PRESENT = 0.85, 0.5
MOVED_PRIOR = 0.8  # of what was not in this place all the time, wherever the person is
MIN_PLACE_PRIOR = 0.1  # of what stands apart all the time
BESIDE_FRAMES = 2  # in which something stands there while the object is elsewhere: another thing

# --- decision: the mesh's size -------------------------------------------------------------------

SIZE_CHECK_SETS = 6  # frame sets that are looked at, spread over the recording
SIZE_CHECK_STRIDE = 3  # of the depth pixels
SIZE_CHECK_MIN_POINTS = 8  # depth pixels under a mask
SIZE_CHECK_MIN_MASKS = 5  # fewer do not tell a size; tuned on the studio
# A mask is smaller than the object where that is seen end on or hidden by a hand, and larger where
# it also covers the person; most are neither, and a wrong unit is a factor of ten.
SIZE_DOUBTFUL_RATIO = 4.0
# Percentiles of the extents that say how large and how small it may be.
SIZE_LARGEST_PERCENTILE, SIZE_SMALLEST_PERCENTILE = 90, 25
LABELS_TOLD = 8  # labels named in a warning

# --- decision: which of several poses (tuned on the studio) --------------------------------------

SAME_POSE_M, SAME_POSE_DEG = 0.02, 12.0  # poses nearer than this are one hypothesis
STANDING_BONUS = 0.03  # of confidence, where the object stands
STANDING_COSINE = float(np.cos(np.radians(12)))  # of the angle between its z axis and the vertical
CLEARLY_BETTER = 1.15  # times the value, for which another frame or pose is preferred
SEED_SURE_VALUE = 0.65  # good enough to stop looking for a better seed frame
SEED_RIVAL_SHARE = 0.80  # of the best hypothesis' value
LEAP_COST_PER_M, LEAP_MAX_COST_M = 0.1, 0.1  # of value, for a searched pose away from the last one
LEAP_COST_HALF_TURN, LEAP_MAX_COST_TURN = 0.05, 0.05  # the same for a turn of 180 degrees
PASSES_AGREE_M, PASSES_AGREE_DEG = 0.02, 10.0  # passes farther apart differ
# By how much the mean score of one pose has to be better than another's, over all frames of a long
# run and over one: errors of masks last several frames and agree over views.
DECIDED_RUN, DECIDED_FRAME = 0.01, 0.03
SEQUENCE_SCORE_SIGMA = 0.02  # standard deviation of a frame's score, between poses of one fit
SEQUENCE_MAX_MOTION_COST = 6.0  # minus log-likelihood of a motion that is none
TURN_SCORE_SIGMA = 0.01  # of a key frame's score's difference between a turn and none
# Factor of TURN_SCORE_SIGMA for a correction by a right angle or more, not for flagging a frame:
# the scores of distant poses have independent errors, correlated over more than one key frame.
# Tuned on the studio.
TURN_APART_FACTOR = 2.5
# Minus log-likelihood of any change of the chosen rotation: in a tracked stretch, and where the
# track was lost.
TURN_JUMP_COST, TURN_BROKEN_COST = 10.0, 1.0
TURN_MAX_LOSS = 0.01  # of the score, that a turn may cost a run of frames which others decide
SAME_AXIS_COSINE = float(np.cos(np.radians(10)))  # principal axes nearer to the frame's are these
# A point of the surface that a turn moves farther, metres and share of the diameter, could be
# noticed; the share of such points below which a turn is hard to see; flips nearer than the angle
# are one.
NEAR_TURN_FAR_M, NEAR_TURN_FAR_SHARE = 0.003, 0.01
NEAR_TURN_CHANGED_SHARE = 0.3
NEAR_TURN_DISTINCT_DEG = 45.0
AUDIT_RIVAL_MARGIN = 0.03  # of the value: a found pose this much worse is a rival
AUDIT_NEAR_TURN_DEG = 20.0  # from a turn that hardly changes the object
AUDIT_DIFFERENT_M, AUDIT_DIFFERENT_DEG = 0.05, 30.0  # poses of which one must be wrong
AUDIT_NEIGHBOURS = 3  # frames on each side, whose images decide together

# --- decision: which poses are believed (tuned on the studio) ------------------------------------

LOST_SCORE = 0.20  # below, a pose is lost
DOUBTFUL_SCORE = 0.55  # of the usual score: below, a search may find better
WEAK_SCORE = 0.8  # of the usual score: below, a frame is weakly seen
USUAL_SCORE_RATE = 0.1  # of the running mean of the scores, a frame
RECOVERY_VALUE = 0.40  # of a searched pose that is believed, with a ring of cameras ...
RING_VIEWS = 6  # ... of so many; one camera less doubles what may agree by chance
RECOVERY_NAMED_VIEWS, RECOVERY_VIEWS_EACH = 2, 3  # views with a candidate, and of so many each
NEAR_LAST_PLACE_M = 0.4  # farther from where the object was it needs RECOVERY_NAMED_VIEWS
UNSURE_M, UNSURE_RAD = 0.03, np.radians(15)  # standard deviations that are as good as lost
# Frames that the object is followed without any candidate, and metres that it may have moved then.
UNNAMED_FRAMES, UNNAMED_M = 4, 0.05
SOUND_VIEWS, SOUND_AGREEMENT = 3, 0.8  # views that agree this well, in mask and depth: no audit
QUITE_DIFFERENT_RAD = np.radians(20)  # turns farther apart may make a frame ambiguous
AMBIGUOUS_PROBABILITY = 0.35  # of quite different turns, from which a frame is ambiguous
RELOOK_MIN_SCORE = 0.97  # of the score, below which a smoothed pose is not where to look again
FOUND_AGAIN_SCORE = 0.7  # of the usual score, with which a lost frame is found between neighbours
FREE_AXIS_SIGMA_RAD = np.radians(25)  # standard deviation of a turn of which nothing was seen
TOLD_SHARE = 0.5  # of the frames, from which a track's faults are told

# --- decision: rests and outliers of the track ---------------------------------------------------

# Costs, as minus log-likelihoods: of one observation's own pose (six numbers, each to be told from
# noise), of a frame without evidence, and of one more rest (its pose and where it begins and ends).
# Tuned on the studio.
MOVING_COST = 9.0
UNSEEN_MOVING_COST = 1.0
REST_COST = 8.0
REST_MAX_DISTANCE = np.repeat([0.35, 0.10], 3)  # rad, metres: farther away no rest is tested
# Bounds of the measured variance of resting estimates, times the stated one. Tuned on the studio.
REST_VARIANCE_BOUNDS = (0.5, 2.0)
# Squared normalised distances (chi square, 6 degrees of freedom: mean 6, 95 % below 12.6): of a
# rest's first or last frame that has set out; of poses that are one, and of poses that are not.
REST_EDGE_SQUARED = 9.0
BLIP_SAME_SQUARED, BLIP_APART_SQUARED = 10.0, 25.0
IMPACT_SIGMAS = 3.0  # accelerations beyond so many standard deviations count as an impact
OUTLIER_SIGMAS = 5.0  # evidence this many standard deviations away counts a quarter
# Standard deviations (rad, metres) of what nothing shows: a uniform angle; a room.
UNKNOWN_SIGMA = np.repeat([np.pi / np.sqrt(3), 1.0], 3)
