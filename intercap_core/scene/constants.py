"""Numbers of the room ``scene``, by kind: sensor, calibration, human motion, detector, effort,
decision.

Where no source stands, a number is tuned on the studio ("tuned"): on rendered recordings whose
truth is known. Pixels "at 1080p" are scaled by image height (:func:`.triangulation.pixel_scale`).
"""

from __future__ import annotations

import numpy as np

# --- sensor -----------------------------------------------------------------------------------

# Samples of one pixel agree within this: three standard deviations of the sensor's random error,
# about 1 mm + 0.1 % of depth, more at 4 m (Toelgyessy et al., Sensors 21(2):413, 2021, NFOV).
BACKGROUND_AGREE_MM = 8.0
BACKGROUND_AGREE_PER_DEPTH = 0.004  # of depth
# A pixel nearer than the background by this much is foreground: above the systematic error of
# 11 mm + 0.1 % of depth (Azure Kinect DK data sheet) and its noise; margin tuned on the studio.
BEFORE_BACKGROUND_MM = 40.0
BEFORE_BACKGROUND_SHARE = 0.012  # of depth
BACKGROUND_MAX_DEPTH_M = 5.0  # beyond, the depth's error is past a centimetre
MOVING_MAX_DEPTH_M = 4.0  # beyond, the depth's error is past what a body moves between sets
# Base line of a normal, one way: 4 px of the unbinned narrow depth camera (f = 504 px); tuned on
# the studio: shorter is noise, longer crosses edges.
NORMAL_STEP_RAD = 0.008
MAX_KINK_M_PER_M = 0.008  # per depth, off the neighbours' mean: an edge; tuned on the studio
MIN_VIEW_COSINE = 0.26  # 75 degrees: time-of-flight degrades at grazing angles; tuned on the studio
SURFACE_SIGMA_FLOOR_M = 0.003  # of point-to-plane residuals; tuned on the studio
FLOOR_SIGMA_M = 0.005  # floors are not flat and depth is biased; tuned on the studio
GRAVITY_CONE_DEG = 10.0  # of an accelerometer and its mounting, on a tripod; a bound, no data sheet

# --- calibration: how far off given poses, lenses and times are -----------------------------------

# Prior on the start of the registration: errors of a careful calibration; tuned on the studio.
PRIOR_TRANSLATION_M = 0.01
PRIOR_ROTATION_RAD = np.radians(0.5)
PRIOR_BIAS_M = 0.003  # systematic depth error is at most 11 mm + 0.1 % (Azure Kinect DK data sheet)
# Variance of refined poses and biases over that of the normal equations: the points of a surface
# share errors of its lens and its material. Tuned on the studio.
COVARIANCE_INFLATION = 3.0
PRIOR_OFFSET_S = 0.01  # synchronised devices expose within a third of a period of 1/30 s
# Of the poses as they are given, beside the offsets in the keypoints' equations: rotation, rad, and
# translation, m. Tuned on the studio.
POSE_SIGMA = np.r_[np.full(3, np.radians(1.0)), np.full(3, 0.02)]
OFFSET_SIGMA_S = 0.05  # prior of an offset, told by keypoints alone; tuned on the studio
# Poses by a rig's own calibration, without what happened to the tripods since: for cameras whose
# lenses keypoints alone can judge. Tuned on the studio.
CALIBRATION_ROTATION_SIGMA = np.radians(0.3)
CALIBRATION_TRANSLATION_SIGMA_M = 0.006
STATED_UP_CONE_DEG = 10.0  # of a calibration's axis from the floor's normal: a board laid on it
CAMERA_UP_CONE_DEG = 40.0  # of the mean of the cameras' own up directions; tuned on the studio
LEVER_M = 2.5  # from a camera to what it looks at, in a ring: turns a rotation into metres

# --- human motion ---------------------------------------------------------------------------------

# By how much an image is late. What holds it back is a queue, of some images, or a computer that is
# busy, for some time: slips of 1 to 4 images at 30 a second occur in InterCap's recordings, and the
# greater of the two counts at other rates.
MAX_SLIP_FRAMES, MAX_SLIP_S = 4, 4 / 30
MAX_PATH_GAP_S = 0.35  # over which a path is carried on without sight; tuned on the studio
MOVING_SEARCH_M = 0.15  # from one set to the next: 2 m/s at 15 sets a second
FOOT_HEIGHT_M = 0.014  # of the lowest of heel and toe keypoints: the open body's, standing
FOOT_TOLERANCE_M = 0.05  # feet that differ by more do not stand on one floor; tuned on the studio
MIN_FOOT_SPREAD_M = 0.15  # standard deviation, of feet that show a tilt; tuned on the studio

