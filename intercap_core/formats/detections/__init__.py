"""Stage ``detections``: people's keypoints and instance masks of every image, in one artefact.

In the order of a run:

- ``image_numbers``: which colour image a number or a name in a file means
- ``keypoint_files``: the files of one camera's keypoints, whichever form each has, sorted by image;
  ``keypoint_values`` drops what cannot be true; ``keypoint_layouts`` maps a detector's points to
  the 135 of ``body.keypoints``
- ``candidate_files``: the files of one camera's masks, sorted by image
- ``models``: ONNX models, for images of which no file says anything
- ``constants``: all numbers, by kind
- ``read``: the artefact that is written, opened for the stages that follow
- ``keypoint_check``, ``candidate_check``: the beginning of each camera's files, for ``check``

Which file reads which format:

============================================  ==========================
COCO results and data sets (instance masks)   ``coco``
an instance's mask (RLE, polygons)            ``instance``
COCO's class numbers, ``categories``          ``class_names``
OpenPose's JSON                               ``openpose``
COCO-WholeBody, mmpose, AlphaPose             ``converters.wholebody``
masks as image files                          ``converters.mask_files``
lists of class names                          ``converters.label_maps``
the InterCap release, BEHAVE                  ``converters.data_sets``
outputs of ONNX models                        ``models``
============================================  ==========================

``coco`` also takes the keys by which detectron2, ultralytics and Segment Anything call COCO's
fields.
"""
