"""Pose of the object in every frame (stage ``object_track``, equation 1 of the paper).

Files in the order of a run:

1. Checks: ``mesh_check`` warns of unknown labels, of a mesh in another unit and of a mesh that the
   images do not show.
2. Images: ``recording`` reads the views of a frame set (``view``, ``reduced_mask``); ``observer``
   bundles one recording with the searches, fits and comparisons of its frames.
3. Candidates: ``groups`` joins candidates of several views and has their outlines; ``places`` is
   the prior of positions in the room over the recording.
4. Search without a start: ``search`` aligns a grid of rotations (``turns``) and fits the best.
5. Fit of a frame: ``patches`` cuts the measurements around the object. ``object_depth`` and
   ``object_silhouette`` are the terms of equation 1, ``view_fit`` weighs them in one view, and
   ``fit`` minimises their sum. ``evidence`` is the same quadratic form at a fixed pose, and
   ``view_report`` compares a view with a pose.
6. Likelihood of a pose: ``likelihood`` by the images; ``hypotheses`` adds the prior.
7. Track: ``hypotheses`` follows fits through time (``motion``), ``proposals`` adds hypotheses,
   ``decoder`` is the hidden Markov model, ``tracker`` runs all of it (class ``Tracker``).
8. Colour: ``appearance`` learns the surface's colours, ``colour_decision`` applies them to
   rotations that shape and motion leave undecided.
9. Refinement over all frames: ``whole`` calls ``rest`` (segments at rest), ``bridges`` (lost
   frames), ``given_poses`` (annotated poses) and ``smooth`` (most probable track, covariance).

Poses are master_from_object, in metres. The quality of a pose is a log-likelihood ratio in nats.
Constants that are marked as tuned were tuned on the studio's recordings.

Terms:

- Frame set: the images of all cameras of one frame; view: one camera's colour and depth image in
  it; candidate: an instance mask that a detector found in a view.
- Reduced image: every n-th pixel of an image, on which the tracker works.
- Step (6,): a small motion of a pose. A turn (rotation vector, radians) on the left about the
  object's origin, then a shift (metres), in the master frame. Twist (6,): step per second.
- Evidence: what the images say about a pose. In ``likelihood`` and ``decoder`` it is a
  log-likelihood ratio, in ``evidence``, ``rest`` and ``smooth`` a quadratic form of steps.
- Share: independent observations per frame, at most 1, because errors of masks last 0.3 s.
"""
