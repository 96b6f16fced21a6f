"""Detectors run on the images here: a user's ONNX models of masks and of keypoints.

- ``onnx_model``: the session, its input, images fitted to it
- ``onnx_segmentation``: instances by Mask R-CNN, PointRend and YOLO-seg exports
- ``onnx_outputs``: boxes, scores and masks of those exports to instances
- ``onnx_pose``: keypoints by top-down models (RTMPose, DWPose, HRNet, ViTPose)
- ``pose_responses``: SimCC bins and heatmaps to points

onnxruntime is imported when a model is opened.
"""
