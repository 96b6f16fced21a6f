"""Stage ``person``: the subject's detections, left and right corrected, keypoints triangulated.

The *subject* is the person who is reconstructed; other people may be visible. A *detection* is one
person in one image, with 135 keypoints (x, y, confidence). A *candidate* is one mask that a
detector or the segmentation proposes. Sets are reordered by moment (:mod:`intercap_core.scene`).

In the order of a run:

1. ``groups`` matches the people of one set over views by geometry, ``tracks`` follows them over
   time and recognises them after an absence. ``subject`` chooses the subject among them, with the
   help of ``subject_hints``: points named by the user, and contact with the object.
2. ``lifting`` places keypoints of a single view by its depth.
3. ``subject_joints`` triangulates the subject. ``left_right`` makes left and right consistent over
   views and time; ``sides`` has the index tables, and sides stated by the user.
4. ``masks`` chooses the detector's candidate that is the subject. Images without a detector's
   candidates are segmented by ``segmentation``.
"""
