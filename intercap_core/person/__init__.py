"""Stage ``person``: the subject's detections, left and right corrected, keypoints triangulated.

In the order of a run:

- ``groups``: people of one set matched over views by geometry; ``tracks``: followed over time;
  ``people``: known again after an absence, by place and build; ``subject``: who of them it is, by
  the points that ``named`` reads, by who touches the object (``touching``), or by who is seen most
- ``lifting``: keypoints of a single view placed by the depth beside them
- ``swaps``: sides exchanged by the detector: steadied over time in each view, then triangulated and
  corrected; ``agreement`` decides set by set which views disagree, ``facing`` which of two mirrored
  bodies is the true one, by the body's build and its motion
- ``sides``: which keypoints are left and right of each other
- ``exposure``: keypoints moved from each camera's exposure to the set's time
- ``middles``: neck and middle of the hips from shoulders and hips
- ``masks``: the detector's candidate that is the subject
- ``constants``: all numbers, by kind

Images that no detector segmented are segmented by the room ``segmentation``.
"""
