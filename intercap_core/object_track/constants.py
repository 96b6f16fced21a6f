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
# Standard deviation of how the velocity changes from one frame to the next, m/s and rad/s. Tuned on
# the studio.
ONSET_M_S, ONSET_RAD_S = 0.6, np.radians(60)
# A fit that ends so many of the prior's standard deviations away is fitted again with a prior this
# many times as wide: something set out or stopped.
PRIOR_CONTRADICTED, PRIOR_WIDENED = 1.5, 4.0
# From a wrist to the surface of what the hand may hold, metres: a hand's length.
HOLDING_REACH_M = 0.20
# Sine of the angle between a palm's two edges, below which it shows no turn; of hands about 0.3.
PALM_MIN_SINE = 0.1
# Share of the last step that may be missing or added in the next. Tuned on the studio.
ONSET_STEP_SHARE = 0.5
# Standard deviation added for every second that the object is not seen. Tuned on the studio.
GROWTH_LOST_M_S, GROWTH_LOST_RAD_S = 1.2, np.radians(240)
# Standard deviation of accelerations of a carried object (m/s^2, rad/s^2); a kick is an outlier.
# Tuned on the studio.
ACCELERATION_M_S2 = 6.0
ACCELERATION_RAD_S2 = 20.0
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
REDUCED_SILHOUETTE_PX = 80
REDUCED_DEPTH_PX = 60
MAX_REDUCTION = 4  # every n-th pixel at most
# Faces of the mesh that is rendered; kept within 0.5 mm of the full one (rigid.mesh).
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
# What moves less until a view exposes is drawn once for all: a quarter of the same.
UNMOVED_M, UNMOVED_RAD = 4e-4, np.radians(0.08)
FIT_DAMPING = 1e-3  # of the diagonal

# --- solver effort: the search of a frame --------------------------------------------------------

GRID_ROTATIONS = 240  # of a trivial group: about 40 degrees apart, inside the fit's basin
GRID_SPACING_DEG = 12.0  # equivalent rotations nearer than this are one; twice that with an axis
UPRIGHT_TURNS = 24  # about the vertical of the standing pose, 15 degrees apart
OUTLINE_DIRECTIONS = 16  # of the image in which a silhouette's reach is taken
OUTLINE_MIN_DEPTH_M = 0.1  # smaller depths are clamped to this: keeps divisions finite
ALIGNED_POINTS = 150  # of all views together
ICP_STEPS = 6  # iterations of the alignment
ICP_COARSE_STEPS, ICP_THINNED = 2, 3  # the first of them use every third point
ICP_KEPT = {1: 96, 3: 48}  # iteration to the number of rotations that go on after it
ICP_SCALES_M = (0.08, 0.015)  # Geman-McClure scale: the grid's error at a hand's width, the noise
ICP_MAX_TURN_RAD, ICP_MAX_SHIFT_M = np.radians(15), 0.05  # of a step
ICP_DAMPING = 1e-3  # of the diagonal
# Weight, and least residual in metres, of a measured point whose nearest face looks away from the
# camera, which cannot be. Tuned on the studio.
FACING_AWAY_WEIGHT = 0.1
FACING_AWAY_MIN_M = 0.01
ICP_MAX_RESIDUAL_M = 0.05  # residuals beyond count as this much
OUTLINE_ALIGNED_VIEWS = 2  # up to so many views silhouettes also align where depth measures
# Poses rendered after the alignment and fitted after that: with all rotations, and with few.
FULL_SEARCH, NEAR_SEARCH = (16, 3), (6, 2)
NEAR_TURN_SEARCH_RAD = np.radians(35)  # by which the rotations of a near search are apart
# Nats by which a start may be worse than a fit and still lead to a rival of it: an aligned pose
# gains up to 15 by its fit, or ends where the better one is (bottle to chair of the studio).
HOPELESS_LOG_RATIO = 15.0
OWN_TURN_STEPS = 12  # angles of a full turn about each axis of the best pose, compared with it
TURNS_FITTED = 3  # of them
MAX_GROUPS = 3  # groups of candidates that are searched
# Nats of a pose in a trusted place, above which less likely groups are not searched, and the prior
# of such a place. Tuned on the studio.
SEARCH_GOOD_LOG_RATIO, TRUSTED_PLACE = 25.0, 0.5

# --- solver effort: the track --------------------------------------------------------------------

