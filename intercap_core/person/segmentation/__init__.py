"""Masks of the person and candidates of the object from images alone, without a detector.

Background and foreground are separated in depth, or in colour for cameras without depth. Foreground
near the triangulated keypoints is the person, the rest are candidates of the object.

- ``image_segmentation``: entry of the package; depth where a camera measures it, else colour.
- ``depth_candidates``: background subtraction in depth, components in space over all views.
- ``foreground``: background and foreground of one depth camera.
- ``person_volume``: distance from capsules around the keypoints at each camera's exposure.
- ``static_objects``: components of the background near the person's path.
- ``candidate_masks``: depth pixels as masks of the colour image, and the result of a view.
- ``colour_candidates``: background subtraction in colour, for cameras without depth.
"""
