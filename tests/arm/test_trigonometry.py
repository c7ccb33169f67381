"""Cosine and sine, beside NumPy's in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.arm.trigonometry import cos_sin


@pytest.mark.parametrize("most", [1e-3, 3.5, 100.0, 8192.0])
def test_as_exact_as_float32(most):
    q = np.random.default_rng(0).uniform(-most, most, 1_000_000).astype(np.float32)
    found = jax.jit(cos_sin)(q)
    for value, expected in zip(found, (np.cos(q, dtype=float), np.sin(q, dtype=float)), strict=True):
        assert value.dtype == jnp.float32
        np.testing.assert_allclose(value, expected, atol=1.2e-7)


@given(st.floats(-8192, 8192, width=32))
def test_any_angle(q):
    cosine, sine = cos_sin(jnp.float32(q))
    assert (cosine, sine) == pytest.approx((np.cos(q), np.sin(q)), abs=1.2e-7)


def test_quarter_turns():
    turns = np.arange(-8, 9) * np.pi / 2
    cosine, sine = cos_sin(jnp.asarray(turns, jnp.float32))
    np.testing.assert_allclose(cosine, np.cos(turns), atol=1e-6)
    np.testing.assert_allclose(sine, np.sin(turns), atol=1e-6)


def test_its_derivatives():
    q = jnp.linspace(-4, 4, 101)
    for i, derivative in enumerate((lambda q: -jnp.sin(q), jnp.cos)):
        found = jax.vmap(jax.grad(lambda q, i=i: cos_sin(q)[i]))(q)
        np.testing.assert_allclose(found, derivative(q), atol=1e-6)


def test_what_is_no_angle_has_no_cosine():
    assert np.isnan(cos_sin(jnp.array([jnp.nan, jnp.inf, -jnp.inf]))).all()


def test_in_double_precision_too():
    with jax.enable_x64(True):
        q = jnp.linspace(-4, 4, 101)
        np.testing.assert_allclose(cos_sin(q), (np.cos(q), np.sin(q)), atol=1e-15)