# --- detector: how keypoints err ------------------------------------------------------------------

MIN_CONFIDENCE = 0.3  # below, keypoints are left out; tuned on the studio
LOOSE_PX_AT_1080P = 40.0  # agreement of views whose poses are a centimetre off; tuned on the studio
SLIPPED_PX_AT_1080P = 60.0  # as above, of slipped views of moving limbs; tuned on the studio
# Median over the body of somebody seen a while ago: biases of joints, poses not yet refined, half
# a frame of motion; tuned on the studio.
SAME_PERSON_PX_AT_1080P = 45.0
KEYPOINT_SIGMA_FLOOR_PX = 3.0  # of reprojection with each joint's bias in; tuned on the studio
MOTION_SIGMA_FLOOR_PX = 1.0  # at 1080p, with the bias taken off; tuned on the studio
OUTLIER_SIGMA = 4.0  # beyond, a residual is an outlier; tuned on the studio
ROBUST_SIGMA = 3.0  # scale of Geman and McClure's function, standard deviations; tuned
KEYPOINT_ERROR_TIME_S = 0.5  # how long an error at one joint lasts; tuned on the studio
# The noise over time is chosen from these by likelihood; a short list tuned on the studio.
ERROR_LENGTHS_S = {"rough": (0.2, 0.5, 1.0), "smooth": (0.15, 0.3, 0.6)}
FAST_SHARES = (0.03, 0.1, 0.25, 0.6)  # of the variance that is new in each image
CONSTANT_VARIANCE = 100.0  # of a series' constant part, of its own scatter: free in effect
MISSING_VARIANCE = 1e6  # of a sample that is not there: no weight in effect
VIEW_BIAS_VARIANCE = 2.0  # of a joint's constant error in a view, over its scatter's; tuned
TIMING_INFLATION = 2.0  # of sigmas: keypoints of one person err together; tuned on the studio
SPEED_ERROR = 0.08  # of an offset: paths are smoothed too much or too little; tuned on the studio

# --- solver effort --------------------------------------------------------------------------------

MAX_SAMPLES = 25  # sets of the background; bounds memory: this many depth images of one camera
BACKGROUND_CELL_M = 0.03  # of thinned surfaces
MOVING_CELL_M = 0.02  # of thinned moving surfaces; tuned on the studio
MOVING_MOMENTS = 16  # frame sets looked at, each with the one before and the one after
MOVING_SEARCHES = 3  # nearest neighbours until the displacement along the normal settles
NEIGHBOUR_PIXEL_STEP = 2  # every second pixel of the neighbouring sets, both ways, is enough
PERSON_MASK_REDUCTION = 8  # the person's mask is worked out on every eighth pixel
PAIR_QUERIES = 2500  # points of one camera that are sought in another, over all moments
HELD_OUT_EVERY = 4  # of each surface's cells, one judges instead of taking part
MOMENTS_APART_M = 10.0  # in the search tree's fourth axis: farther than any search
SURFACE_SEARCH_M = 0.12  # distance to the nearest cell, beyond the widest gate
# Gates on the distance to the plane, one an iteration, annealed; tuned on the studio.
GATES_M = (0.08, 0.05, 0.03, 0.02, 0.015, 0.015, 0.015)
HELD_GATES_M = (0.08, 0.04, 0.04)  # where the poses are held
CONVERGED_M = 0.001  # the last step's motion of what a camera looks at
POINT_STEPS = 2  # Gauss-Newton steps of keypoints' points before each of the cameras'
MAX_FLOOR_POINTS = 1000  # of a camera, in the common floor's constraint
FLOOR_HYPOTHESES = 400
FLOOR_HYPOTHESIS_POINTS = 6000  # on which they are judged
FLOOR_REFINE_STEPS = 8
MOTION_ROUNDS = 3  # of smoothing and refitting the keypoints' paths
WINDOW_SETS = 96  # covariances over time are dense within a window, none reaches beyond it
SLIP_ROUNDS = 12  # at most: each takes the best intervals and looks again
STIFFNESS = 10.0 ** np.arange(-3, 4)  # of third differences between sets, tried by likelihood
# Likelihood takes errors that last for motion; this much more stiffness is closest to no bias of
# the speeds, to either side. Tuned on the studio.
STIFFER = 4.0

