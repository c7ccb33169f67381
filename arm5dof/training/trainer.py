"""The host's side of training: epochs on the device, and between them metrics, evaluations and checkpoints."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import Annotated, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import psutil
from annotated_types import Ge, Lt

from arm5dof.ddpg import DDPG, DDPGConfig, Training
from arm5dof.envs import Task
from arm5dof.errors import DivergedError, UserError
from arm5dof.runtime import forks, programs, xla
from arm5dof.runtime.programs import Program
from arm5dof.settings import settings, static
from arm5dof.training.policy import Policy
from arm5dof.training.policy_program import of_policy

Count = Annotated[int, Ge(1), Lt(2**31)]

WATCHED = 0x9B0E
"""The stream of random numbers on which a task is watched."""

BRIEF_WORK, BRIEF_STEPS = 2e9, 4096
"""A training of no more multiplications (weights times rows of all batches) and transitions takes about a second on a
CPU. To compile it well would take longer than it gains."""


@settings
class TrainConfig:
    """The budget."""

    seed: Annotated[int, Ge(0), Lt(2**32)] = static(default=0)
    """Of all random numbers: same seed and machine, same bits."""
    episodes: Count = static(default=400, may_change=True)
    """Episodes in all; a multiple of the number of environments. A run may be resumed with more: step sizes, noise and
    the share of random actions follow the share of all episodes that is done, so they rise again, to where they would
    be by then in a run of the new length."""
    num_envs: Count = static(default=50)
    """Environments that run side by side."""
    epoch_steps: Count = static(default=16)
    """Steps of every environment in one device call; divides the episode's length. Metrics have this grain."""
    evaluate_every: Count = static(default=100, may_change=True)
    """Episodes between evaluations; a multiple of the number of environments."""
    checkpoint_every: Count = static(default=50, may_change=True)
    """Episodes between checkpoints; a multiple of the number of environments."""


class Settings(Protocol):
    """The parts of a configuration that a training needs."""

    @property
    def ddpg(self) -> DDPGConfig: ...

    @property
    def train(self) -> TrainConfig: ...