SEED_SEARCHES = 3  # frames searched for the seed, more while nothing is found
SEED_SEARCHES_MAX = 10
ROUNDS = 15  # of deciding and of looking for more
SEARCHES_MIN, SEARCH_EVERY_S = 6, 0.5  # frames searched with all rotations, and one in this time
RUN_SEARCHED_S = 0.2  # that it is seen for, from which one of the frames is searched
# A frame in doubt is searched by the poses of frames no farther away, seconds, and within what a
# hand may have moved meanwhile, metres.
LOOK_NEAR_S, LOOK_NEAR_M = 0.3, 0.75
NEAR_FITTED = 3  # of these poses, until one is good
BASIN = (0.04, 15.0)  # metres and degrees from which a fit surely leads to one pose
UNSEEN_S = 0.8  # seconds that an object is followed without being seen
MAX_HYPOTHESES = 12  # of a frame: turns of a mug whose handle is hidden, 30 degrees apart
CROWDED = (0.04, 20.0)  # metres and degrees within which, of too many, the less likely one goes
TURNS_FOLLOWED = 2  # of a key frame
# What moves is fitted again where that changes by so much what a view sees, so many times at most.
MOTION_CHANGED_M, MOTION_CHANGED_RAD, MOTION_ROUNDS = 3e-3, np.radians(0.5), 3
ANNOTATION_FRAMES = 5  # by which an annotation's frame may be off
SURVEYED_FRAMES = 12  # looked at before tracking, spread over the recording
SURVEYED_GROUPS = 6  # groups of candidates in each of them
KEY_FRAME_S = 0.2  # seconds between the frames in which turns are compared
NEAR_TURN_STEPS = 12  # angles of a full turn that are tried for a near symmetry
NEAR_TURN_FINE_RAD = np.pi / NEAR_TURN_STEPS  # beside no turn, where a slow slide is caught first
NEAR_TURN_POINTS = 200  # of the surface
NEAR_TURN_ICP_STEPS = 5
NEAR_TURN_ICP_START = 6.0  # robust scale that placing starts from, over the last
NEAR_TURN_POINT_WEIGHT = 0.05  # of point-to-point beside point-to-plane residuals
REST_FRAMES_SEEN_AGAIN = 12  # frames of a rest that are looked at again
MAX_REST_FRAMES = 900  # tested against one pose
SMOOTH_STEPS = 12  # Gauss-Newton
TYPICAL_REACH_M = 0.03  # frames of a rest farther apart than this do not show one place
TYPICAL_SLACK = 0.1  # of the largest cost, within which the frame that knows most is typical
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

# --- decision: how likely an image is ------------------------------------------------------------

# Deviation of measured depth from the object's surface: systematic error, calibration, and the
# mesh's own error, metres. Tuned on the studio.
DEPTH_LIKELY_SIGMA_M = 0.008
# Measured this near to the room's own surface, metres, a pixel shows that: three such deviations.
BACKGROUND_M = 0.025
# Where the object is not, depth is measured anywhere within this range of where it would be.
CLUTTER_RANGE_M = 0.3
# Log of the share of a surface's pixels that the sensor looks past (flying pixels, edges), and of
# those that something other than a person hides.
LOG_SEEN_PAST, LOG_HIDDEN = float(np.log(0.03)), float(np.log(0.15))
# Log of how often a detector misses an object all of which is visible; half of that counts where
# so many pixels are visible.
LOG_MISSED, MISSED_HALF_PX = float(np.log(0.1)), 300
# Mean cost of an outline (half a squared normalised distance, at most the second) at which a mask
# says nothing: chance has outlines of that distance nearby.
MASK_AGREES, OUTLINE_COST_MAX = 2.0, 4.5
# What a view's depth, and its outline, count as at most, in independent samples; half of that at so
# many pixels of the outline. Tuned on the studio.
VIEW_SAMPLES, OUTLINE_HALF_SAMPLES_PX = 4.0, 60
LABEL_LOG_RATIO = 1.0  # of a candidate with the right label over one with another

# --- decision: colours of the surface ------------------------------------------------------------

PATCHES_ACROSS = 12  # of the object's diameter: a centimetre of a cup, two pixels at 3 m
STEEP_COSINE = 0.3  # of a surface to the ray, below which a pixel mixes patches
# What a view's colours count as at most, in independent samples; half of that at so many pixels.
COLOUR_SAMPLES, COLOUR_HALF_SAMPLES_PX = 2.0, 60
# Standard deviations in logarithms of light: of a view's exposure and white balance from frame to
# frame, of a camera's gain, and of the light's difference between one side and the other.
EXPOSURE_SIGMA, GAIN_SIGMA, SHADING_SIGMA = 0.1, 0.15, 0.4
# The same of measured colours at least: shadows and lamps that are no one side's light change the
# brightness more than the two ratios.
COLOUR_MIN_SIGMA = np.array([0.25, 0.08, 0.08])
COLOUR_RANGE = 2.0  # in logarithms of light: white to black paint
COLOURED_SHARE = 0.5  # of the noise's variance, which that of the surface's colours must exceed
COLOUR_COST_MAX = 4.5  # three standard deviations: what hides the object, a highlight
LEARNING_STEPS = 4  # of colours and gains in turns
LEARNING_FRAMES = 12  # from which colours are learnt, at most, and at least
LEARNING_FRAMES_MIN = 3
PAINT_EXPLAINS = 0.5  # share of the colours' variance that the mesh's own must explain to count
PAINT_LOOKS = 3  # independent ones at the mesh's own colours, however many frames there are
RIVAL_PROBABILITY = 0.01  # of a pose that colours are asked about, and that is seen in motion
# Probability of such a pose, below which it is left out where too few frames are certain with it.
WEAK_GAUGE = 0.05
GAUGES = 3  # poses of one frame to which others may be relative: learnt from each
SURE_PROBABILITY = 0.8  # of a pose, given that of one frame, from which to learn
COLOUR_EVERY_S = 1 / 15  # frames nearer than this show the same colours

