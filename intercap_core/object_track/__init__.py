"""The object's pose in every frame: what stage ``object_track`` calls (equation 1 of the paper).

Files in the order of a run:

1. Before tracking: ``object_size`` warns of a mesh in another unit or of labels that never occur.
2. What an image shows: ``reduced_mask`` decodes masks at a few pixels' spacing, ``blobs`` takes the
   person out of a mask that holds both, ``view`` has the masks and the depth of an image (View),
   ``view_cache`` keeps them. ``observer`` answers all questions to the images of a frame.
3. Where the object may be: ``groups`` joins candidates of several views, ``outlines`` has their
   silhouettes, ``places`` tells the object from other things like it over the whole recording.
4. A frame with nothing known: ``search`` aligns a grid of rotations (``alignment``) and fits the
   best.
5. The fit of a frame: ``candidates`` chooses the mask that overlaps the render, ``patches`` cuts
   the image around it, ``view_fit`` has the terms of equation 1 in one view, ``fit`` minimises them
   over all views, ``view_report`` says how a view agrees. ``evidence`` is the same quadratic form
   at a given pose, without steps.
6. How likely a pose is: ``likelihood`` has the images' log-likelihood ratio, ``prior`` what is
   known beside them.
7. From frame to frame: ``hypotheses`` follows fits through time, each from where ``motion`` expects
   it; ``proposals`` says where else to look (a search, an annotation, ``turns`` of a nearly
   symmetric object); ``decoder`` decides over all frames; ``tracker`` (Tracker) runs all of it.
8. Turns that stay open: ``appearance`` learns the colours of the surface's patches
   (``surface_kernel``), ``colour_decision`` asks them.
9. All frames together: ``whole`` asks ``rest`` for when the object is at rest and ``smooth`` for
   the most probable track and its covariance. ``frame_result`` has the flags.

``constants`` has the numbers of all of them. Poses are master_from_object, metres. How good a pose
is has one measure, nats: ``log_ratio`` by the images of a frame alone, ``weigh`` with what is known
beside them.
"""
