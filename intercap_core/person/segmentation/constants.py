"""Tuned numbers of the segmentation from images alone, by kind, with unit and origin.

"tuned on the studio" = chosen so that the simulated captures of ``intercap_core.studio`` come out
right; no measurement on real recordings stands behind it. "margins" are units of how uncertain the
person's surface is (:mod:`.person_volume`).
"""

from __future__ import annotations

# --- sensor: depth
# Nearer than the background by this stands before it: five standard deviations of the sensor's
# random error and its bias between images (Toelgyessy et al., Sensors 21(2):413, 2021).
BEFORE_MM, BEFORE_PER_DEPTH = 15.0, 0.005
FLOATING_MM = (
    30.0  # a pixel so far from nearer and from farther neighbours is a flying pixel; tuned
)
EDGE_PX = 5  # background that is lost in narrower strips is an edge that measures badly; tuned
GONE_SHARE = 0.08  # of images in which a pixel shows something else: it is not background; tuned
# The other camera's background is farther by this: calibration and the slope of grazing surfaces.
BEHIND_M, BEHIND_PER_DEPTH = 0.05, 0.01  # metres, share of depth; tuned on the studio
BEHIND_AROUND_PX = 5  # pixels all of which must be so far: edges of the background are uncertain
MIN_HOLE_PX = 5  # across, of what is taken out of a background; tuned on the studio
MIN_SURFACE_PX = 400  # smooth surfaces of at least so many pixels are no traces of a person; tuned
SMOOTH_MM = 100.0  # range of depth in 3 x 3 pixels of a smooth surface; tuned on the studio
# Behind the nearest point of its cell by more, a point is occluded, metres: more than a surface's
# slope within a cell. Tuned on the studio.
OCCLUDED_BEHIND_M = 0.03

# --- sensor: colour
# Horprasert, Harwood and Davis (1999): a pixel is split into brightness along the background's
# colour and what is off it. A shadow is darker, of the same colour. Grey levels, share, share; the
# values are tuned on the studio.
OFF_COLOUR, SHADOW, HIGHLIGHT = 14.0, 0.5, 1.4
DARK = 40.0  # grey levels; darker colours of the background have no direction; tuned on the studio
DARK_CHANGE = 30.0  # grey levels by which a pixel of such a background differs; tuned on the studio
SATURATED = 250  # grey level from which a pixel tells nothing of the exposure

# --- anatomy: radii of adults of middle build, metres
# Half breadths and girths over 2 pi of NASA-STD-3000, section 3.3; the last of each row, how
# uncertain the surface is (one margin: clothing and build), is tuned on the studio. Radii at the
# first and at the second keypoint. "middle_ear" is half way between the ears.
TRUNK_RADII_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("neck", "mid_hip"): (0.130, 0.130, 0.035),
    ("left_shoulder", "left_hip"): (0.100, 0.110, 0.035),
    ("right_shoulder", "right_hip"): (0.100, 0.110, 0.035),
    ("left_hip", "right_hip"): (0.115, 0.115, 0.035),
    ("left_shoulder", "right_shoulder"): (0.075, 0.075, 0.035),
    ("neck", "middle_ear"): (0.075, 0.080, 0.030),
    ("middle_ear", "middle_ear"): (0.125, 0.125, 0.025),
    ("nose", "middle_ear"): (0.045, 0.105, 0.025),
}
# Of the bones of `body.keypoints.LIMB_BONES`, and of the soles.
LIMB_RADII_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("shoulder", "elbow"): (0.065, 0.048, 0.025),
    ("elbow", "wrist"): (0.048, 0.034, 0.018),
    ("hip", "knee"): (0.105, 0.070, 0.030),
    ("knee", "ankle"): (0.068, 0.045, 0.022),
    ("ankle", "heel"): (0.050, 0.045, 0.022),
    ("ankle", "big_toe"): (0.048, 0.035, 0.022),
}
SOLE_RADII_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("heel", "small_toe"): (0.040, 0.035, 0.022),
    ("heel", "big_toe"): (0.040, 0.035, 0.022),
}
FINGER_RADII_M = (0.012, 0.010, 0.009)  # at the knuckle, middle, tip
PALM_RADII_M = (0.024, 0.016)  # at the wrist, at the knuckles
HAND_MARGIN_M = 0.012  # fingers are told within millimetres; tuned on the studio
# A hand whose fingers nobody saw goes on from the wrist along the forearm: length, radius, margin.
BLIND_HAND_LENGTH_M, BLIND_HAND_RADIUS_M, BLIND_HAND_MARGIN_M = 0.15, 0.045, 0.02
MIN_FINGERS = 3  # whose roots must be known for the hand's own bones; tuned on the studio
USUAL_TRUNK_M = 0.50  # neck to middle of the hips, of the people whose radii these are
SMALLEST_BUILD, LARGEST_BUILD = 0.6, 1.25  # of that: children to the tallest
# The person's volume, this many margins larger, in the colour image: left out of the background,
# holds the mask, holds no thing. Tuned on the studio.
SAMPLE_MARGINS, MASK_MARGINS, THING_MARGINS = 5.0, 2.0, 1.0
PERSON_MARGINS = 1.5  # outside the usual build by less is the person; tuned on the studio
# Margins outside the person at which a thing may begin, both are tried; tuned on the studio.
NEAR_CUT, FAR_CUT = 1.0, 2.5
CLOTHING_MARGINS = 2.2  # a component that reaches no farther is clothing; tuned on the studio
TRACE_MARGINS, TRACE_SHARE = 1.0, 0.4  # within the person, at this share of moments: a trace; tuned

