"""Velocity from frame to frame: what is measured counts by its covariance."""

from depth_deblur_ros.glide import Glide, RESTLESS, unknown_glide, Way
import numpy as np
import pytest

SURE = 1e-8 * np.eye(6)
U = np.array([0.5, -1.0, 0.2, 0.1, 0.3, -0.2])


def gone(way):
    return Way(way, SURE, np.eye(6, 12))


def test_an_even_motion_is_found():
    glide = unknown_glide()
    for _ in range(8):
        glide = glide.moved(0.033, gone(0.033 * U))
    np.testing.assert_allclose(glide.velocity, U, atol=1e-3)


def test_looking_ahead_halves_the_doubt_of_a_turn():
    def way(t):  # sin(5 t) rad about each axis
        return np.full(6, np.sin(5 * (t + 0.033)) - np.sin(5 * t))

    glide, t = unknown_glide(), 0.0
    for _ in range(8):
        glide = glide.moved(0.033, gone(way(t)))
        t += 0.033
    ahead = glide.before(0.033, gone(way(t)))
    truth = 5 * np.cos(5 * t)
    assert np.abs(ahead.velocity - truth).max() < 0.05 * abs(truth)
    assert np.abs(ahead.velocity - truth).max() < np.abs(glide.velocity - truth).max()
    assert np.all(np.diag(ahead.spread) < 0.25 * np.diag(glide.spread))


def test_doubt_grows_while_nothing_is_seen():
    glide = unknown_glide().measured(U, SURE)
    doubts = [np.trace(glide.spread)]
    for _ in range(5):
        glide = glide.moved(0.033, None)
        doubts.append(np.trace(glide.spread))
    assert np.all(np.diff(doubts) > 0)


def test_the_noise_does_not_depend_on_how_time_is_cut():
    start = unknown_glide().measured(U, SURE)
    one = start.moved(0.06, None)
    two = start.moved(0.03, None).moved(0.03, None)
    np.testing.assert_allclose(one.mean, two.mean)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=0.02, atol=1e-6)


def test_two_measurements_count_by_their_weights():
    glide = Glide(np.zeros(12), np.eye(12), RESTLESS)
    found = glide.measured(U, np.eye(6))
    np.testing.assert_allclose(found.velocity, U / 2)
    np.testing.assert_allclose(np.diag(found.spread), 0.5)


@pytest.mark.parametrize(('size', 'restless'), [(0.0, False), (3.0, True)])
def test_unrest_follows_what_happens(size, restless):
    glide, rng = unknown_glide(), np.random.default_rng(0)
    for _ in range(20):
        glide = glide.moved(0.033, gone(0.033 * size * rng.standard_normal(6)))
    assert bool(glide.unrest[0] > RESTLESS[0]) == restless


def test_a_way_that_shows_acceleration_too_is_taken_for_what_it_is():
    look, rate = np.eye(6, 12), 5.0
    look[2, 7] = 0.01  # the change of the second looks like some of the third

    def way(t):
        start, end = (np.sin(rate * s) / rate for s in (t, t + 0.033))
        gained = (np.cos(rate * (t + 0.033)) - np.cos(rate * t)) / 0.033
        return np.array([0, end - start, 0.01 * gained, 0, 0, 0])

    plain, told, t = unknown_glide(), unknown_glide(), 0.0
    for _ in range(12):
        plain = plain.moved(0.033, gone(way(t)))
        told = told.moved(0.033, Way(way(t), SURE, look))
        t += 0.033
    assert abs(told.velocity[2]) < 0.2 * abs(plain.velocity[2])


def test_the_likelier_way_is_the_one_that_was_foreseen():
    glide = unknown_glide()
    for _ in range(5):
        glide = glide.moved(0.033, gone(0.033 * U))
    right, wrong = (glide.foreseen(0.033, gone(0.033 * u))[1] for u in (U, 2 * U))
    assert right > wrong + 5


@pytest.mark.parametrize('speed', [-1.0, 0.0, 2.0])
def test_a_velocity_that_jumps_leaves_no_swing(speed):
    doubt = Way(0.033 * U, 1e-7 * np.eye(6), np.eye(6, 12))
    glide = unknown_glide()
    for _ in range(20):
        glide = glide.moved(0.033, doubt)
    off = []
    for _ in range(4):
        glide = glide.moved(0.033, Way(0.033 * speed * U, doubt.covariance, doubt.look))
        off.append(np.linalg.norm(glide.velocity - speed * U) / np.linalg.norm(U))
    assert max(off[1:]) < 0.15, off
