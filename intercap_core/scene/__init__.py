"""Camera poses, exposure times, static background and floor of one recording (stage ``scene``).

Terms of this package:

- *set* (frame set): the images that device times group together, at most one per camera. Sets have
  indices 0 to T - 1 and times ``times``.
- *moment*: what the cameras really show at the time of a set. A camera with wrong device times
  shows moment t in an image of another set.
- *delay* (``late``, ``slip``): how much older an image is than its set, in whole sets or seconds. A
  camera with a delay of d sets shows moment t in set t + d.
- *time offset*: sub-set remainder, seconds from the time of the set to the exposure.
- *master*: the camera whose frame and clock are the common ones.

In the order of a run (:mod:`intercap_core.stages.scene`):

1. ``moments`` assigns each image to the set whose moment it shows. It calls

   - ``start_times``: cameras that were started separately (``starts`` has the types,
     ``start_costs`` the epipolar costs);
   - ``subject_views``: the subject's detections and triangulated joints;
   - ``slips``: images that are whole frames late;
   - ``keypoint_timing``: sub-frame time offsets.

   The last two share ``keypoint_motion``, the residuals of the keypoints against ``smooth_paths``.
2. ``background`` estimates the static depth of each camera, ``surfaces`` turns background and
   foreground into thinned points with normals.
3. ``lens_exchange`` corrects pairs of cameras whose intrinsics were exchanged.
4. ``extrinsics`` refines the poses. ``registration`` has the problem (point-to-plane residuals of
   all pairs of cameras), ``constraints`` its further terms (keypoints, common floor). A refined
   pose is kept only if ``camera_verdicts`` finds it better on held-out data.
5. ``floor`` chooses the floor and the up direction; ``ground`` fits planes, ``up`` directions.
"""
