"""Masks of the person and candidates of the object from images alone, without a detector.

Called by stage ``person`` for the images that no detector segmented. In the order of a run:

- ``image_segmentation``: the entry; depth where a camera measures it, else colour
- ``depth_candidates``: background subtraction in depth, components in space over all views
- ``foreground``: one camera's depth background, and what stands before it
- ``free_space``: background that another camera saw through, or that is a trace of the person
- ``moving_person``: the keypoints when each camera exposes, and what they are off by
- ``person_volume``: distance from capsules around the keypoints: what is the person
- ``static_things``: components of the background near the person's path
- ``voxels``: connected components and occupancy on a grid
- ``depth_masks``: depth pixels to masks of the colour image
- ``colour_candidates``: background subtraction in colour, for cameras without depth
- ``image_segments``: the result of one image
- ``constants``: all numbers, by kind
"""
