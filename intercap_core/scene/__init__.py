"""What stands still and when each camera exposes: the room of the stage ``scene``.

In the order of a run (:mod:`intercap_core.stages.scene`):

0. ``moments`` puts the first steps together. ``start_times``: cameras that started apart, before
   anything compares views.
1. ``subject_views``: the subject in every view at the given poses; ``late_views`` adds images that
   are frames late.
2. ``slips``: images that are whole frames late, found by the body's motion. It rests on
   ``keypoint_motion`` (keypoints against one moving body), ``smooth_paths`` (Whittaker's smoother)
   and ``keypoint_noise`` (covariance of a detector's errors over time).
3. ``keypoint_timing``: each camera's time offset, by generalised least squares on the same motion.
4. ``background``: the static depth of each camera; ``person_space`` leaves the subject out.
5. ``lens_exchange``: cameras that were given each other's lenses, by the background, or by the
   keypoints (``lenses``) where there is no depth.
6. ``surface`` and ``moving``: background and foreground as thinned points with normals, the latter
   with their speed.
7. ``extrinsics``: refines the poses, depth biases and time offsets and decides whether the result
   is better than the start, ``camera_verdicts`` of each camera by itself. The problem is in
   ``registration`` (point-to-plane residuals of all pairs of cameras, ``balance`` weighs them by
   direction), ``body_constraints`` (reprojection of keypoints, points eliminated) and
   ``floor_constraint`` (one floor under all cameras).
8. ``ground``: the floor's plane and the z-up frame.

``constants`` holds the room's numbers.
"""
