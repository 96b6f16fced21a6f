"""Detections of people and objects: files of other programs, ONNX models, and their artefact.

- ``image_numbers``: which colour image a file or an entry of a file is about.
- ``keypoint_files``, ``people_of_camera``, ``keypoints``: keypoints of one camera; their layout and
  unit; layouts and readers.
- ``candidate_files``: instance masks of one camera, from ``coco`` (JSON) and ``mask_files``.
- ``instance``, ``class_names``: one segmented instance; names of its classes.
- ``onnx_model``, ``onnx_segmentation``, ``onnx_pose``: models for images without files.
- ``read``: the artefact, opened for the stages that follow.
"""
