import numpy as np
import pytest

from torchqm.data.creatures.bodies import BODIES, build_skeleton
from torchqm.data.creatures.pose import deform, rotation
from torchqm.data.creatures.skeleton import Chain, Skeleton, reflection_group
from torchqm.data.creatures.surface import chain_distance, field, project


def test_a_single_segment_is_a_capsule():
    chain = Chain("rod", np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([0.2, 0.2]), 0.05)
    x = np.array([[0.5, 0.5, 0], [2, 0, 0], [-1, 0, 0], [0.3, 0, 0.2]])
    value, grad, arc = chain_distance(chain, x)
    assert value == pytest.approx([0.3, 0.8, 0.8, 0], abs=1e-12)
    assert grad == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]]), abs=1e-9)
    assert arc == pytest.approx([0.5, 1, 0, 0.3])


@pytest.mark.parametrize("kind", BODIES)
def test_the_gradient_is_the_derivative_on_the_surface(kind):
    skeleton = build_skeleton(kind, 1)
    rng = np.random.default_rng(0)
    low, high = skeleton.box
    x = rng.uniform(low, high, (4000, 3))
    x = x[np.abs(field(skeleton, x)[0]) < 0.05][:100]
    x, normal = project(skeleton, x, np.zeros(len(x), dtype=np.int64), 0.1, 12)
    value = field(skeleton, x)[0]
    assert np.abs(value).max() < 1e-9
    h = 1e-6
    numeric = np.stack(
        [(field(skeleton, x + h * e)[0] - field(skeleton, x - h * e)[0]) / (2 * h) for e in np.eye(3)], 1
    )
    numeric /= np.linalg.norm(numeric, axis=1, keepdims=True)
    assert (numeric * normal).sum(1).min() > 0.97  # flattened limbs have a first-order distance only


@pytest.mark.parametrize("kind", BODIES)
def test_the_function_has_the_symmetry_of_its_planes(kind):
    skeleton = build_skeleton(kind, 2)
    low, high = skeleton.box
    x = np.random.default_rng(0).uniform(low, high, (300, 3))
    value, _ = field(skeleton, x)
    near = np.abs(value) < 0.1
    for matrix in reflection_group(skeleton.planes):
        assert np.abs(field(skeleton, x @ matrix.T)[0] - value)[near].max() < 1e-4 * 0.1


def test_groups_of_planes():
    assert len(reflection_group(np.zeros((0, 3)))) == 1
    s, c = np.sin(np.pi / 8), np.cos(np.pi / 8)
    group = reflection_group([[0, 0, 1], [s, 0, -c]])
    assert len(group) == 16
    assert (np.linalg.det(group[:8]) > 0).all()
    assert (np.linalg.det(group[8:]) < 0).all()


def test_a_straight_rod_bends_without_stretching_its_axis():
    nodes = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    from torchqm.data.creatures.skeleton import Joint

    chain = Chain("rod", nodes, np.full(3, 0.05), 0.02, joints=(Joint(1, 0.4),))
    skeleton = Skeleton("rod", (chain,), np.zeros((0, 3)), 0.02)
    axis = np.stack([np.linspace(0.02, 0.98, 97), np.zeros(97), np.zeros(97)], 1)
    posed = deform(skeleton, {"rod": np.array([[0.0, 0.0, np.pi / 2]])}, axis)
    assert np.linalg.norm(np.diff(posed, axis=0), axis=1) == pytest.approx(0.01, rel=1e-3)
    assert np.diff(posed, axis=0)[-1] == pytest.approx([0, 0.01, 0], abs=1e-5)
    assert posed[0] == pytest.approx(axis[0])


def test_rotations_are_rotations():
    matrices = rotation(np.random.default_rng(0).standard_normal((20, 3)))
    assert np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(matrices) == pytest.approx(1)
    assert rotation(np.zeros((1, 3)))[0] == pytest.approx(np.eye(3))
