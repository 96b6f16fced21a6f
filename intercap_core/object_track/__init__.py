"""The object's pose in every frame: what stage ``object_track`` calls (equation 1 of the paper).

Files in the order of a run:

1. Before tracking: ``object_size`` warns of a mesh in another unit or of labels that never occur.
2. What an image shows: ``reduced_mask`` decodes masks at a few pixels' spacing, ``blobs`` takes the
   person out of a mask that holds both, ``view`` has the masks and the depth of an image (View),
   ``view_cache`` keeps them. ``observer`` answers all questions to the images of a frame.
3. Where the object may be: ``groups`` joins candidates of several views, ``outlines`` has their
   silhouettes, ``places`` tells the object from other things like it over the whole recording.
4. A frame with nothing known: ``search`` aligns a grid of rotations (``alignment``) and fits the
   best; ``seed`` chooses the frame and the pose to start from.
5. The fit of a frame: ``candidates`` chooses the mask that overlaps the render, ``patches`` cuts
   the image around it, ``view_fit`` has the terms of equation 1 in one view, ``fit`` minimises them
   over all views, ``view_report`` says how a view agrees. ``evidence`` is the same quadratic form
   at a given pose, without steps.
6. From frame to frame: ``follow`` starts each frame where ``motion`` expects it, ``lost`` says
   which poses are not believed, ``audit`` searches anew where the track is doubtful, ``passes``
   (Tracker) runs all of it both ways and merges.
7. All frames together: ``whole`` asks ``turns`` for the side of a nearly symmetric object,
   ``choices`` for the hypothesis of weakly seen frames, ``rest`` for when the object is at rest and
   ``smooth`` for the most probable track and its covariance.

``constants`` has the numbers of all of them. Poses are master_from_object, metres.

How good a pose is, 0 to 1 without unit, each from the one before:

- ``score``: agreement of a fit with the images (overlap of masks, share of agreeing depth), views
  weighted by the pixels that they could show.
- ``confidence``: the score times 1 - 2^-n for n views that support the pose.
- ``plausibility``: the confidence and a small bonus where the object stands upright (up to 1.03).
- ``value``: the plausibility times the place's prior; hypotheses of a frame are compared by it.

Priors: ``label_prior`` of a candidate by its class, ``place_prior`` (:meth:`Places.prior`) of a
place in the room, 0.1 to 1. Flags of a frame are defined at :class:`.lost.FrameResult`.
"""