# --- decision: background and surfaces ------------------------------------------------------------

STEADY_SHARE = 0.2  # of a pixel's samples that must agree; tuned on the studio
# A pixel that often measures nothing looks past the scene: what it holds now and then, however
# steadily, may have come by. There nearly all of it must agree. Tuned on the studio.
OFTEN_VALID = 0.75
VALID_AGREE = 0.8  # of such a pixel's valid samples
STATIC_SHARE = 0.5  # above this the pixel shows background most of the time
MIN_NORMALS_COSINE = 0.85  # 32 degrees: one surface's normals in two views; tuned on the studio
# Of the weight that two cameras' background has in the registration, one direction of normals has
# at most this share; others gain at most this factor. Normals within 20 degrees are one direction.
# Tuned on the studio.
MAX_DIRECTION_SHARE, MAX_DIRECTION_GAIN, DIRECTION_COSINE = 0.8, 3.0, 0.94
MIN_PAIR_POINTS = 60  # fewer correspondences are chance; tuned on the studio
# Neighbouring residuals err together (lens, multipath, bias): a pair of cameras counts as at most
# this many independent measurements each way. Tuned on the studio.
STATIC_EFFECTIVE_POINTS = 10.0
MOVING_EFFECTIVE_POINTS = 50.0  # over many moments and places

# --- decision: poses ------------------------------------------------------------------------------

MIN_BODY_POINTS = 50  # fewer do not constrain a rig; tuned on the studio
# Two views of a larger rig say little of their own relative pose; of a rig of two they are all that
# there is: five of its six freedoms, the prior holds the distance.
MIN_BODY_VIEWS = 3
MUST_IMPROVE = 0.98  # of the start's held-out cost, in one group at least; tuned on the studio
MAY_WORSEN = 1.02  # in any group
# By how many standard deviations a camera's refined pose has to be better than its given one; the
# least spread, of log ratios, that errors of units are taken to have. Tuned on the studio.
CHANCE_SIGMA, LEAST_UNIT_SPREAD = 2.0, 0.25
DOUBTFUL_RATIO = 0.5  # of refined over given errors: above it a camera gets a second look
WEAK_CAMERA_M = 0.010  # a camera that may slide by more is told
WEAK_POINTS = 120  # held-out correspondences of a pair, background and moving together
WEAK_RESIDUAL = 2.0  # times the median pair's
KNOWN_OFFSET_SIGMA_S = 0.008  # less certain than what devices are off by: not known

# --- decision: floor ------------------------------------------------------------------------------

FLOOR_COSINE = 0.94  # 20 degrees: of a floor point's normal with the plane's; tuned on the studio
NEAR_FLOOR_M = 0.06  # of the floor at poses that are not yet refined; tuned on the studio
FLOOR_FIRST_GATE_M = 0.06  # of the plane's refinement, closing to the setting's tolerance
MIN_FLOOR_POINTS = 200  # of a camera's 3 cm cells: a fifth of a square metre
FLOOR_EFFECTIVE_POINTS = 10.0  # of one camera: its errors are those of its lens and bias
FLOOR_HYPOTHESIS_TOLERANCE_M = 0.03  # inliers of a hypothesis of the floor; tuned on the studio
BELOW_FLOOR_M = 0.10  # a point this far under the plane speaks against it; tuned on the studio
BELOW_FLOOR_COST = 3.0  # how many inliers such a point outweighs; tuned on the studio
MIN_FLOOR_AREA_M2 = 0.5  # tuned on the studio
LOWER_FLOOR_DEG = 3.0  # of a lower floor from a platform: both are level
COVER_CELL_M = 0.15  # in which a surface above another one hides it
MAX_COVERED_SHARE = (
    0.5  # of a lower floor: with more it is the upper one, seen by a misplaced camera
)
LEVEL_SHARE = 0.15  # of the sets: feet that make a level of their own; a bound, not tuned
MAX_SLOPE_DEG = 15.0  # of one tilted plane under all feet; treads of 12 by 40 cm climb by 17
# How far a measured floor may be from what is stated of the calibration's world before it is said:
# a board is laid by hand and is a few centimetres thick, feet tell a tilt to about 3 degrees.
STATED_UP_DEG = 4.0
STATED_FLOOR_M = 0.06
FEET_TILT_DEG = 6.0  # twice what feet that have been apart tell a tilt to
WRONG_UP_DEG = 60.0  # another axis is 90 degrees away; who bends for long leans by less
MIN_TRUNK_SETS = 5  # that show neck and hips
MIN_FOOT_SETS = 5  # sets with feet seen, for a floor; tuned on the studio