class Trainer:
    """A compiled training program for one environment and configuration.

    `state` is the whole run, made by `start` or restored from a checkpoint; `advance` takes it one epoch further.
    Raises `UserError` if the budget does not divide, or the agent does not go with the task.
    """

    state: Training

    def __init__(self, env: Task, config: Settings) -> None:
        forks.check()
        budget, length = config.train, env.episode_length
        for name in ("episodes", "evaluate_every", "checkpoint_every"):
            if getattr(budget, name) % budget.num_envs:
                raise UserError(
                    f"{name} = {getattr(budget, name)} is no multiple of num_envs = {budget.num_envs}: environments "
                    f"finish their episodes together"
                )
        if length % budget.epoch_steps:
            raise UserError(f"epoch_steps = {budget.epoch_steps} does not divide episode_length = {length}")
        self.env = env
        self.config = config
        self.total_steps = budget.episodes // budget.num_envs * length
        if self.total_steps * config.ddpg.updates_per_step >= 2**31:
            raise UserError(
                f"{self.total_steps} steps of {config.ddpg.updates_per_step} updates are more than 2147483647 updates, "
                "the most that are counted: choose fewer episodes, or more environments"
            )
        self.agent = DDPG(env, config.ddpg, budget.num_envs, length, self.total_steps)
        task = env.fingerprint
        identity = None if task is None else (*task, jax.tree.structure(config.ddpg), budget.num_envs, length)
        self._init = programs.jit(self.agent.init, identity, compiler_options=xla.effort(0))

    def again(self, config: Settings) -> Trainer:
        """The same program for another configuration that differs by the agent's numbers and the seed alone, not
        begun: nothing is traced or compiled anew."""
        self.check()
        _ = self._epoch
        other = copy.copy(self)
        other.config = config
        other.__dict__.pop("state", None)
        return other

    @property
    def replay_bytes(self) -> int:
        """Memory that the replay buffer takes on the device."""
        return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(self.like.replay))

    @cached_property
    def like(self) -> Training:
        """Shapes and types of the state."""
        return self._init.eval_shape(self.config.ddpg, jax.random.key(0))

    @property
    def bytes_needed(self) -> dict[str, int]:
        """What a training takes of the device's memory at least, by the setting that it is in proportion to."""
        agent, like = self.config.ddpg, self.like
        size = lambda *trees: sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(trees))
        networks = like.networks
        layers = agent.actor_width * agent.actor_depth + agent.heads * agent.critic_width * agent.critic_depth
        sampled = agent.updates_per_step * self.replay_bytes // like.replay.capacity
        return {
            "replay_capacity": self.replay_bytes,
            "num_envs": size(like.env),
            "batch_size": agent.batch_size * (4 * layers + sampled),
            "actor_width": size(networks.actor, networks.target_actor, like.actor_optimizer),
            "critic_width": size(networks.critic, networks.target_critic, like.critic_optimizer),
        }

    def check(self) -> None:
        """Raises `UserError` if a training cannot fit into the device's memory, or the replay buffer never fills a
        batch, or the arm has something that its dynamics cannot simulate. Nothing is allocated."""
        most = min(self.config.ddpg.replay_capacity, self.total_steps * self.config.train.num_envs)
        if most < self.config.ddpg.batch_size:
            raise UserError(
                f"batch_size = {self.config.ddpg.batch_size}, but the replay buffer never holds more than {most} "
                "transitions: nothing would be learnt; choose a smaller batch_size, or more episodes"
            )
        needed, free = self.bytes_needed, memory_free()
        if sum(needed.values()) > free:
            name = max(needed, key=lambda name: needed[name])
            value = {**vars(self.config.ddpg), **vars(self.config.train)}[name]
            raise UserError(
                f"{name} = {value} takes {needed[name] / 1e9:.1f} GB and {free / 1e9:.1f} GB are free: choose a "
                "smaller one"
            )
        if not self._simulated:
            self.env.check()
            self._simulated = True

    def start(self) -> None:
        """Begin a new run."""
        forks.check()
        with xla.gc_paused():
            self.check()
            _ = self._epoch  # Everything else is compiled while this is.
            state = self._init(self.config.ddpg, jax.random.key(self.config.train.seed))
            # Bound to its device, as epochs return it: the policy would be compiled once for either.
            self.state = jax.tree.map(lambda x: jax.device_put(x, x.sharding), state)
            self._watch()
            _ = self._ready

    def advance(self) -> dict[str, float]:
        """One epoch. Returns its metrics: means over the epoch, how many steps led to non-finite physics, and what the
        task has to watch of the policy without noise. Raises `DivergedError` if one of them is no finite number."""
        forks.check()
        leaves, metrics = self._ready(*self._leaves(self.state))
        self.state = jax.tree.unflatten(jax.tree.structure(self.like), leaves)
        metrics.update(self._watch())
        found = {name: float(value) for name, value in jax.device_get(metrics).items()}
        if lost := not_finite(found):
            raise DivergedError(f"{lost} by episode {self.counters.episodes}")
        return found

    @cached_property
    def _program(self) -> Program:
        """An epoch, from and to the leaves of the state."""
        config, state = jax.tree.structure(self.config.ddpg), jax.tree.structure(self.like)
        steps = self.config.train.epoch_steps

        def epoch(
            numbers: list[float], total_steps: int, leaves: list[jax.Array]
        ) -> tuple[list[jax.Array], dict[str, jax.Array]]:
            agent = copy.copy(self.agent)
            agent.total_steps = total_steps  # Traced: runs of any length share a program.
            training, metrics = agent.epoch(
                jax.tree.unflatten(config, numbers), jax.tree.unflatten(state, leaves), steps
            )
            return jax.tree.leaves(training), metrics

        task = self.env.fingerprint
        identity = None if task is None else (*task, config, steps)
        return Program(epoch, self._leaves(self.like), identity)

    def _leaves(self, state: Training) -> tuple[list[float], int, list[jax.Array]]:
        return jax.tree.leaves(self.config.ddpg), self.total_steps, jax.tree.leaves(state)

    @cached_property
    def _simulated(self) -> bool:
        """Whether the environment has been simulated before."""
        return self._program.kept is not None

    @cached_property
    def _epoch(self) -> Future[jax.stages.Compiled]:
        """Compiled by a thread of its own: XLA leaves the interpreter to others meanwhile."""
        epoch = self._program.jit(donate_argnums=2, compiler_options=xla.effort(0 if self._brief else 2))
        return ThreadPoolExecutor(1).submit(epoch.lower(*self._leaves(self.like)).compile)

    @property
    def _brief(self) -> bool:
        agent, networks = self.config.ddpg, self.like.networks
        weights = sum(leaf.size for leaf in jax.tree.leaves((networks.actor, networks.critic)))
        work = self.total_steps * agent.updates_per_step * agent.batch_size * weights
        return work <= BRIEF_WORK and self.total_steps * self.config.train.num_envs <= BRIEF_STEPS

    @cached_property
    def _ready(self) -> jax.stages.Compiled:
        """The compiled epoch. Raises `UserError` if what it takes beside the state does not fit into the memory."""
        compiled = self._epoch.result()
        needed, free = getattr(compiled.memory_analysis(), "temp_size_in_bytes", 0), memory_free()
        if needed > free:
            raise UserError(
                f"an epoch takes {needed / 1e9:.1f} GB beside its state and {free / 1e9:.1f} GB are free: choose a "
                "smaller batch_size, num_envs or updates_per_step"
            )
        return compiled

    def _watch(self) -> dict[str, jax.Array]:
        """What the task has to watch, on random numbers that neither training nor evaluation uses."""
        policy = Policy(self.env, self.agent, self.config.ddpg, self.state.networks)
        return _watched(policy, jax.random.fold_in(jax.random.key(self.config.train.seed), WATCHED))

    @property
    def counters(self) -> Counters:
        """How far the run is."""
        steps = int(self.state.steps)
        env_steps = steps * self.config.train.num_envs
        return Counters(steps, env_steps // self.env.episode_length, env_steps, int(self.state.updates))

    def due(self, at: Counters, every: int) -> bool:
        """Whether so many episodes have gone by since the start, or since the last time."""
        return at.steps > 0 and at.steps % self._steps(every) == 0

    @property
    def evaluations_between(self) -> int:
        """How many evaluations are due after now and before the end."""
        every = self._steps(self.config.train.evaluate_every)
        return (self.total_steps - 1) // every - self.counters.steps // every

    def _steps(self, episodes: int) -> int:
        """Steps of every environment in so many episodes."""
        return episodes // self.config.train.num_envs * self.env.episode_length

    @property
    def finished(self) -> bool:
        return self.counters.steps >= self.total_steps

    def policy(self) -> Policy:
        """The policy as it is now. Its networks are copies: the next epoch reuses the originals' memory."""
        networks = jax.tree.map(jnp.copy, self.state.networks)
        return Policy(self.env, self.agent, self.config.ddpg, networks)


@of_policy()
def _watched(policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
    return policy.env.watch(policy, key)


def memory_free() -> int:
    """Bytes that the device's memory has left."""
    found = jax.devices()[0].memory_stats()
    if found and "bytes_limit" in found:
        return found["bytes_limit"] - found["bytes_in_use"]
    return psutil.virtual_memory().available


class Counters(NamedTuple):
    """Steps of each environment, episodes, steps of all environments together, and updates."""

    steps: int
    episodes: int
    env_steps: int
    updates: int


def row(counters: Counters, seconds: float, metrics: dict[str, Any]) -> dict[str, Any]:
    """One line of `metrics.csv`."""
    return {**counters._asdict(), "seconds": round(seconds, 2), **metrics}


def not_finite(metrics: Mapping[str, float]) -> str:
    """What of an epoch's metrics is no finite number, in words; empty if all are."""
    lost = [f"{name} is {value}" for name, value in metrics.items() if not math.isfinite(value)]
    return ", ".join(lost[:2])
