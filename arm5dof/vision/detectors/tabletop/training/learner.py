"""`Learner`: the compiled update of one of the detector's networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from flax import linen as nn
from flax import struct

from arm5dof.runtime import xla
from arm5dof.vision.detectors.tabletop.networks import fold_batch_norm
from arm5dof.vision.detectors.tabletop.training.losses import Losses

WARM_UP = 200
"""Steps over which the learning rate rises."""
LEARNING_RATE, WEIGHT_DECAY = 8e-3, 0.005
"""Of Muon (Jordan et al., 2024); the former after the warm-up. It falls along half a cosine."""
ADAM_SHARE = 0.25
"""What has no matrices learns by Adam, at this share of the rate."""
FINAL_SHARE = 0.01
"""Share of the learning rate at the end."""
MAX_GRADIENT = 10.0
"""Longest gradient."""
AVERAGE_DECAY = 0.995
"""The weights kept are an average over some 200 steps, fewer at the start (Tarvainen and Valpola, 2017)."""


class State(struct.PyTreeNode):
    """A network as it is and on average, and the optimizer's memory."""

    variables: dict[str, Any]
    average: dict[str, Any]
    optimizer: optax.OptState
    steps: jax.Array


class Learner:
    """The compiled update of a network. `state` is all that there is to a training.

    Args:
        network: With batch normalization, in training.
        losses: Of one example, from what the network answers and what it should have answered.
        example: What the network takes.
        steps: How many updates there will be, from which the learning rate follows.
        seed: Of the initial weights.
    """

    def __init__(
        self, network: nn.Module, losses: Callable[..., Losses], example: tuple[np.ndarray, ...], steps: int, seed: int
    ) -> None:
        warm_up = min(WARM_UP, steps // 2)
        self.rate = optax.warmup_cosine_decay_schedule(0.0, LEARNING_RATE, warm_up, steps, LEARNING_RATE * FINAL_SHARE)
        muon = optax.contrib.muon(
            self.rate,
            weight_decay=WEIGHT_DECAY,
            adam_weight_decay=WEIGHT_DECAY / ADAM_SHARE,
            adam_learning_rate=lambda step: ADAM_SHARE * self.rate(step),
            consistent_rms=0.2,
            muon_weight_dimension_numbers=_matrices,
        )
        self._optimizer = optax.chain(optax.clip_by_global_norm(MAX_GRADIENT), muon)
        self._network, self._losses, self._example = network, losses, example
        self._step = jax.jit(self._update, donate_argnums=0, compiler_options=xla.fusion_emitters())
        self._first = jax.jit(self._start, compiler_options=xla.effort(0))
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Forget everything."""
        self.state = self._first(jax.random.key(seed))

    def step(self, inputs: tuple[np.ndarray, ...], targets: tuple[Any, ...]) -> dict[str, jax.Array]:
        """Learn from a batch.

        Args:
            inputs: What the network is given.
            targets: What it should answer.

        Returns:
            Parts of the loss by their names.
        """
        self.state, parts = self._step(self.state, inputs, targets)
        return parts

    def weights(self) -> dict[str, Any]:
        """Average weights, batch normalization folded in."""
        average = jax.device_get(self.state.average)
        return fold_batch_norm(average["params"], average["batch_stats"])

    def _start(self, key: jax.Array) -> State:
        variables = dict(self._network.init(key, *self._example))
        return State(variables, variables, self._optimizer.init(variables["params"]), jnp.zeros((), int))

    def _update(self, state: State, inputs: Any, targets: Any) -> tuple[State, dict[str, jax.Array]]:
        def loss(params: dict[str, Any]) -> tuple[jax.Array, Any]:
            variables = {**state.variables, "params": params}
            answers, statistics = self._network.apply(variables, *inputs, mutable=["batch_stats"])
            parts = Losses(*(part.sum() for part in jax.vmap(self._losses)(*answers, *targets)))
            return parts.total(), (parts, statistics)

        params = state.variables["params"]
        grads, (parts, statistics) = jax.grad(loss, has_aux=True)(params)
        updates, optimizer = self._optimizer.update(grads, state.optimizer, params)
        variables = {"params": optax.apply_updates(params, updates), **statistics}
        decay = jnp.minimum(AVERAGE_DECAY, (1 + state.steps) / (10 + state.steps))
        average = optax.incremental_update(variables, state.average, 1 - decay)
        divisor = jnp.maximum(parts.target_scores, 1.0)
        report = {name: getattr(parts, name) / divisor for name in ("classification", "localisation", "closeness")}
        return State(variables, average, optimizer, state.steps + 1), report


def _matrices(params: Any) -> Any:
    """Which parameters are matrices: those of convolutions too, from all that goes in to what comes out."""

    def kind(x: jax.Array) -> Any:
        return optax.contrib.MuonDimensionNumbers(tuple(range(x.ndim - 1)), x.ndim - 1) if x.ndim > 1 else None

    return jax.tree.map(kind, params)
