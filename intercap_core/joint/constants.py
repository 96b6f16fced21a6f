"""Numbers of the joint fit: each with its unit and the reason for its value."""

from __future__ import annotations

from math import radians

# --- measurement noise: residuals of a correct fit, in the joint energy

# Distance of a patch that truly touches, after errors of skin, mesh and calibration, metres.
# Tuned on the studio.
CONTACT_SIGMA = 0.004
# What an annotated contact weighs over a detected one, half its deviation: somebody saw it, while
# lasting errors of head and object hold them apart. Chosen on one recording of the studio (a bottle
# at the mouth, noise 2, three cameras): with 1 the mouth stays 10 mm off, with 16 the hand suffers.
# What touches is drawn no more than by detection: at a handle fingers were pulled askew.
ANNOTATED_CONTACT_WEIGHT = 4.0
# Depth of a vertex inside the object beyond the tolerance, metres. Tuned on the studio.
PENETRATION_SIGMA = 0.003
# Points of the object's surface that are looked for inside the body: their spacing, metres, so that
# a rim shows on a fingertip, and how many at most.
OBJECT_SPACING, MAX_OBJECT_POINTS = 0.006, 6000
# Area of the object inside the body that is one measurement, m^2: a hand's breadth of a handle.
# Tuned on the studio.
OBJECT_AREA_PER_MEASUREMENT = 1e-3
# Skin whose nearest sample is farther than this from the object has none of it inside, metres: half
# the spacing of samples, a thickness and the way of a round.
NEAR_SKIN = 0.05
# Depth of a vertex below the floor, metres: the ground plane's own error. Tuned on the studio.
GROUND_SIGMA = 0.005
# Vertices of the body's mesh, inside the object or below the floor, that are one measurement:
# neighbours err together. Tuned on the studio.
VERTICES_PER_MEASUREMENT = 10.0
# Vertices of the object on which it stands at least: fewer would each count as a measurement of
# their own when an edge just touches the floor. Tuned on the studio.
MIN_STANDING_VERTICES = 4
# A tracked pose is never surer than this, rad and metres: the meshes differ from the things
# themselves. Tuned on the studio.
TRACK_FLOOR_TURN = radians(0.05)
TRACK_FLOOR_SHIFT = 0.0005
# Evidence of the images this many standard deviations from the pose counts a quarter. Tuned on the
# studio.
IMAGES_OUTLIER = 5.0
# Errors of masks and keypoints last about so long, seconds: what the frames of that time say of the
# cameras is one observation. Tuned on the studio.
ERROR_LASTING_S = 0.3
# A hand's pose lasts about so long, seconds: what the prior of poses says in the frames of that
# time is one observation, where the body fit's frames stand alone. A grasp lasts longer, fingers
# on their way shorter. Tuned on the studio: 0.3 to 1 are alike.
HAND_LASTING_S = 0.5
# What the body says of the cameras beside that: a detector's errors follow view and pose, and
# clothing is of unknown thickness. Tuned on the studio.
BODY_SHARE = 0.05
# Images that are kept as they were read, bytes: those of some hundred frames of six cameras. Others
# are read again in the next round.
VIEWS_KEPT_BYTES = 200_000_000
# What is added where different poses explain a frame equally well, rad and metres: it is nearly
# always the rotation (on which side the handle is). Tuned on the studio.
AMBIGUOUS_TURN = radians(10.0)
AMBIGUOUS_SHIFT = 0.002

# --- frames without a measurement: how far they may leave the pose that was interpolated

BRIDGED_OBJECT_TURN = 0.5  # rad; tuned on the studio
BRIDGED_OBJECT_SHIFT = 0.15  # metres; tuned on the studio
BRIDGED_BODY_TURN = 0.3  # rad, of each joint; tuned on the studio
BRIDGED_BODY_SHIFT = 0.1  # metres; tuned on the studio
# Standard deviation of the object's position where the track is lost, metres: contact detection
# then learns nothing from the distance. Tuned on the studio.
UNTRACKED_SIGMA = 0.5

# --- human motion

# Standard deviation of accelerations in everyday motion, m/s^2: trunk and limbs stay below some
# of them outside impacts, hands reach ten, carried objects are in between. Tuned on the studio.
BODY_ACCELERATION = 6.0
FINGER_ACCELERATION = 10.0
OBJECT_ACCELERATION = 6.0
# Steps of the motion that says how strong and how steep a learned prior of it is, and iterations in
# which the steepest direction is found.
PROBE_STEPS, SPECTRAL_ITERATIONS = 16, 5
# A recording whose rate differs by more than this share from that of a learned prior shows it other
# motion: AMASS, on which LEMO's was trained, holds walks that differ by more among themselves.
MAX_RATE_ERROR = 0.1
# Turns are as smooth as those of a thing of this radius, metres: hands turn what they hold with
# 20 rad/s^2 where they move it with 6 m/s^2. Tuned on the studio.
OBJECT_ARM = 0.3
# Accelerations beyond so many standard deviations count as a start, a stop or an impact. Tuned on
# the studio.
ACCELERATION_OUTLIER = 2.0

