"""Replay buffer on the device: a ring of transitions, written in place when donated."""

from __future__ import annotations

from collections.abc import Callable

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


class Replay(struct.PyTreeNode):
    """Ring buffer of transitions. Each is one row, so that reading one at random touches memory in one place.
    Whole numbers in observations are exact up to 2^24, if there are floats beside them."""

    rows: jax.Array
    """(capacity, width)."""
    position: jax.Array
    """Where the next batch goes."""
    size: jax.Array
    """How many rows hold a transition."""
    unravel: Callable[[jax.Array], Transition] = struct.field(pytree_node=False)
    """A row (width,) as a transition."""

    @staticmethod
    def create(example: Transition, capacity: int) -> Replay:
        """An empty buffer for transitions like `example` (shapes without a leading axis)."""
        row, unravel = ravel_pytree(example)
        zero = jnp.zeros((), jnp.int32)
        return Replay(jnp.zeros((capacity, row.size), row.dtype), zero, zero, unravel)

    @property
    def capacity(self) -> int:
        return self.rows.shape[0]

    @property
    def storage(self) -> Transition:
        """All rows as transitions, leading axis `capacity`."""
        return self._unpack(self.rows)

    def insert(self, batch: Transition) -> Replay:
        """Write a batch over the oldest transitions. The capacity must be a multiple of the batch's length, so that
        a batch never wraps around and the write is one slice update."""
        rows = jax.vmap(lambda transition: ravel_pytree(transition)[0])(batch)
        count = len(rows)
        if self.capacity % count:
            raise ValueError(f"capacity {self.capacity} is no multiple of the batch of {count}")
        return self.replace(
            rows=jax.lax.dynamic_update_slice_in_dim(self.rows, rows, self.position, 0),
            position=(self.position + count) % self.capacity,
            size=jnp.minimum(self.size + count, self.capacity),
        )

    def sample(self, key: jax.Array, shape: tuple[int, ...]) -> Transition:
        """Transitions drawn uniformly with replacement, leading axes `shape`. The buffer must not be empty."""
        index = jax.random.randint(key, shape, 0, self.size)
        # The barrier keeps XLA from reading the buffer once for every field.
        return self._unpack(jax.lax.optimization_barrier(self.rows[index]))

    def _unpack(self, rows: jax.Array) -> Transition:
        """Rows (..., width) as transitions with the same leading axes."""
        transitions = jax.vmap(self.unravel)(rows.reshape(-1, rows.shape[-1]))
        return jax.tree.map(lambda x: x.reshape(rows.shape[:-1] + x.shape[1:]), transitions)
