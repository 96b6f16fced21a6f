"""Limits and conventions of detectors' files and models, by kind, with unit and origin."""

from __future__ import annotations

import numpy as np

# --- limits of files: what is larger is refused, with words
MAX_JSON_BYTES = 1 << 29  # parsed JSON takes about six times its size in memory
HEAD_BYTES = 1 << 18  # of a long file that is looked at before a run
MAX_LABELS_BYTES = 1 << 26  # a list of classes is some kB; a data set's annotations are not needed
MAX_LABEL = 200  # characters; the artefact keeps all labels at the length of the longest
MAX_PIXELS = 1 << 27  # of a mask that is scaled; a full-frame camera has a fifth
MAX_MASK_VALUES = 1000  # instances of one mask image; more are a photograph or a depth image
MAX_REDUCED = 32.0  # by which a mask's side may be smaller than the image's
MAX_NETWORK_BYTES = 1 << 31  # an ONNX file ends there; larger ones keep weights beside them
MAX_INPUT_SIDE = 8192  # px of a model's input; detectors look at 640 to 1333
MAX_BATCH = 256  # images of a model's input
MAX_GRID_SIDE = 32_767  # cells of a mask that OpenCV's warps take
FILES_NAMED = 3  # broken files or entries that a note names; more are counted

# --- decision: which numbers can be true
# Scores are probabilities; Segment Anything's predicted overlaps go a little beyond 1.
MIN_SCORE, MAX_SCORE = -0.01, 1.2
SAME_SHAPE_PX = 1.0  # rounding of one side of an image that was reduced
SHARES_UP_TO = 2.0  # px: coordinates from 0 to 1, some beyond the image, are shares, not pixels
EDGE_PX = 0.5  # pixels' middles are whole numbers
MASK_THRESHOLD = 128  # of 8 bits; JPEG blurs the two values that a mask has

# --- conventions of models: what they were trained with
# Mean of ImageNet as Caffe's models have it, blue first: what maskrcnn-benchmark subtracts.
CAFFE_MEAN_BGR = np.array([102.9801, 115.9465, 122.7717], np.float32)
# Mean and deviation of ImageNet's pixels, red first: what torchvision and mmpose normalise by.
IMAGENET_MEAN_RGB = np.array([123.675, 116.28, 103.53], np.float32)
IMAGENET_DEVIATION_RGB = np.array([58.395, 57.12, 57.375], np.float32)
YOLO_SIDE, YOLO_STRIDE, YOLO_GREY = 640, 32, 114  # px, px, grey level: ultralytics' training
# px: sizes at which detectron2's and maskrcnn-benchmark's configurations test.
RCNN_SHORT, RCNN_LONG, RCNN_STRIDE = 800, 1333, 32
NMS_IOU = 0.7  # what YOLO's predictors use
MAX_INSTANCES = 100  # of one image, the best; COCO's evaluation counts as many
MASK_PROBABILITY = 0.5  # of a mask's edge
BOX_PADDING = 1.25  # factor on a person's box, as mmpose trains and tests
MIN_BOX_SCORE = 0.3  # of a detector's person; mmpose's default
# Width of the blur to that of a heatmap: mmpose has 11 cells of 48, 17 of 72.
HEATMAP_BLUR = 11 / 48

# --- solver effort
SEGMENTATION_BATCH = 4  # images at once where the model takes any number
POSE_BATCH = 8  # people at once where the model takes any number
MAX_BOXES = 3000  # of one image that take part in the suppression
MAX_PEOPLE = 10  # of one image

# --- decision: people found without boxes; tuned on the studio
# Where no detector gave a box, the whole image is looked through. A person counts with this many
# points of the body at this confidence.
FOUND_CONFIDENCE, FOUND_POINTS = 0.3, 6
# Somebody is in several tiles, or a mixture of two people in one: this share of the points is
# already a better one's, within a share of the person's size.
SAME_PERSON_SHARE, SAME_POINT_SHARE = 0.5, 0.05
