"""The velocity of a straight motion is exact, noise of the encoder is reduced, and old readings are forgotten."""

import numpy as np

from dualbrain.safety.integration.servo_bus.velocity_estimate import VelocityEstimate

RESOLUTION = 2.0 * np.pi / 4096


def test_a_constant_velocity_is_found_exactly():
    estimate, v = VelocityEstimate(), np.array([1.0, -0.3])
    found = [estimate.update(t, 0.2 + v * t) for t in np.arange(0.0, 0.05, 0.005)]
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_allclose(found[1:], [v] * 9, atol=1e-9)


def test_the_error_by_the_resolution_of_the_encoder_is_a_third_of_that_of_a_difference():
    estimate, times = VelocityEstimate(), np.arange(0.0, 20.0, 0.005)
    q = 0.5 * np.sin(times)
    read = RESOLUTION * np.round(q / RESOLUTION)
    found = np.array([estimate.update(t, np.array([x]))[0] for t, x in zip(times, read, strict=True)])
    truth = 0.5 * np.cos(times - 0.01)
    difference = np.diff(read) / 0.005
    assert np.std((found - truth)[10:]) < 0.4 * np.std(difference - truth[1:])


def test_gaps_jumps_of_the_clock_and_bad_readings_begin_again():
    estimate = VelocityEstimate()
    for t in np.arange(0.0, 0.03, 0.005):
        estimate.update(t, np.array([t]))
    np.testing.assert_array_equal(estimate.update(1.0, np.array([5.0])), 0.0)
    np.testing.assert_array_equal(estimate.update(0.5, np.array([1.0])), 0.0)
    assert np.isnan(estimate.update(0.505, np.array([np.nan]))).all()
    np.testing.assert_array_equal(estimate.update(0.51, np.array([1.0])), 0.0)
