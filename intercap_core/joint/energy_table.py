"""The terms of the energy: residuals and Jacobians, one file a term.

The table says where each equation of the InterCap paper (Huang et al. 2022; "A.n" of its appendix)
is found, and what goes beyond the paper. Files are below ``intercap_core/``. A setting is the
weight or switch of a term, "same" that of the row above, "-" where no setting weighs it: its
strength follows from the noise of what is measured or the spread of a prior. Formulas and
differences from the paper are in ``docs/equations.md``.

| paper | term | file | function or class | setting |
| --- | --- | --- | --- | --- |
| 1 | E_O: silhouette | object_track/object_silhouette.py | residuals | - |
| 1 | E_O: silhouette, compiled | object_track/object_silhouette_kernel.py | normal_equations | - |
| 1 | E_O: depth | object_track/object_depth.py | residuals | - |
| 1 | E_O: depth, compiled | object_track/object_depth_kernel.py | normal_equations | - |
| 1 | E_O: sum over views | object_track/fit.py | fit_pose | - |
| beyond | background | object_track/object_silhouette.py | residuals | object_track.background_term |
| beyond | expected object pose | object_track/fit.py | MotionPrior | - |
| beyond | object track over time | object_track/smooth.py | smooth | - |
| 2 | E_B: sum of terms | body_fit/problem.py | BodyProblem | - |
| 2, 3 | E_J | body_fit/keypoint_term.py | KeypointTerm | - |
| 2, 3 | E_J, compiled | body_fit/keypoint_kernel.py | add_equations | - |
| 2, 4 | E_D | body_fit/cloud_term.py | CloudTerm | body_fit.cloud_weight |
| 2, 4 | E_D, compiled | body_fit/cloud_term.py | add_equations | same |
| 2, 5, 6 | E_P_self | body_fit/self_term.py | SelfPenetrationTerm | body_fit.self_penetration_weight |
| 2, 5, 6 | E_P_self, compiled | body_fit/self_term.py | add_equations | same |
| 2 | E_theta_b | body/priors.py | rest_pose | - |
| 2 | E_theta_b with VPoser | body/vposer.py | VPoser | - |
| 2 | E_theta_h | body/priors.py | hand_pose | - |
| 2 | E_theta_f (jaw, eyes) | body/priors.py | rest_pose | - |
| 2 | E_alpha | body/priors.py | bending | - |
| 2 | E_beta, E_psi: sum of priors | body_fit/prior_term.py | PriorTerm | - |
| 2 | E_beta of a shared shape | body_fit/problem.py | Layout | - |
| 2 | priors, compiled | body_fit/prior_term.py | add_priors | - |
| beyond | joint limits | body/priors.py | joint_limits | - |
| beyond | triangulated keypoints | body_fit/keypoint_term.py | triangulated | - |
| beyond | keypoint offsets | body_fit/keypoint_term.py | Keypoints | - |
| beyond | thickness of clothing | body_fit/surface.py | Covering | - |
| beyond | free space | body_fit/free_space.py | seen_through | body_fit.cloud_weight |
| beyond | rims of the person's masks | body_fit/outlines.py | touching | body_fit.cloud_weight |
| 6 | E: sum of terms | joint/problem.py | joint_terms | - |
| 6 | E_B | joint/terms/body_data.py | BodyData | - |
| 6 | E_O, looked at anew | joint/terms/object_images.py | ObjectImagesData | joint.look_again |
| 6 | E_O, the track for them | joint/terms/object_data.py | ObjectData | joint.look_again |
| beyond | no object in place of E_O | joint/terms/no_object.py | NoObject | - |
| 6, A.4 | E_C: residuals | joint/terms/contact_residual.py | term | joint.contact_weight |
| 6, A.4 | E_C with Q_t | joint/terms/contact.py | Contact | joint.contact_weight |
| 6, A.4 | E_C: to any or annotated points | joint/proximity.py | proximity | joint.contact_to |
| 6 | Q_t given | joint/contact/annotated.py | annotation_evidence | joint.annotation_uncertainty_frames |
| beyond | Q_t found | joint/contact/detect.py | contact_probability | joint.detect_contact |
| beyond | stick: points on the object | joint/terms/stick_residual.py | local_points | joint.stick_weight |
| beyond | stick | joint/terms/stick.py | Stick | joint.stick_weight |
| beyond | plant | joint/terms/plant.py | Plant | joint.plant_weight |
| beyond | what stands, detected | joint/contact/standing.py | standing_probability | - |
| beyond | body in object: residuals | joint/terms/penetration_residual.py | weights | joint.penetration_weight |
| beyond | body in object | joint/terms/penetration.py | Penetration | joint.penetration_weight |
| beyond | object in body: distances | joint/terms/object_in_body_residual.py | embedded | same |
| beyond | object in body | joint/terms/object_in_body.py | ObjectInBody | same |
| 6, A.5 | E_G: residuals | joint/terms/ground_residual.py | residuals | joint.ground_weight |
| 6, A.5 | E_G | joint/terms/ground.py | BodyGround | joint.ground_weight |
| 6, A.6 | E_G' | joint/terms/ground.py | ObjectGround | joint.ground_weight |
| 6, A.1 | E_S | joint/terms/motion.py | BodyMotion | joint.body_smoothness |
| 6, A.1 | E_S with LEMO's encoder | joint/terms/learned_motion.py | LearnedMotion | joint.lemo |
| A.2 | F_S: LEMO's encoder | body/lemo.py | MotionEncoder | same |
| 6, A.3 | E_A: residuals | joint/smoothness.py | accelerations | joint.object_smoothness |
| 6, A.3 | E_A | joint/terms/motion.py | ObjectMotion | joint.object_smoothness |
| beyond | drift of the body | joint/terms/drift.py | BodyDrift | joint.drift_weight |
| beyond | drift of the object | joint/terms/drift.py | ObjectDrift | joint.drift_weight |
| beyond | the cameras, corrected | joint/cameras.py | CameraFit | joint.refine_cameras |
| beyond | what the body says of them | joint/terms/body_cameras.py | add_by_cameras | - |
| beyond | time offsets of the cameras | joint/time_offsets.py | estimate_offsets | - |

Terms take arrays and return residuals, weights and Jacobians, or add to normal equations. Their
callers find correspondences and weigh terms against each other.
"""  # noqa: E501
