"""Replay buffer on the device: a ring of transitions, written in place when donated."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

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
    """Ring buffer of transitions with leading axis `capacity`. `position` is where the next batch goes."""

    storage: Transition
    position: jax.Array
    size: jax.Array

    @staticmethod
    def create(example: Transition, capacity: int) -> Replay:
        """An empty buffer for transitions like `example` (shapes without a leading axis)."""
        storage = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
        zero = jnp.zeros((), jnp.int32)
        return Replay(storage, zero, zero)

    @property
    def capacity(self) -> int:
        return self.storage.reward.shape[0]

    def insert(self, batch: Transition) -> Replay:
        """Write a batch over the oldest transitions. The capacity must be a multiple of the batch's length, so that
        a batch never wraps around and the write is one slice update."""
        count = batch.reward.shape[0]
        if self.capacity % count:
            raise ValueError(f"capacity {self.capacity} is no multiple of the batch of {count}")
        storage = jax.tree.map(
            lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, self.position, 0), self.storage, batch
        )
        position = (self.position + count) % self.capacity
        return Replay(storage, position, jnp.minimum(self.size + count, self.capacity))

    def sample(self, key: jax.Array, shape: tuple[int, ...]) -> Transition:
        """Transitions drawn uniformly with replacement, leading axes `shape`. The buffer must not be empty."""
        index = jax.random.randint(key, shape, 0, self.size)
        return jax.tree.map(lambda x: x[index], self.storage)