# How far a grip and a sole creep: a random walk, metres in one second. Tuned on the studio.
STICK_WALK, PLANT_WALK = 0.003, 0.003
# Speeds of what truly slides, m/s: beyond the jitter of the fits. Tuned on the studio.
STICK_OUTLIER, PLANT_OUTLIER = 0.15, 0.15
# What has come so far over the object within so long truly slides, metres and seconds. Tuned on the
# studio.
GLIDE_M, GLIDE_S = 0.02, 0.4
# Probability of a hold below which a patch is left out, and share of the most that a vertex of it
# holds below which others are; vertices of a patch, and of each half of a sole, at most: they move
# nearly as one.
STICK_LEAST, STICK_NEAR = 0.02, 0.1
STICK_VERTICES, SOLE_VERTICES = 24, 6

# --- lasting errors of the sequential fits

# How fast they change: a random walk, metres in one second. Tuned on the studio.
BODY_DRIFT = 0.010
OBJECT_DRIFT = 0.004
# Points of the body or the object whose corrections are one measurement: neighbouring points move
# as one. Tuned on the studio.
DRIFT_POINTS_PER_MEASUREMENT = 2.0
# Distance that an object at rest moves between frames, metres: practically none. Tuned on the
# studio.
RESTING_SIGMA = 2e-5

# --- time offsets of the cameras

# Standard deviation of an offset that nothing is known of, seconds: beyond it the frame sets would
# have been matched differently (a third of the time between frames at 30 fps).
LOOSE_OFFSET_SIGMA_S = 0.010
# The prior comes from the same keypoints: it is not taken as surer than this, seconds. Tuned on
# the studio.
MIN_PRIOR_SIGMA_S = 0.0005
# A fitted point's own error, metres; loose, so that only disagreement between views counts. Tuned
# on the studio.
POINT_SIGMA_M = 0.03
MAX_CORRELATION = 0.98  # of successive residuals; tuned on the studio
# Standard deviations at which an innovation starts to count as an outlier. Tuned on the studio.
INNOVATION_OUTLIER = 3.0
# Points of one part of the body count as at most so many: their errors are correlated. Tuned on
# the studio.
POINTS_PER_PART = 4.0
# Number of a camera's depth points on a sample with which the sample has half its full weight.
# Tuned on the studio.
HALF_WEIGHT_POINTS = 2.0
# Rows farther apart than this share of the median time step are no neighbours: one frame missing
# makes a step of 2.
MAX_STEP_RATIO = 1.5
MIN_INNOVATIONS = 50  # fewer seen points of successive frames give no estimate; tuned on the studio
# Changes of offsets below this are not followed, seconds: a hand at 3 m/s moves a millimetre
# meanwhile.
OFFSET_UNCHANGED_S = 0.0003
# Changes of offsets above this call for another round, seconds: 3 mm of that hand's motion.
OFFSET_CHANGED_S = 0.001

# Corrections of so many of the scene's standard deviations say that body or object are wrong, not
# the cameras. Tuned on the studio: none of its recordings comes to half of it.
MAX_CAMERA_SIGMAS = 5.0
# Largest correction of what a camera shows so far away, metres: beyond it a calibration is wrong
# and has to be made again. Tuned on the studio, whose corrections stay below a third of it.
MAX_CAMERA_SHIFT_M, CAMERA_REACH_M = 0.03, 2.5
# Corrections of cameras below this are not worth another round, metres.
CAMERAS_CHANGED_M = 0.0005

# --- solver effort

# Most accepted steps of each round; contact is estimated anew between rounds, and the first moves
# the most. Tuned on the studio.
ROUND_STEPS = (6, 4, 3)
OFFSET_ITERATIONS = 4  # reweightings of the offsets' normal equations; tuned on the studio
# Damping of Levenberg-Marquardt, share of the diagonal. Tuned on the studio.
INITIAL_DAMPING = 1e-3
MIN_DAMPING = 1e-6
# A frame that ends with more hardly moves any more. Tuned on the studio.
HELD_DAMPING = 0.5
DAMPING_UP, DAMPING_DOWN = 10.0, 5.0  # factors after a rejected and an accepted step
# Largest change in one step, rad and metres: beyond it a linearisation of skinning is poor.
# Tuned on the studio.
MAX_STEP_TURN = 0.5
MAX_STEP_SHIFT = 0.1
# A step that gains less than this share of what the round has gained ends it. Tuned on the studio.
MIN_GAIN_SHARE = 0.03
# A refused step that would have gained less than this share of the energy, by its slope: the fit is
# at a minimum. Tuned on the studio.
NEGLIGIBLE_SHARE = 1e-3
# Largest change of a contact probability after which another round has nothing new to work with.
# Tuned on the studio.
CONTACT_CONVERGED = 0.1

# --- decision

# A hand whose keypoints are mostly seen in so many views or fewer is undetermined: what hides it
# from the others hides fingers from these.
FEW_HAND_VIEWS = 2
# A frame with skin deeper than this inside the object, or the other way round, is flagged, metres:
# far beyond what skin yields, so one of the two poses is wrong. Tuned on the studio.
FLAGGED_DEPTH = 0.03
# Points of the object's surface that are held against the body for that.
DEPTH_POINTS = 400
# Feet so far below the floor, or feet and object so far above it, contradict it, metres: several
# times what sequential fits err there (at most 0.03). Tuned on the studio.
FLOOR_CONTRADICTED = 0.10
# Share of the frames in which feet or object should reach the floor: a jump ends, and so does a
# walk with the object in the air. Tuned on the studio.
REACHED_SHARE = 0.1
