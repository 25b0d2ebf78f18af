"""Quaternions and rotations agree with MuJoCo, and with each other."""

import mujoco
import numpy as np
import pytest

from libero_env.geometry import (
    Pose,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
    quat_to_axis_angle,
    quat_to_mat,
    rotation_between,
)


@pytest.fixture
def quats():
    quats = np.random.default_rng(0).normal(size=(20, 4))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def test_products_are_those_of_mujoco(quats):
    a, b = quats[:10], quats[10:]
    expected = np.empty((10, 4))
    for i in range(10):
        mujoco.mju_mulQuat(expected[i], a[i], b[i])
    np.testing.assert_allclose(quat_multiply(a, b), expected, atol=1e-15)


def test_the_bits_of_a_row_do_not_depend_on_the_others(quats):
    a, b, vectors = quats[:10], quats[10:], quats[:10, 1:]
    for i in range(10):
        np.testing.assert_array_equal(quat_multiply(a[i : i + 1], b[i : i + 1])[0], quat_multiply(a, b)[i])
        np.testing.assert_array_equal(
            quat_rotate(a[i : i + 1], vectors[i : i + 1])[0], quat_rotate(a, vectors)[i]
        )


def test_a_quaternion_rotates_as_its_matrix(quats):
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    expected = [quat_to_mat(quat) @ vector for quat, vector in zip(quats, vectors, strict=True)]
    np.testing.assert_allclose(quat_rotate(quats, vectors), expected, atol=1e-12)


def test_axis_and_angle_give_the_quaternion_back(quats):
    for quat, vector in zip(quats, quat_to_axis_angle(quats), strict=True):
        angle = np.linalg.norm(vector)
        assert abs(quat_from_axis_angle(vector / angle, angle) @ quat) == pytest.approx(1)
    np.testing.assert_array_equal(quat_to_axis_angle(np.array([[1.0, 0.0, 0.0, 0.0]])), np.zeros((1, 3)))


def test_the_rotation_between_orientations_leads_from_one_to_the_other(quats):
    start, goal = quat_to_mat(quats[0]), quat_to_mat(quats[1])
    vector = rotation_between(start, goal)
    angle = np.linalg.norm(vector)
    np.testing.assert_allclose(
        quat_to_mat(quat_from_axis_angle(vector / angle, angle)) @ start, goal, atol=1e-9
    )
    np.testing.assert_allclose(rotation_between(start, start), np.zeros(3), atol=1e-7)


def test_a_pose_and_its_inverse(quats):
    pose = Pose(np.array([0.1, -0.2, 0.3]), quat_to_mat(quats[2]))
    point = np.array([0.5, 0.6, -0.7])
    np.testing.assert_allclose(pose.invert(pose.apply(point[None])[0]), point, atol=1e-12)