# --- decision: which hypothesis is true (tuned on the studio) -------------------------------------

# Of the motion between frames, standard deviations: of what moves freely (a swing, a kick), and its
# cost in addition, nats a second, for hands and rest explain most of what is recorded; of fits of
# what stands; of what a hand holds against its palm: of fits and joints, and of slipping.
MOVING_M_S, MOVING_TURN_RAD_S, FREE_COST_S = 2.5, 7.0, 30.0
FREE_LASTING_S = 0.1  # over a longer step that costs no more: it may have rested meanwhile
STANDING_M, STANDING_RAD = 0.015, np.radians(8)
HELD_M, HELD_RAD, HELD_M_S, HELD_RAD_S = 0.02, np.radians(10), 0.3, 1.0
MODE_CHANGES_S = 1.0  # from each of these to another, in a second
# Minus log-likelihoods of a step that no motion explains, of the object going out of sight and of
# its coming back; of its leaving the room, or coming back to it, in addition.
JUMP_COST, VANISH_COST, APPEAR_COST, LEAVE_COST = 10.0, 7.0, 7.0, 4.0
# Of going where it cannot be reached between two sure frames, and of coming back: chance clutter is
# anywhere in a room, of which what can be reached is a hundredth. The reach: an error of either
# pose, and a thrown object's way.
EXCURSION_COST, REACH_M, REACH_M_S = 5.0, 0.2, 4.0
# Nats of one independent observation by which it is less likely to be hidden from all cameras than
# to be gone: gone is the likelier from about two seconds on.
ABSENT_LOG_RATIO = 1.0
# Nats that the images of one frame say for a pose: from which it is seen; from which it is good
# enough to start from or to stop a search; below which it is no hypothesis, and lost.
SEEN_LOG_RATIO, SEED_SURE_LOG_RATIO, CONTRADICTED_LOG_RATIO = 3.0, 40.0, -6.0
RIVAL_LOG_RATIO = 5.0  # nats of independent evidence below the best, up to which to follow
UPRIGHT_LOG_RATIO = (
    2.0  # times the cosine of the angle to its standing pose: few mugs are upside down
)
# Nats of one frame on its own for the pose that a person gave of it; and for all poses within reach
# of that one: as much as it costs to come there for that frame alone, from elsewhere or from none.
ANNOTATION_LOG_RATIO = 10.0
ANNOTATED_LOG_RATIO = 2 * (JUMP_COST + EXCURSION_COST)
UNDONE_LOG_RATIO = 10.0  # nats that a pose loses by the motion through it, and is hardly seen then
RELOOK_LOG_RATIO = 2.0  # nats by which a smoothed pose may be less likely and is looked at again
APART_M, APART_RAD = 0.05, np.radians(20)  # poses farther apart are quite different: lost
# Probabilities: of no hypothesis, from which a frame is lost; of quite different ones, from which
# it is ambiguous; of the chosen one, below which more is looked for.
LOST_PROBABILITY, AMBIGUOUS_PROBABILITY, DOUBTFUL_PROBABILITY = 0.5, 0.2, 0.9
GONE_PROBABILITY = 0.5  # of having left, from which a lost frame is told as such
# Of the usual nats, below which more is looked for near a pose, and elsewhere too.
DOUBTFUL_SHARE, HIDDEN_SHARE = 0.5, 0.25

# --- decision: which candidates may be the object ------------------------------------------------

# Extents, of the object's diameter, of a candidate that may be it, partly hidden or with something
# that it touches; a slack in metres. Tuned on the studio.
CANDIDATE_MIN_EXTENT, CANDIDATE_MAX_EXTENT, CANDIDATE_SLACK_M = 0.25, 1.4, 0.05
CLOUD_STRIDE = 2  # of the pixels of the reduced depth image that are looked at
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
SHARED_SIGHTINGS = 0.5  # share of a group's candidates in another one, up to which they are two

# --- decision: where in the room the object may be (tuned on the studio) -------------------------

