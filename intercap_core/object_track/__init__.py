"""Pose of the object in every frame (stage ``object_track``, equation 1 of the paper).

Files in the order of a run:

1. Checks: ``mesh_check`` warns of unknown labels, of a mesh in another unit and of a mesh that the
   images do not show.
2. Images: ``recording`` reads the views of a frame set (``view``, ``reduced_mask``); ``observer``
   bundles one recording with the searches, fits and comparisons of its frames.
3. Candidates: ``groups`` joins candidates of several views and has their outlines; ``places`` is
   the prior of positions in the room over the recording.
4. Search without a start: ``search`` aligns a grid of rotations (``turns``) and fits the best.
5. Fit of a frame: ``patches`` cuts the measurements around the object, ``object_depth`` and
   ``object_silhouette`` are the terms of equation 1, ``view_fit`` weighs them in one view, ``fit``
   minimises their sum, ``evidence`` is the same quadratic form at a fixed pose, ``view_report``
   compares a view with a pose.
6. Likelihood of a pose: ``likelihood`` by the images; ``hypotheses`` adds the prior.
7. Track: ``hypotheses`` follows fits through time (``motion``), ``proposals`` adds hypotheses,
   ``decoder`` is the hidden Markov model, ``tracker`` runs all of it (class ``Tracker``).
8. Colour: ``appearance`` learns the surface's colours, ``colour_decision`` applies them to
   rotations that shape and motion leave undecided.
9. Refinement over all frames: ``whole`` calls ``rest`` (segments at rest), ``bridges`` (lost
   frames), ``given_poses`` (annotated poses) and ``smooth`` (most probable track, covariance).

Poses are master_from_object, in metres. The quality of a pose is a log-likelihood ratio in nats.
Constants that are marked as tuned were tuned on the studio's recordings.
"""