# --- decision: offsets and slips ------------------------------------------------------------------

MIN_TIMING_SETS = 8  # fewer tell no time
KEYPOINT_OFFSET_KNOWN_S = 0.02  # sigma, from keypoints alone: less certain is not known
MIN_PATH_SAMPLES = 6  # of a path through third differences, and a few to spare
MIN_VALID_SHARE = 0.9  # of a series that helps to choose the noise
# Log likelihood without the keypoints that gain most: limbs that a detector confuses fit a slip by
# chance, but never all over the body. Chance finds are short: what is beyond doubt depends on how
# many sets say it. Tuned on the studio.
MIN_SLIP_GAIN = 15.0
MIN_SLIP_GAIN_OF_SET = 60.0  # over the number of sets
SLIP_LEFT_OUT = 4  # keypoints
SLIP_GAIN_PER_SET = 1.0  # a set must bring this much to belong to an interval
CLEAR_SLIP_GAIN = 10.0  # of an interval over the whole recording's being late
SLIP_WORTH = 0.2  # of the best interval's gain makes another worth taking at once
SLIPS_APART_S = 1.0  # nearer in time, one slip may have brought about another
MAX_START_S = 1.5  # cameras are started by hand or by one command that reaches them in turn
MAX_START_SHARE = 0.4  # of the recording: less in common tells little; tuned on the studio
MIN_SHARED_S = 1.0  # that two cameras must both have recorded, to tell when they started
MAX_PEOPLE = 3  # of an image, the surest
LINK_SLACK_RAD = 0.05  # scatter of a person's middles between images; a detector's few pixels
EPIPOLAR_PX_AT_1080P = (
    6.0  # what two views of one moment disagree by, over time; tuned on the studio
)
# A camera started apart if views agree better so than as they are, and than at any time that is not
# near: in most blocks of time, by so many standard errors of their mean, and by a share of how much
# they disagree anyway. Tuned on the studio.
START_BLOCK_S, START_BLOCKS_SHARE, START_SIGMAS, START_WORSE = 0.3, 0.7, 3.0, 0.2
CLEAR_SIGMAS, START_PEAK_S, FEWEST_SETS_APART, FEWEST_BLOCKS = 1.0, 0.15, 2, 4
START_ROUNDS = 5
# Of what is stated of a start and what keypoints say, together: beyond, they are followed. With a
# smaller number one honest statement in some thousand would be overruled, and told.
DENIED_SIGMAS = 4.0
# Of starts by the sound: within, images whose times are in step are left so. Of five cameras in
# step one exceeds it in one recording of 75.
IN_STEP_SIGMAS = 3.0
LITTLE_ADDED = 0.5  # of a stated deviation that is left: the start rests on what was stated
SLOWER_SETS = 1.5  # usual sets from one of a camera's images to the next: half way to half the rate
MANY_VIEWS = 4  # suffice for the body's motion without those that slip

# --- decision: lenses -----------------------------------------------------------------------------

MIN_LENS_GAIN = 15.0  # log likelihood; chance brings up to 9 on the studio
LENS_FIT_RANGE = (0.5, 1.5)  # how much of the exchange's pattern must be there; 1 is all of it
SUSPICIOUS = 1.3  # a camera's residuals over usual ones, else nothing is tried; tuned on the studio
MAX_SUSPECTS = 4  # every pair of them is tried
MUCH_BETTER = 0.8  # of the residuals with the lenses as given; tuned on the studio

# How far from a bone skin, clothing and hair reach, metres: wider than the body's own radii
# (`segmentation.constants`), since what is left out of the background only has to hold the person.
# Of the limbs, in the order of LIMB_BONES; tuned on the studio.
LIMB_REACH_M = (0.16, 0.14, 0.18, 0.15, 0.14, 0.14)
# Of trunk and head, which have no bones of their own in the skeleton; hands reach past the wrist.
TRUNK_REACH_M: dict[tuple[str, str], float] = {
    ("neck", "mid_hip"): 0.26,
    ("right_shoulder", "right_hip"): 0.20,
    ("left_shoulder", "left_hip"): 0.20,
    ("nose", "neck"): 0.22,
    ("left_ear", "right_ear"): 0.20,
    ("right_wrist", "right_wrist"): 0.24,
    ("left_wrist", "left_wrist"): 0.24,
}
