"""Replay buffer on the device: a ring of transitions, written in place when donated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree

from arm5dof.envs.base import Observation


class Transition(struct.PyTreeNode):
    """What one step taught. In the buffer all fields have a leading axis."""

    obs: Observation
    action: jax.Array
    reward: jax.Array
    next_obs: Observation
    """The observation the step led to, also where it ended an episode."""
    terminal: jax.Array
    """1.0 where nothing follows (no bootstrapping); 0.0 at a time limit."""
    weight: jax.Array
    """1.0, or 0.0 for a step that nothing should be learnt from (physics that blew up)."""
    step: jax.Array
    """Which step of its episode it is, from 0."""


class Replay(struct.PyTreeNode):
    """Ring buffer of transitions. Each is one row, so that reading one at random touches memory in one place.
    Whole numbers in observations are exact up to 2^24, if there are floats beside them."""

    rows: jax.Array
    """(capacity, width)."""
    position: jax.Array
    """Where the next batch goes."""
    size: jax.Array
    """How many rows hold a transition."""
    batch: int = struct.field(pytree_node=False)
    """Transitions written at once, one of each environment, always in the same order."""
    unravel: Callable[[jax.Array], Transition] = struct.field(pytree_node=False)
    """A row (width,) as a transition."""

    @staticmethod
    def create(example: Transition, capacity: int, batch: int) -> Replay:
        """An empty buffer for batches of transitions like `example` (shapes without a leading axis). Raises
        `ValueError` unless the capacity is a multiple of the batch: so a batch never wraps around, and the write is
        one slice update."""
        if capacity % batch:
            raise ValueError(f"capacity {capacity} is no multiple of the batch of {batch}")
        row, unravel = ravel_pytree(example)
        zero = jnp.zeros((), jnp.int32)
        return Replay(jnp.zeros((capacity, row.size), row.dtype), zero, zero, batch, unravel)

    @property
    def capacity(self) -> int:
        return self.rows.shape[0]

    @property
    def storage(self) -> Transition:
        """All rows as transitions, leading axis `capacity`."""
        return self._unpack(self.rows)

    def insert(self, batch: Transition) -> Replay:
        """Write a batch over the oldest transitions."""
        rows = jax.vmap(lambda transition: ravel_pytree(transition)[0])(batch)
        if len(rows) != self.batch:
            raise ValueError(f"a batch of {len(rows)}, where the buffer takes {self.batch} at a time")
        return self.replace(
            rows=jax.lax.dynamic_update_slice_in_dim(self.rows, rows, self.position, 0),
            position=(self.position + self.batch) % self.capacity,
            size=jnp.minimum(self.size + self.batch, self.capacity),
        )

    def sample(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Numbers of rows, of the given shape, drawn uniformly with replacement. The buffer must not be empty."""
        return jax.random.randint(key, shape, 0, self.size)

    def later(self, key: jax.Array, rows: jax.Array, episode_length: int) -> jax.Array:
        """For each of some rows one drawn uniformly from those of the same episode that are not earlier, as far as
        they have been written."""
        step = partial(self._field, "step")
        newest = (self.position - 1) // self.batch - rows // self.batch
        ahead = newest % (self.capacity // self.batch)  # Batches written since.
        first = step(rows)
        # An environment's steps count on until its episode ends: the last that does is found by bisection.
        low, high = jnp.zeros_like(rows), jnp.minimum(ahead, episode_length - 1)
        for _ in range(episode_length.bit_length()):
            middle = (low + high + 1) // 2
            same = step((rows + middle * self.batch) % self.capacity) == first + middle
            low, high = jnp.where(same, middle, low), jnp.where(same, high, middle - 1)
        return (rows + jax.random.randint(key, rows.shape, 0, low + 1) * self.batch) % self.capacity

    def read(self, rows: jax.Array) -> Transition:
        """The transitions in some rows (any leading axes)."""
        # The barrier keeps XLA from reading the buffer once for every field.
        return self._unpack(jax.lax.optimization_barrier(self.rows[rows]))

    def _field(self, name: str, rows: jax.Array) -> jax.Array:
        """A scalar field of the transitions in some rows, read alone."""
        columns = self.unravel(jnp.arange(self.rows.shape[1], dtype=self.rows.dtype))
        return self.rows[rows, getattr(columns, name).astype(jnp.int32)]

    def _unpack(self, rows: jax.Array) -> Transition:
        """Rows (..., width) as transitions with the same leading axes."""
        transitions = jax.vmap(self.unravel)(rows.reshape(-1, rows.shape[-1]))
        return jax.tree.map(lambda x: x.reshape(rows.shape[:-1] + x.shape[1:]), transitions)
