"""Contact without annotation."""

import numpy as np

from intercap_core.joint.contact.detect import (
    FRAME_SIGMA,
    RegionMotion,
    contact_probability,
    lasting_error,
)
from intercap_core.joint.contact.estimate import ContactEstimate
from intercap_core.schemas import CONTACT_REGIONS

FPS = 15.0


def _motion(distance, slip, speed, sigma=0.012):
    distance = np.asarray(distance, float)
    return RegionMotion(
        distance,
        np.broadcast_to(np.asarray(slip, float), distance.shape),
        np.broadcast_to(np.asarray(speed, float), distance.shape),
        np.full_like(distance, sigma),
    )


def test_a_hand_that_carries_touches_and_the_far_one_does_not():
    distance = np.stack([np.full(30, 0.01), np.full(30, 0.35)], axis=1)
    slip = np.stack([np.full(30, 0.05), np.full(30, 0.8)], axis=1)
    probability = contact_probability(_motion(distance, slip, 0.8), FPS)
    assert (probability[:, 0] > 0.9).all()
    assert (probability[:, 1] < 0.1).all()


def test_a_pass_over_a_resting_object_is_no_contact():
    distance = np.full((30, 1), 0.12)
    distance[14:16] = 0.03
    probability = contact_probability(_motion(distance, 0.5, 0.0), FPS)
    assert (probability < 0.5).all()


def test_a_near_hand_that_lets_a_moving_object_slide_past_is_less_likely_than_one_that_holds():
    distance = np.full((30, 2), 0.015)
    slip = np.stack([np.full(30, 0.05), np.full(30, 0.9)], axis=1)
    probability = contact_probability(_motion(distance, slip, 0.9), FPS)
    assert (probability[:, 0] > probability[:, 1] + 0.3).all()


def test_not_knowing_where_the_object_is_does_not_refute_a_grasp():
    sigma = np.full((60, 1), 0.012)
    sigma[20:50] = 0.5
    motion = _motion(np.zeros((60, 1)), 0.0, 0.0)
    motion = RegionMotion(motion.distance, motion.slip, motion.object_speed, sigma)
    assert (contact_probability(motion, FPS) > 0.5).all()


def test_a_hand_deep_in_the_object_touches_it():
    assert (contact_probability(_motion(np.full((30, 1), -0.04), 0.0, 0.0), FPS) > 0.9).all()


def test_a_sip_of_a_third_of_a_second_is_found():
    distance = np.full((30, 1), 0.20)
    distance[10:19, 0] = [0.09, 0.045, 0.001, 0.0, 0.0, 0.0, 0.0, 0.05, 0.12]
    probability = contact_probability(_motion(distance, 0.3, 0.05, sigma=0.009), FPS)[:, 0]
    assert (probability[12:17] > 0.5).all()
    assert (probability[:11] < 0.5).all() and (probability[18:] < 0.5).all()


def test_a_hand_that_stays_three_deviations_off_does_not_touch():
    motion = _motion(np.full((45, 1), 0.024), 0.0, 0.0, sigma=0.008)
    probability = contact_probability(motion, FPS)
    assert (probability < 0.5).all()


def test_the_lasting_error_of_a_long_contact_sharpens_its_ends():
    """All distances of one region are 8 mm too small: with that known, 6 mm are no contact."""
    true = np.concatenate([[0.05, 0.03, 0.014, 0.014], np.zeros(25), [0.014, 0.014, 0.03, 0.05]])
    motion = _motion(true[:, None] - 0.008, 0.0, 0.0, sigma=0.009)
    probability = contact_probability(motion, FPS)[:, 0]
    np.testing.assert_array_equal(probability > 0.5, true == 0.0)


def test_a_lasting_error_is_the_weighted_mean_of_prior_and_measurements():
    motion = _motion(np.full((10, 1), 0.004), 0.0, 0.0, sigma=0.01)
    error, sigma = lasting_error(motion, np.ones((10, 1)), 2.0)
    precision = 5 / FRAME_SIGMA**2
    np.testing.assert_allclose(error, 0.004 * precision / (precision + 1e4), rtol=1e-9)
    np.testing.assert_allclose(sigma, np.hypot((precision + 1e4) ** -0.5, FRAME_SIGMA), rtol=1e-9)
    untouched, sigma = lasting_error(motion, np.full((10, 1), 0.4), 2.0)
    assert untouched == 0
    np.testing.assert_allclose(sigma, np.hypot(0.01, FRAME_SIGMA), rtol=1e-9)


def test_unknown_contact_does_not_change():
    shape = (4, len(CONTACT_REGIONS))
    labels = np.full(shape, -1, np.int8)
    unknown, half, none = (
        ContactEstimate(np.full(shape, value), labels) for value in (np.nan, 0.5, 0.0)
    )
    assert unknown.change(unknown) == 0
    assert half.change(none) == 0.5
