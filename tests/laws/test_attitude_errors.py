"""Retractions by modified Rodrigues parameters and by the quaternion's vector part: what they are, near and far."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.geometry import mrp_left, so3_left, vector_part_left

LEFT = [mrp_left, vector_part_left]
plus = {r.name: jax.jit(r.boxplus) for r in LEFT}
minus = {r.name: jax.jit(r.boxminus) for r in LEFT}
transport = {r.name: jax.jit(r.transport) for r in LEFT if r.transport}
law = settings(deadline=None, max_examples=60, derandomize=True)


def rotvecs(largest):
    return st.integers(0, 2**32 - 1).map(lambda seed: _rotvec(np.random.default_rng(seed), largest))


def _rotvec(rng, largest):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v) * largest * rng.choice([0.0, 1e-9, 1e-3, 0.3, 0.9, 1.0])


def error_of(name, turn):
    """Of a turn (a rotation vector), by scipy: four times the MRP, or the vector part of the quaternion."""
    if name == "mrp_left":
        return 4.0 * Rotation.from_rotvec(turn).as_mrp()
    return Rotation.from_rotvec(turn).as_quat(canonical=True)[:3]


@pytest.mark.parametrize("name", [r.name for r in LEFT])
@law
@given(turn=rotvecs(np.pi - 1e-3), start=rotvecs(3.0))
def test_the_error_is_that_of_the_turn_and_comes_back(name, turn, start):
    q = Rotation.from_rotvec(start).as_quat()
    d = error_of(name, turn)
    p = np.asarray(plus[name](q, d))
    # A vector part near 1 leaves the scalar part to the root of what is left: an ulp of it is 1e-3 of rounding there.
    near_pi = name == "vector_part_left" and np.linalg.norm(turn) > 3.0
    expected = Rotation.from_rotvec(turn) * Rotation.from_quat(q)
    assert (Rotation.from_quat(p) * expected.inv()).magnitude() < (1e-11 if near_pi else 2e-15)
    np.testing.assert_allclose(minus[name](p, q), d, atol=1e-12)
    np.testing.assert_allclose(minus[name](-p, q), d, atol=1e-12)  # the same rotation
    D = np.asarray(transport[name](d))
    np.testing.assert_allclose(D, Rotation.from_rotvec(turn).as_matrix(), atol=1e-11 if near_pi else 4e-15)


@law
@given(turn=rotvecs(0.01))
def test_near_zero_they_are_the_rotation_vector_and_half_of_it(turn):
    q = np.array([0.0, 0.0, 0.0, 1.0])
    p = so3_left.boxplus(q, turn)
    # The next term of 4 tan(t / 4) is t^3 / 48, of sin(t / 2) it is t^3 / 48 too.
    size = np.linalg.norm(turn) ** 3 / 40 + 1e-16
    assert np.linalg.norm(np.asarray(minus["mrp_left"](p, q)) - turn) <= size
    assert np.linalg.norm(np.asarray(minus["vector_part_left"](p, q)) - 0.5 * turn) <= size


@pytest.mark.parametrize("r", LEFT, ids=lambda r: r.name)
def test_derivatives_are_finite_at_zero_and_at_half_a_turn(r):
    q = jnp.array([0.0, 0.0, 0.0, 1.0])
    largest = {"mrp_left": 4.0, "vector_part_left": 1.0}[r.name]
    for d in (jnp.zeros(3), jnp.array([largest, 0.0, 0.0])):
        assert np.isfinite(np.asarray(jax.jacfwd(lambda e: r.boxplus(q, e))(d))).all()


def test_a_vector_part_that_no_rotation_has_is_shortened():
    q = np.array([0.0, 0.0, 0.0, 1.0])
    p = np.asarray(plus["vector_part_left"](q, np.array([0.0, 3.0, 0.0])))
    np.testing.assert_allclose(p, [0.0, 1.0, 0.0, 0.0], atol=1e-15)