# --- human motion
MAX_HAND_SPEED_M_S = 8.0  # above what hands reach in everyday tasks (some 5 m/s)
UNTOLD_OFFSET_S = 0.01  # a camera's time offset that could not be told is off by; as scenes spread
MAX_KEYPOINT_GAP_S = 0.5  # a keypoint lost for less is where it lies between; tuned on the studio
# Around the person's path, above the highest keypoint: where things are looked for, metres; tuned
# on the studio.
AROUND_PATH_M, ABOVE_HEAD_M = 1.5, 0.7
WITHIN_REACH_M = 0.35  # of a keypoint of the person at some time; tuned on the studio

# --- solver effort
COLOUR_SCALE = 2  # images are decoded at half their size, which JPEG does in a quarter of the time
UNSURE_CELLS = 4  # around the volume where nothing moved, in which a border is the volume's; judged
MAX_COLOUR_SAMPLES = 15  # images of which the background is the median
MIN_COLOUR_SAMPLES = 3  # of a pixel without the person: fewer tell no background
MAX_DEPTH_SAMPLES = 25  # images looked at for what leaves its place
GAIN_STRIDE = 16  # pixels; exposures are compared at every so many
PERSON_SAMPLES = 12  # moments at which the person's own traces in the background are sought
MAX_COMPONENTS = 6  # of one kind
MAX_COLOUR_CANDIDATES = 5  # of one image
MAX_STATIC_THINGS = 8
MAX_DISTANCE_POINTS = 2000  # of a thing, from which its distance to the person is taken
VISITED_CELL_M = 0.10  # cells that stand for the places of the person's keypoints
BONES_PER_GROUP = 5  # bones that are passed over together where a point is far from all of them
FAR = 20.0  # margins: the distance that is given to whatever is farther than this

# --- decision: what one thing is
CELL_M = 0.02  # points of one surface 4 m away are 8 mm apart
STATIC_CELL_M = 0.025  # the same in the background; tuned on the studio
SURFACE_CELL_M, SURFACE_POINTS = 0.02, 2  # cells with so many points hold a surface; tuned
NEARBY_CELL_M = 0.07  # components with less between them may be one held thing: a hand's breadth
FLOOR_M = 0.025  # what is lower may be the floor; tuned on the studio
MIN_POINTS = 40  # of a component, over all views; tuned on the studio
MIN_VIEW_POINTS = 12  # of it in a view that has it as a candidate; tuned on the studio
MIN_STATIC_POINTS = 60  # of a static component, over all views; tuned on the studio
MIN_COLOUR_CELLS = 60  # of a candidate in colour, at the reduced size; tuned on the studio
SAME_SHARE = 0.9  # of a component's points: the farther cut shows nothing new; tuned
LARGEST_M = 2.2  # anything larger is no thing that one person handles; tuned
# A level surface: this share of a component's points within a layer; what stands on it is at least
# so high above. Metres, share, metres; tuned on the studio.
LAYER_M, LEVEL_SHARE, ABOVE_M = 0.02, 0.12, 0.012

# --- decision: scores of candidates, 0 to 1
# Prior that a component is a handled thing, whatever its size: of moving components, by how far
# they reach from the person; low for all of the static scene. The scores are shaped by the studio:
# no recording was annotated to calibrate them.
ON_TOP_SCORE, STATIC_SCORE, PARTLY_MOVED_SCORE, TWO_ENDS_SCORE = 0.3, 0.2, 0.4, 0.5
COLOUR_SCORE = 0.5
