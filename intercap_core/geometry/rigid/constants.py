"""Numbers of meshes, rendering and rigid motion by kind, each with its unit and its reason."""

from __future__ import annotations

# --- object: sizes and motion -------------------------------------------------------------------

# Sizes of objects that people handle, metres; outside the second pair the file is in another unit.
HANDLED_MAX_M, HANDLED_MIN_M = 3.0, 0.02
MAX_EXTENT_M, MIN_EXTENT_M = 5.0, 0.01
# Of an object's vertices from the origin of its file, metres: scans are as far off as a room is
# wide, and single precision there ends at micrometres.
MAX_FROM_ORIGIN_M = 50.0
# Share of its bounding cube that a body fills; less is a flat sheet with rounding errors.
MIN_FILLED = 1e-8
# Share of edges that do not join two faces: a quarter of a lidless box's of few faces; above the
# limit the faces are loose, and inside and outside mean nothing.
MAX_OPEN_EDGES = 0.35
# Fastest thrown or kicked object, m/s and rad/s; anything faster is a jump of the track.
MAX_SPEED_M_S, MAX_TURN_RAD_S = 8.0, 20.0

# --- sensor: images -----------------------------------------------------------------------------

# Triangles that reach nearer than this are left out, metres: no Kinect images them (the data sheet
# of the Azure Kinect begins at 0.25 m).
NEAR_M = 0.05
# Straight edges between projected corners bend by less in any known lens, pixels.
BOX_MARGIN_PX = 2
# How far a triangle's edge of L px may bend: L^2 times this over the focal length. Chords between
# any two pixels of Azure Kinects' colour and depth images need at most 0.135.
BEND = 0.15
SLACK_PX = 0.1  # rounding of the ray table and of small windows
VISIBLE_OFFSET_M = 0.001  # a vertex is lifted off its own surface before the ray is cast

# --- solver effort ------------------------------------------------------------------------------

LARGE_PX = 6.0  # of a triangle from which its edges bound each row
SIMPLIFIED_TOLERANCE_M = 0.0005  # of a vertex from the simplified surface: below the sensor's noise
KEPT_ON_DEVICE = 4  # sets of lenses, and meshes, that stay on the GPU

# --- decision -----------------------------------------------------------------------------------

MAX_DISCRETE = 128  # elements of a symmetry group; the icosahedron's rotation group has 60
SAME_TRANSFORM = 1e-3  # transforms nearer than this, per entry, are one: tables carry 4 digits
PAINT_POINTS = 20000  # of a coloured surface: a few in each patch that a camera can tell apart