# Places nearer than this share of the diameter and metres are one: views see now one side, now
# another.
SAME_PLACE_SHARE, SAME_PLACE_M = 0.3, 0.05
# Shares of the frames: always there, there for a while only.
ALWAYS_PRESENT, SOMETIMES_PRESENT = 0.85, 0.5
MOVED_PRIOR = 0.8  # of what was not in this place all the time, wherever the person is
UNHANDLED_LOG_RATIO = 10.0  # nats of a frame against what moves with nobody near
SUREST_PLACE = 1 - 1e-6  # prior of a place, at most: its log-odds have to end somewhere
MIN_PLACE_PRIOR = 0.1  # of what stands apart all the time
BESIDE_FRAMES = 2  # in which something stands there while the object is elsewhere: another thing
# Nats that a thing which is seen there too takes off what looks like the object in its place, at
# most: a part of furniture, not a twin that the track may have mistaken.
CLUTTER_LOG_RATIO = 10.0

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

# After tracking: the surest frames are fitted with meshes of other sizes, one of which must be
# better by so many nats a frame to be told. Of the studio a tenth costs most objects 20. Masks that
# are too small for all views make a bottle look a tenth smaller by 6, and a cup that is so costs no
# more: of so small an object it is not told. Those that are so much worse at the track's own poses
# are not fitted.
CHECK_FRAMES, CHECK_SCALES, CHECK_GAIN, CHECK_HOPELESS = 6, (0.9, 1.1), 8.0, 10.0
# Nats of all believed frames together, as so many independent looks as they are, below which the
# track is of nothing: what a detector takes for the object now and then reaches 8, the least of
# objects that are there, a cup behind a hand without depth, some 25. Tuned on the studio.
NOTHING_LOG_RATIO = 12.0
# Nats of half of the frames, below which the mesh is hardly that object: wrong meshes of like size
# have 5 to 19, right ones 40 to 100, a cup at twice the noise 14. Tuned on the studio.
LIKENESS_LOG_RATIO = 10.0

# --- decision: which of several poses (tuned on the studio) --------------------------------------

SAME_POSE_M, SAME_POSE_DEG = 0.02, 12.0  # poses nearer than this are one hypothesis
SAME_AXIS_COSINE = float(np.cos(np.radians(10)))  # principal axes nearer to the frame's are these
# A point of the surface that a turn moves farther, metres and share of the diameter, could be
# noticed; the share of such points below which a turn is hard to see; flips nearer than the angle
# are one.
NEAR_TURN_FAR_M, NEAR_TURN_FAR_SHARE = 0.003, 0.01
NEAR_TURN_CHANGED_SHARE = 0.3
NEAR_TURN_DISTINCT_DEG = 45.0

# --- decision: which poses are believed (tuned on the studio) ------------------------------------

# Standard deviations that are as good as lost: one frame in six would be off by more.
UNSURE_M, UNSURE_RAD = 0.035, np.radians(15)
# Standard deviations of a given pose, beyond what is one pose, at which another one contradicts it.
GIVEN_SIGMAS = 3.0
# Nats that a frame's images say against it, at which they contradict it clearly: two or three views
# see past it. One in which something else hides it says up to 6, and so much is chance. Chosen on
# five objects of the studio at noise 2, two cameras.
DENIED_LOG_RATIO = -25.0
# Nats of one view, from which it shows the object: half of what all together need.
VIEW_SHOWS_LOG_RATIO = SEEN_LOG_RATIO / 2
# Standard deviation of its place, metres, up to which a pose is carried from given ones through
# frames that show nothing: beyond, the joint fit bridges a lost object as well.
CARRIED_M = 0.15
# Out of sight for less, seconds, between poses that are as good as one: it stayed there.
BRIDGED_S = 0.3
# Nats by which a hand is likelier than any other way of what is lost, from which it surely has it:
# odds of seven to one. Free motion for longer than a moment costs 3 more, nobody seeing anything.
CARRIED_LOG_RATIO = 2.0
FREE_AXIS_SIGMA_RAD = np.radians(25)  # standard deviation of a turn of which nothing was seen
TOLD_SHARE = 0.5  # of the frames, from which a track's faults are told

# --- decision: rests and outliers of the track ---------------------------------------------------

# Costs, as minus log-likelihoods: of one observation's own pose (six numbers, each to be told from
# noise), of a frame without evidence, and of one more rest (its pose and where it begins and ends);
# of one that the recording's begin or end cuts, of which one end is known. Tuned on the studio.
MOVING_COST = 9.0
UNSEEN_MOVING_COST = 1.0
REST_COST, CUT_REST_COST = 8.0, 5.0
CUT_LONGER = 0.9  # of a frame's own pose, by which a longer one costs more, up to the whole
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
