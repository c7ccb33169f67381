"""The agent: replay buffer, losses, updates, exploration, hindsight, and whether it learns what it should."""

from __future__ import annotations

import functools
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import pytest
from helpers.environments import Bandit, Loan, Salary, Toy, Walk
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from arm5dof.arm import load_arm
from arm5dof.ddpg import DDPG, DDPGConfig, Networks, Replay, Training, Transition, losses
from arm5dof.ddpg.networks import Actor, Critic, gelu
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.errors import UserError
from arm5dof.training.config import load_config

SMALL = DDPGConfig(
    heads=1,
    critic_input="state",
    critic_form="scalar",
    critic_error_weight=0.0,
    random_action_prob=0.0,
    batch_size=64,
    updates_per_step=8,
    actor_width=32,
    actor_depth=2,
    critic_width=32,
    replay_capacity=4096,
    noise=0.5,
    final_noise=0.5,
)


# Most of these tests' time is compilation; less optimised, it takes half.
quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})


def bits(tree: Any) -> Any:
    """A pytree as numpy arrays, random keys as the numbers they are made of."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return jax.tree.map(lambda x: np.asarray(jax.random.key_data(x) if is_key(x) else x), tree)


def member(tree: Any, i: int) -> Any:
    return jax.tree.map(lambda x: x[i], tree)


def assert_same_bits(left: Any, right: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, bits(left), bits(right))


def assert_finite(tree: Any) -> None:
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


# Replay


def numbered(first: int, count: int) -> Transition:
    """Transitions that carry their serial number in every field."""
    n = jnp.arange(first, first + count, dtype=jnp.float32)
    obs = {"state": jnp.stack([n, -n], -1), "privileged_state": n[:, None]}
    return Transition(obs=obs, action=n[:, None], reward=n, next_obs=obs, terminal=n, weight=n, step=n)


def filled(capacity: int, *batches: Transition, count: int = 1) -> Replay:
    replay = Replay.create(member(numbered(0, 1), 0), capacity, len(batches[0].reward) if batches else count)
    for batch in batches:
        replay = replay.insert(batch)
    return replay


@given(count=st.integers(1, 4), blocks=st.integers(1, 4), inserts=st.integers(0, 10))
def test_replay_is_a_ring(count: int, blocks: int, inserts: int):
    """Against a deque: the newest `capacity` transitions, the oldest overwritten first."""
    capacity = count * blocks
    model: deque[int] = deque(maxlen=capacity)
    replay = filled(capacity, count=count)
    assert replay.capacity == capacity
    for i in range(inserts):
        replay = replay.insert(numbered(1 + i * count, count))
        model.extend(range(1 + i * count, 1 + (i + 1) * count))
        assert replay.size == len(model)
        held = np.asarray(replay.storage.reward)
        oldest = int(replay.position) if len(model) == capacity else 0
        assert np.roll(held, -oldest)[: len(model)].tolist() == list(model)
    for leaf in jax.tree.leaves(replay.storage):
        numbers = np.abs(np.asarray(leaf)).reshape(capacity, -1)
        np.testing.assert_array_equal(
            numbers, np.repeat(np.asarray(replay.storage.reward)[:, None], numbers.shape[1], 1)
        )


@given(inserts=st.integers(1, 7), seed=st.integers(0, 1000))
def test_samples_are_what_was_inserted(inserts: int, seed: int):
    replay = filled(12, *(numbered(1 + 3 * i, 3) for i in range(inserts)))
    sample = replay.read(replay.sample(jax.random.key(seed), (5, 8)))
    last = 3 * inserts
    assert sample.reward.shape == (5, 8)
    assert sample.obs["state"].shape == (5, 8, 2)
    assert set(np.ravel(sample.reward)) <= set(range(max(1, last - 11), last + 1))
    # All fields of one transition stay together.
    np.testing.assert_array_equal(sample.obs["state"], jnp.stack([sample.reward, -sample.reward], -1))
    np.testing.assert_array_equal(sample.next_obs["privileged_state"][..., 0], sample.reward)
    np.testing.assert_array_equal(sample.action[..., 0], sample.weight)


@pytest.mark.parametrize("inserts", [1, 3, 6])
def test_samples_are_uniform(inserts: int):
    """In a buffer that is part full, just full, and overwritten."""
    replay = filled(24, *(numbered(8 * i, 8) for i in range(inserts)))
    sample = np.ravel(replay.read(replay.sample(jax.random.key(0), (100, 240))).reward)
    numbers, counts = np.unique(sample, return_counts=True)
    assert len(numbers) == min(8 * inserts, 24)
    expected = len(sample) / len(numbers)
    assert np.abs(counts - expected).max() < 4.5 * np.sqrt(expected)


@given(
    lengths=st.lists(st.integers(1, 6), min_size=2, max_size=12), blocks=st.integers(2, 9), seed=st.integers(0, 1000)
)
def test_later_rows_are_of_the_same_episode(lengths: list[int], blocks: int, seed: int):
    """Two environments whose episodes end at different times, in a buffer that has been overwritten in part: against
    a list of what was inserted. Every later row that is still there is drawn."""
    ends = [lengths, lengths[::-1]]
    episodes = [[(e, t) for e, length in enumerate(one) for t in range(length)] for one in ends]
    steps = min(map(len, episodes))
    replay, inserted = filled(2 * blocks, count=2), []
    for i in range(steps):
        tags = [(env, *episodes[env][i]) for env in range(2)]
        inserted += tags
        number = numbered(2 * i, 2)
        replay = replay.insert(number.replace(step=jnp.array([t for *_, t in tags], jnp.float32)))
    held = range(max(0, 2 * steps - 2 * blocks), 2 * steps)
    rows = jnp.repeat(jnp.array([i % (2 * blocks) for i in held]), 200)
    serial = np.asarray(replay.read(rows).reward, int)
    later = np.asarray(replay.read(replay.later(jax.random.key(seed), rows, 6)).reward, int)
    for i in held:
        env, episode, t = inserted[i]
        expected = {j for j in held if inserted[j][:2] == (env, episode) and inserted[j][2] >= t}
        assert set(later[serial == i]) == expected


def test_a_batch_that_would_wrap_around_is_refused():
    with pytest.raises(ValueError, match="capacity 10 is no multiple of the batch of 3"):
        filled(10, numbered(0, 3))


def test_insert_writes_in_place():
    """Donated, the buffer stays where it is in memory, and the program has no room for a copy of it."""
    replay, batch = filled(1 << 16, numbered(1, 8)), numbered(9, 8)
    insert = jax.jit(lambda replay, batch: replay.insert(batch), donate_argnums=0).lower(replay, batch).compile()
    size = replay.rows.nbytes
    memory = insert.memory_analysis()
    assert memory.alias_size_in_bytes >= size
    assert memory.temp_size_in_bytes < size / 100

    before = replay.rows.unsafe_buffer_pointer()
    replay = insert(replay, batch)
    assert replay.rows.unsafe_buffer_pointer() == before
    np.testing.assert_array_equal(replay.storage.reward[:17], [*range(1, 17), 0])


def test_training_does_not_copy_the_replay_buffer():
    """Within an epoch's loop too: what it needs beside its state does not grow with the buffer."""
    temporary = []
    for capacity in (1 << 10, 1 << 18):
        config = replace(SMALL, replay_capacity=capacity, updates_per_step=1, actor_depth=1)
        agent = DDPG(Walk(), config, num_envs=16, episode_length=20, total_steps=100)
        training = jax.eval_shape(agent.init, config, jax.random.key(0))
        epoch = jax.jit(partial(agent.epoch, steps=10), donate_argnums=1).lower(config, training).compile()
        temporary.append(epoch.memory_analysis().temp_size_in_bytes)
    assert temporary[1] < temporary[0] + 4 * (1 << 18) / 10


def test_capacity_is_rounded_up_to_whole_batches():
    agent = DDPG(Walk(), replace(SMALL, replay_capacity=100), num_envs=16, episode_length=20, total_steps=100)
    training = jax.eval_shape(agent.init, replace(SMALL, replay_capacity=100), jax.random.key(0))
    assert training.replay.capacity == 112


# Losses and updates


def test_critic_loss_is_eq_4():
    q, target = np.random.default_rng(0).normal(size=(2, 50))
    weight = np.arange(50) % 3 > 0
    loss = losses.critic_loss(jnp.array(q), jnp.array(target), jnp.ones(50))
    assert loss == pytest.approx(np.mean((target - q) ** 2), rel=1e-5)
    loss = losses.critic_loss(jnp.array(q), jnp.array(target), jnp.array(weight, float))
    assert loss == pytest.approx(np.mean((target - q)[weight] ** 2), rel=1e-5)
    # The target is a constant to the critic.
    assert (jax.grad(losses.critic_loss, argnums=1)(jnp.array(q), jnp.array(target), jnp.ones(50)) == 0).all()


def test_errors_count_less_where_values_are_large():
    q, target = np.random.default_rng(0).normal(size=(2, 50))
    loss = losses.critic_loss(jnp.array(q), jnp.array(target), jnp.ones(50), 10.0)
    assert loss == pytest.approx(np.mean((target - q) ** 2 * 0.1 / (0.1 + np.abs(target))), rel=1e-5)


def test_actor_loss_is_eq_5():
    q = np.random.default_rng(0).normal(size=(50, 1))
    weight = np.arange(50) % 3 > 0
    assert losses.actor_loss(jnp.array(q), jnp.ones(50), 0.01) == pytest.approx(-np.mean(q), rel=1e-5)
    loss = losses.actor_loss(jnp.array(q), jnp.array(weight, float), 0.01)
    assert loss == pytest.approx(-np.mean(q[weight]), rel=1e-5)


def test_heads_share_a_target_by_softmax():
    q, temperature = np.random.default_rng(0).normal(size=(50, 4)), 0.7
    share = np.exp(q / temperature) / np.exp(q / temperature).sum(1, keepdims=True)
    loss, gradient = jax.value_and_grad(losses.actor_loss)(jnp.array(q), jnp.ones(50), temperature)
    assert loss == pytest.approx(-np.mean((share * q).sum(1)), rel=1e-5)
    np.testing.assert_allclose(gradient, -share / 50, atol=1e-6)


def test_goals_that_are_hard_count_more():
    q, temperature = -np.random.default_rng(0).uniform(size=(50, 4)), 0.7
    share = np.exp(q / temperature) / np.exp(q / temperature).sum(1, keepdims=True)
    gradient = jax.grad(losses.actor_loss)(jnp.array(q), jnp.ones(50), temperature, focus=30.0)
    hard = 1 + 30 * np.abs(q).min(1, keepdims=True)  # How far the best head is off.
    np.testing.assert_allclose(gradient, -share * hard / 50, rtol=1e-5)


def test_actions_cost_at_their_limits_alone():
    actions = jnp.array([[0.0, 0.9, -0.5], [0.95, 0.0, 0.0], [1.0, -1.0, 0.3]])
    np.testing.assert_allclose(losses.limit_cost(actions), [0.0, 0.25, 2.0], atol=1e-6)
    q = np.random.default_rng(0).normal(size=(3, 1))
    loss = losses.actor_loss(jnp.array(q), jnp.ones(3), 0.01, 0.1 * losses.limit_cost(actions[:, None]))
    assert loss == pytest.approx(-np.mean(q[:, 0] - 0.1 * np.array([0.0, 0.25, 2.0])), rel=1e-5)


def test_losses_without_anything_to_learn_from_are_zero():
    assert losses.critic_loss(jnp.ones(3), jnp.zeros(3), jnp.zeros(3)) == 0
    assert losses.actor_loss(jnp.ones((3, 2)), jnp.zeros(3), 0.01) == 0


class Probe(Toy):
    """Two actions; the critic's observation is not the actor's."""

    action_size = 2

    def first(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(3)

    def reset(self, key: jax.Array):
        state = super().reset(key)
        return state.replace(obs={"state": jnp.zeros(3), "privileged_state": jnp.zeros(4)})


class Bench(NamedTuple):
    """An agent about to make its first update, on random data and with target networks of their own."""

    agent: DDPG
    config: DDPGConfig
    training: Training
    batch: Transition

    def update(
        self, batch: Transition | None = None, shown: Any = None, **changes: Any
    ) -> tuple[Training, dict[str, jax.Array]]:
        config, batch = replace(self.config, **changes), self.batch if batch is None else batch
        inputs = self.agent.critic_inputs(config, batch)
        return jax.jit(self.agent.update)(
            config, self.training, batch, inputs, batch.action if shown is None else shown
        )


@pytest.fixture(scope="module", params=[1, 3], ids=["one head", "three heads"])
def bench(request: pytest.FixtureRequest) -> Bench:
    changes = {"discount": 0.9, "tau": 0.3, "head_temperature": 0.5, "final_lr": 1.0}
    config = replace(SMALL, heads=request.param, actor_width=8, critic_width=8, **changes)
    agent = DDPG(Probe(), config, num_envs=1, episode_length=10, total_steps=100)
    training = jax.jit(agent.init)(config, jax.random.key(0))
    keys = iter(jax.random.split(jax.random.key(1), 1000))
    shift = lambda params: jax.tree.map(lambda p: p + 0.3 * jax.random.normal(next(keys), p.shape), params)
    training = training.replace(networks=jax.tree.map(shift, training.networks))

    def observations() -> dict[str, jax.Array]:
        return {
            "state": jax.random.normal(next(keys), (32, 3)),
            "privileged_state": jax.random.normal(next(keys), (32, 4)),
        }

    batch = Transition(
        obs=observations(),
        action=jax.random.uniform(next(keys), (32, 2), minval=-1),
        reward=jax.random.normal(next(keys), (32,)),
        next_obs=observations(),
        terminal=(jnp.arange(32) % 4 == 0).astype(float),
        weight=(jnp.arange(32) % 5 > 0).astype(float),
        step=jnp.zeros(32),
    )
    return Bench(agent, config, training, batch)


def flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def flat_rows(tree: Any, axes: int) -> np.ndarray:
    """Jacobians of one output per row: leading axes kept, parameters flattened."""
    return np.concatenate([np.reshape(leaf, (*leaf.shape[:axes], -1)) for leaf in jax.tree.leaves(tree)], -1)


def gradient_used(optimizer: Any) -> np.ndarray:
    """Adam's first moment after its first update is a tenth of the gradient."""
    return flat(optimizer.mu) * 10


def q_of(bench: Bench, critic: Any, privileged: jax.Array, action: jax.Array) -> jax.Array:
    return bench.agent.critic.apply(critic, jnp.concatenate([privileged, action], -1))


def test_critic_descends_eq_4(bench: Bench):
    """R + gamma Q'(s', mu'(s')) - Q(s, a), squared; mu' the best of the heads, nothing beyond a terminal state."""
    networks, batch, weight = bench.training.networks, bench.batch, np.asarray(bench.batch.weight)
    beyond = bench.agent.actor.apply(networks.target_actor, batch.next_obs["state"])
    privileged = batch.next_obs["privileged_state"]
    bootstrap = np.max([q_of(bench, networks.target_critic, privileged, a) for a in beyond.swapaxes(0, 1)], axis=0)
    target = np.asarray(batch.reward + 0.9 * (1 - batch.terminal) * bootstrap)
    q_now = lambda critic: q_of(bench, critic, batch.obs["privileged_state"], batch.action)
    q, slope = np.asarray(q_now(networks.critic)), flat_rows(jax.jacobian(q_now)(networks.critic), 1)
    expected = -2 * ((weight * (target - q)) @ slope) / weight.sum()

    after, metrics = bench.update()
    assert metrics["critic_loss"] == pytest.approx((weight * (target - q) ** 2).sum() / weight.sum(), rel=1e-4)
    np.testing.assert_allclose(gradient_used(after.critic_optimizer), expected, rtol=1e-3, atol=1e-5)


def test_actor_ascends_eq_5(bench: Bench):
    """grad_a Q(s, a) grad_theta mu(s), as in Algorithm 1 after the critic's update; several heads weighted by their
    share of each target."""
    after, _ = bench.update()
    actor, critic = bench.training.networks.actor, after.networks.critic
    obs, weight = bench.batch.obs, np.asarray(bench.batch.weight)
    privileged = jnp.repeat(obs["privileged_state"][:, None], bench.config.heads, axis=1)
    mu = lambda actor: bench.agent.actor.apply(actor, obs["state"])
    q = np.asarray(q_of(bench, critic, privileged, mu(actor)))
    q_slope = jax.grad(lambda a: q_of(bench, critic, privileged, a).sum())(mu(actor))
    mu_slope = flat_rows(jax.jacobian(mu)(actor), 3)
    share = np.exp(q / 0.5) / np.exp(q / 0.5).sum(1, keepdims=True)
    expected = -np.einsum("i,ih,iha,ihap->p", weight, share, q_slope, mu_slope) / weight.sum()
    np.testing.assert_allclose(gradient_used(after.actor_optimizer), expected, rtol=1e-3, atol=1e-6)
    assert np.abs(expected).max() > 1e-3


def test_the_actor_leaves_its_limits(bench: Bench):
    """The gradient that `limit_weight` adds to Eq. 5 is that of the cost, weighted by the heads' shares."""
    obs = {name: 5 * values for name, values in bench.batch.obs.items()}  # For which actions are large.
    batch, weight, actor = replace(bench.batch, obs=obs), np.asarray(bench.batch.weight), bench.training.networks.actor
    (without, _), (after, _) = bench.update(batch, limit_weight=0.0), bench.update(batch, limit_weight=0.5)
    mu = lambda actor: bench.agent.actor.apply(actor, obs["state"])
    privileged = jnp.repeat(obs["privileged_state"][:, None], bench.config.heads, axis=1)
    q = np.asarray(q_of(bench, after.networks.critic, privileged, mu(actor)))
    share = np.exp(q / 0.5) / np.exp(q / 0.5).sum(1, keepdims=True)
    action = np.asarray(mu(actor))
    slope = 2 * np.maximum(np.abs(action) - 0.9, 0) * np.sign(action) / 0.01
    mu_slope = flat_rows(jax.jacobian(mu)(actor), 3)
    expected = 0.5 * np.einsum("i,ih,iha,ihap->p", weight, share, slope, mu_slope) / weight.sum()
    found = gradient_used(after.actor_optimizer) - gradient_used(without.actor_optimizer)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
    assert np.abs(expected).max() > 1e-3


def test_the_actor_imitates_what_the_critic_prefers(bench: Bench):
    """The gradient that `imitation_weight` adds draws the nearest head to the action shown, in proportion to how much
    more than the margin it is worth by the critic than the best head."""
    obs, weight = bench.batch.obs, np.asarray(bench.batch.weight)
    shown = jax.random.uniform(jax.random.key(5), bench.batch.action.shape, minval=-1, maxval=1)
    ask = partial(bench.update, shown=shown, imitation_margin=0.05)
    (without, _), (after, _) = ask(imitation_weight=0.0), ask(imitation_weight=2.0)
    mu = lambda actor: bench.agent.actor.apply(actor, obs["state"])
    actor, critic = bench.training.networks.actor, after.networks.critic
    action, mu_slope = np.asarray(mu(actor)), flat_rows(jax.jacobian(mu)(actor), 3)
    heads = np.stack([q_of(bench, critic, obs["privileged_state"], a) for a in action.swapaxes(0, 1)], 1)
    gain = np.maximum(q_of(bench, critic, obs["privileged_state"], shown) - heads.max(1) - 0.05, 0)
    away = action - np.asarray(shown)[:, None]
    nearest = (away**2).sum(-1).argmin(1)
    rows = np.arange(len(away))
    slope = np.einsum("i,i,ia,iap->p", weight, gain, 2 * away[rows, nearest], mu_slope[rows, nearest])
    found = gradient_used(after.actor_optimizer) - gradient_used(without.actor_optimizer)
    np.testing.assert_allclose(found, 2.0 * slope / weight.sum(), rtol=1e-3, atol=1e-5)
    assert 0 < (gain > 0).mean() < 1 and np.abs(found).max() > 1e-3


def test_the_policy_is_the_head_the_critic_prefers(bench: Bench):
    networks, obs = bench.training.networks, bench.batch.obs
    action, value = bench.agent.act(bench.config, networks.actor, networks.critic, obs)
    actions = np.asarray(bench.agent.actor.apply(networks.actor, obs["state"]))
    q = np.stack([q_of(bench, networks.critic, obs["privileged_state"], a) for a in actions.swapaxes(0, 1)], 1)
    np.testing.assert_allclose(value, q.max(1), atol=1e-6)
    np.testing.assert_array_equal(action, actions[np.arange(32), q.argmax(1)])
    assert np.abs(actions).max() <= 1


@pytest.mark.parametrize("tau", [0.0, 0.3, 1.0])
def test_target_networks_follow_by_tau(bench: Bench, tau: float):
    before, (after, _) = bench.training.networks, bench.update(tau=tau)
    for online, old, new in (
        (after.networks.actor, before.target_actor, after.networks.target_actor),
        (after.networks.critic, before.target_critic, after.networks.target_critic),
    ):
        np.testing.assert_allclose(flat(new), (1 - tau) * flat(old) + tau * flat(online), atol=1e-6)
    assert np.abs(flat(after.networks.actor) - flat(before.actor)).max() > 1e-4


def test_target_networks_start_equal():
    agent = DDPG(Walk(), SMALL, num_envs=1, episode_length=10, total_steps=100)
    networks = agent.init(SMALL, jax.random.key(0)).networks
    assert_same_bits(networks.target_actor, networks.actor)
    assert_same_bits(networks.target_critic, networks.critic)


def test_adam_steps_are_each_networks_own_rate(bench: Bench):
    """Adam's first step moves every weight by the step size against its gradient's sign."""
    after, _ = bench.update(actor_lr=0.01, critic_lr=0.002)
    for name, rate in (("actor", 0.01), ("critic", 0.002)):
        gradient = gradient_used(getattr(after, f"{name}_optimizer"))
        moved = flat(getattr(after.networks, name)) - flat(getattr(bench.training.networks, name))
        large = np.abs(gradient) > 1e-4
        assert large.mean() > 0.5
        np.testing.assert_allclose(moved[large], -rate * np.sign(gradient[large]), rtol=2e-3)


def test_muon_moves_matrices_by_orthogonal_steps(bench: Bench):
    """Down the gradient, about as far in every direction; biases as Adam does."""
    config = replace(bench.config, actor_optimizer="muon")
    agent = DDPG(Probe(), config, num_envs=1, episode_length=10, total_steps=100)
    training = agent.init(config, jax.random.key(0)).replace(networks=bench.training.networks)
    after, _ = bench._replace(agent=agent, config=config, training=training).update(actor_lr=0.01)
    plain, _ = bench.update(actor_lr=0.01)
    moved, by_adam = (
        jax.tree.map(lambda new, old: np.asarray(new - old), one.networks.actor, training.networks.actor)
        for one in (after, plain)
    )
    for path, step in jax.tree_util.tree_leaves_with_path(moved):
        other = functools.reduce(lambda tree, key: tree[key.key], path, by_adam)
        if step.ndim == 2:
            assert (step * other).sum() > 0
            singular = np.linalg.svd(step, compute_uv=False) / (0.01 * max(1, step.shape[1] / step.shape[0]) ** 0.5)
            assert singular.max() < 1.3 and np.median(singular) > 0.6
        else:
            np.testing.assert_array_equal(np.sign(step), np.sign(other))  # Adam's by Nesterov, so not as far.


@pytest.mark.parametrize(("steps", "rate"), [(0, 1.0), (50, 0.6), (100, 0.2), (500, 0.2)])
def test_step_sizes_fall_along_a_cosine(bench: Bench, steps: int, rate: float):
    later = bench._replace(training=bench.training.replace(steps=jnp.int32(steps)))
    after, _ = later.update(final_lr=0.2, actor_lr=0.01)
    moved = np.abs(flat(after.networks.actor) - flat(bench.training.networks.actor))
    assert moved.max() == pytest.approx(0.01 * rate, rel=1e-3)


def test_weight_0_has_no_influence(bench: Bench):
    """Whatever such transitions hold, and as if they had not been in the batch."""
    batch, kept = bench.batch, np.asarray(bench.batch.weight) == 1
    assert 0 < kept.sum() < 32
    junk = lambda x: jnp.where(kept.reshape(-1, *[1] * (x.ndim - 1)), x, 1e3 * (1 + x))
    poisoned = jax.tree.map(junk, batch).replace(weight=batch.weight)
    (clean, _), (dirty, _) = bench.update(), bench.update(poisoned)
    assert_same_bits(dirty, clean)

    without, _ = bench.update(jax.tree.map(lambda x: x[kept], batch))
    for name in ("actor_optimizer", "critic_optimizer"):
        left, right = (gradient_used(getattr(t, name)) for t in (without, clean))
        np.testing.assert_allclose(left, right, rtol=1e-4, atol=1e-6)
    everything, _ = bench.update(batch.replace(weight=jnp.ones(32)))
    assert np.abs(gradient_used(everything.critic_optimizer) - gradient_used(clean.critic_optimizer)).max() > 1e-3


def test_discount_0_never_looks_ahead(bench: Bench):
    """Not even at a bootstrap value that is no number."""
    hopeless = jax.tree.map(lambda x: x * jnp.nan, bench.training.networks.target_critic)
    lost = bench._replace(
        training=bench.training.replace(networks=bench.training.networks.replace(target_critic=hopeless))
    )
    after, metrics = lost.update(discount=0.0)
    assert np.isfinite(metrics["critic_loss"])
    assert_finite(after.networks.critic)


def test_a_view_the_environment_cannot_give_is_refused():
    with pytest.raises(UserError, match='choose critic_input = "state"'):
        DDPG(Walk(), replace(SMALL, critic_input="outcome"), num_envs=1, episode_length=10, total_steps=100)
    with pytest.raises(UserError, match='choose critic_form = "scalar"'):
        DDPG(Walk(), replace(SMALL, critic_form="distance"), num_envs=1, episode_length=10, total_steps=100)


def test_a_distance_critic_keeps_the_tip_of_a_distance():
    """Regression on -|x - y| in the plane: never positive, and near the tip, which a plain network of the same size
    rounds off, several times closer to it."""
    far, y = jax.random.normal(jax.random.key(0), (2, 512, 2))
    x = jnp.where(jnp.arange(512)[:, None] % 2, far, y + 0.1 * far)
    near = y + 0.02 * jax.random.normal(jax.random.key(1), y.shape)

    def errors(critic: Critic, params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = jnp.asarray(critic.apply(params, jnp.concatenate([x, y], -1)))
        return q, q + jnp.linalg.norm(x - y, axis=-1)

    @partial(jax.jit, static_argnums=0)
    def fitted(critic: Critic) -> Any:
        adam = optax.adam(optax.cosine_decay_schedule(1e-2, 1000))

        def step(carry: Any, _: None) -> tuple[Any, None]:
            params, state = carry
            gradient = jax.grad(lambda p: (errors(critic, p, x)[1] ** 2).mean())(params)
            updates, state = adam.update(gradient, state)
            return (optax.apply_updates(params, updates), state), None

        params = critic.init(jax.random.key(2), jnp.zeros(4))
        return jax.lax.scan(step, (params, adam.init(params)), None, 1000)[0][0]

    distance, scalar = (
        Critic(form, width=32, depth=2, activation="gelu", layer_norm=False) for form in ("distance", "scalar")
    )
    q, error = errors(distance, fitted(distance), near)
    assert (q <= 0).all()
    rounded = jnp.abs(errors(scalar, fitted(scalar), near)[1]).mean()
    assert jnp.abs(error).mean() < min(0.02, rounded / 3)

    linear = Critic("linear", width=32, depth=2, activation="gelu", layer_norm=False)
    assert jnp.abs(errors(linear, fitted(linear), near)[1]).mean() < abs(error).mean() / 2, (
        "a distance is the length of a linear map"
    )


def test_an_actor_may_see_products():
    obs = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    style = {"action_size": 2, "heads": 3, "width": 8, "depth": 2, "activation": "gelu", "layer_norm": False}
    plain, products = Actor(products=False, **style), Actor(products=True, **style)
    (a, b, c) = obs.T
    seen = np.stack([a, b, c, a * a, a * b, a * c, b * b, b * c, c * c], -1)
    params = products.init(jax.random.key(0), obs)
    np.testing.assert_allclose(products.apply(params, obs), plain.apply(params, seen), atol=1e-6)


def test_heads_start_all_over_the_actions():
    actor = Actor(2, heads=500, products=False, width=8, depth=2, activation="gelu", layer_norm=False)
    actions = actor.apply(actor.init(jax.random.key(0), jnp.zeros(3)), jnp.zeros(3))
    assert kstest(np.ravel(actions), "uniform", args=(-0.95, 1.9)).pvalue > 0.01


def test_gelu_is_about_gelu():
    x = jnp.linspace(-8, 8, 1001)
    np.testing.assert_allclose(gelu(x), jax.nn.gelu(x, approximate=False), atol=0.021)


def test_a_distance_critic_has_a_gradient_at_the_goal():
    """A length has none there; NaN would poison the actor."""
    critic = Critic("distance", width=8, depth=1, activation="gelu", layer_norm=False)
    params = jax.tree.map(jnp.zeros_like, critic.init(jax.random.key(0), jnp.zeros(3)))
    assert_finite(jax.grad(lambda p, v: critic.apply(p, v), argnums=(0, 1))(params, jnp.ones(3)))


# Collecting


@pytest.mark.parametrize(("steps", "noise"), [(0, 0.3), (25, 0.25), (50, 0.2), (100, 0.1), (150, 0.1)])
def test_noise_falls_linearly(steps: int, noise: float):
    """As reported, and as seen in the actions taken."""
    config = replace(SMALL, noise=0.3, final_noise=0.1, replay_capacity=8192)
    agent = DDPG(Walk(), config, num_envs=8192, episode_length=10, total_steps=100)
    training = agent.init(config, jax.random.key(0)).replace(steps=jnp.int32(steps))
    after, metrics = agent.collect(config, training)
    assert metrics["noise"] == pytest.approx(noise, rel=1e-5)
    deviation = after.replay.storage.action - agent.candidates(training.networks.actor, training.env.obs)[:, 0]
    assert np.std(deviation) == pytest.approx(noise, rel=0.03)
    assert abs(np.mean(deviation)) < 0.02
    assert after.steps == steps + 1


@pytest.mark.parametrize(("steps", "share"), [(0, 0.8), (50, 0.4), (100, 0.0), (150, 0.0)])
def test_random_actions_become_rare(steps: int, share: float):
    """Without noise an action is the policy's, or it is uniform."""
    config = replace(SMALL, noise=0.0, final_noise=0.0, random_action_prob=0.8, replay_capacity=8192)
    agent = DDPG(Walk(), config, num_envs=8192, episode_length=10, total_steps=100)
    training = agent.init(config, jax.random.key(0)).replace(steps=jnp.int32(steps))
    action = np.asarray(agent.collect(config, training)[0].replay.storage.action)
    drawn = action[(action != agent.candidates(training.networks.actor, training.env.obs)[:, 0]).any(-1)]
    assert len(drawn) / len(action) == pytest.approx(share, abs=0.03)
    if share:
        counts, _ = np.histogram(drawn, 10, (-1, 1))
        assert counts.sum() == drawn.size
        assert np.abs(counts - drawn.size / 10).max() < 6 * np.sqrt(drawn.size / 10)


def test_noisy_actions_stay_in_bounds():
    config = replace(SMALL, noise=2.0, final_noise=2.0)
    agent = DDPG(Walk(), config, num_envs=256, episode_length=10, total_steps=100)
    training, _ = agent.collect(config, agent.init(config, jax.random.key(0)))
    action = np.asarray(training.replay.storage.action[:256])
    assert np.abs(action).max() == 1
    assert (np.abs(action) < 1).any()


@pytest.mark.parametrize(("end", "terminal"), [(np.inf, 0), (3.0, 1)])
def test_what_is_stored_never_mixes_episodes(end: float, terminal: int):
    """Walks of three steps, cut by the clock or ended by the environment: every next observation is one on."""
    agent = DDPG(Walk(end=end), SMALL, num_envs=8, episode_length=3, total_steps=100)
    collect = jax.jit(agent.collect)
    training = agent.init(SMALL, jax.random.key(0))
    for _ in range(12):
        training, _ = collect(SMALL, training)
    stored = jax.tree.map(lambda x: np.asarray(x[:96]), training.replay.storage)
    here, there = stored.obs["state"][:, 0], stored.next_obs["state"][:, 0]
    np.testing.assert_allclose(there, here + 1, atol=1e-6)
    np.testing.assert_allclose(stored.reward, there, atol=1e-6)
    np.testing.assert_array_equal(stored.terminal, terminal * (here > 2))
    np.testing.assert_array_equal(stored.weight, 1)
    assert training.replay.size == 96
    starts = here[here < 1]
    assert len(starts) == len(np.unique(starts)) == 32


def test_an_environment_that_blows_up_does_not_poison_the_networks():
    config = replace(SMALL, discount=0.5)
    agent = DDPG(Walk(cliff=3), config, num_envs=16, episode_length=100, total_steps=60)
    training = quick_jit(agent.init)(config, jax.random.key(0))
    training, metrics = quick_jit(agent.epoch, static_argnums=2)(config, training, 60)
    assert training.updates > 400
    # Each walk falls at its third step.
    assert metrics["nonfinite"] == 16 * 60 / 3
    assert (training.replay.storage.weight[:960] == 0).sum() == metrics["nonfinite"]
    assert_finite(training.networks)
    assert_finite(training.replay.storage)
    assert_finite((training.actor_optimizer, training.critic_optimizer, metrics))


# Known answers, populations


class Population(NamedTuple):
    """Four members of one program, apart in their seeds and perhaps in hyperparameters: leading axis the member."""

    agent: DDPG
    config: DDPGConfig
    early: Training
    """After `EARLY` steps."""
    training: Training
    """In the end."""

    def policy(self, obs: np.ndarray) -> np.ndarray:
        """Each member's actions for observations (n, size): (members, n, action_size)."""
        obs = {"state": jnp.array(obs), "privileged_state": jnp.array(obs)}
        act = lambda n: self.agent.act(self.config, n.actor, n.critic, obs)[0]
        return np.asarray(jax.vmap(act)(self.training.networks))

    def q(self, obs: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Each member's values, (members, n)."""
        view = jnp.concatenate([jnp.array(obs), jnp.array(action)], -1)
        return np.asarray(jax.vmap(lambda n: self.agent.critic.apply(n.critic, view))(self.training.networks))


EARLY = 20
SEEDS = jax.random.split(jax.random.key(0), 4)


def train(env: Toy, epochs: int, length: int = 10, **changes: Any) -> Population:
    """Train four seeds; a hyperparameter may be an array of four."""
    config = replace(SMALL, final_lr=0.1, tau=0.05, **changes)
    agent = DDPG(env, config, num_envs=16, episode_length=length, total_steps=EARLY * epochs)
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, config)
    epoch = quick_jit(jax.vmap(lambda config, training: agent.epoch(config, training, EARLY)[0], (axes, 0)))
    early = training = epoch(config, quick_jit(jax.vmap(agent.init, (axes, 0)))(config, SEEDS))
    for _ in range(epochs - 1):
        training = epoch(config, training)
    return Population(agent, config, early, training)


@pytest.fixture(scope="module")
def borrowers() -> Population:
    """Four discounts and step sizes in one program."""
    return train(Loan(), 15, discount=jnp.array([0.0, 0.3, 0.6, 0.9]), actor_lr=jnp.array([2e-3, 3e-3, 4e-3, 5e-3]))


def test_bandit_is_solved():
    run = train(Bandit(), 8, heads=3)
    s = np.linspace(-0.7, 0.7, 15)[:, None]
    assert np.abs(run.policy(s) - s).max() < 0.1
    s, a = (x.reshape(-1, 1) for x in np.meshgrid(s, np.linspace(-0.9, 0.9, 11)))
    assert np.abs(run.q(s, a) + ((a - s) ** 2)[:, 0]).max() < 0.3
    assert np.abs(run.q(s, a) + ((a - s) ** 2)[:, 0]).mean() < 0.03


def test_loan_is_taken_as_far_as_the_discount_allows(borrowers: Population):
    """How much to borrow is the discount itself."""
    gamma = np.asarray(borrowers.config.discount)
    np.testing.assert_allclose(borrowers.policy(np.zeros((1, 2)))[:, 0, 0], gamma, atol=0.12)
    borrowed = np.linspace(-0.5, 0.9, 8)
    late = borrowers.q(np.stack([np.ones(8), borrowed], 1), np.zeros((8, 1)))
    np.testing.assert_allclose(late, np.tile(2 * borrowed, (4, 1)), atol=0.2)
    a = np.array([-0.5, 0.0, 0.5])
    np.testing.assert_allclose(borrowers.q(np.zeros((3, 2)), a[:, None]), 2 * gamma[:, None] * a - a**2, atol=0.2)


def test_a_population_is_its_members_alone(borrowers: Population):
    """`vmap` over seeds, discounts and step sizes, against a run of its own for each."""
    agent, config = borrowers.agent, borrowers.config
    alone = quick_jit(lambda config, key: agent.epoch(config, agent.init(config, key), EARLY)[0])
    for i, key in enumerate(SEEDS):
        one = alone(replace(config, discount=config.discount[i], actor_lr=config.actor_lr[i]), key)
        assert one.updates == 17 * config.updates_per_step
        np.testing.assert_allclose(flat(member(borrowers.early.networks, i)), flat(one.networks), atol=1e-4)
        np.testing.assert_array_equal(
            borrowers.early.replay.storage.obs["state"][i, :64, 0], np.repeat([0, 1, 0, 1], 16)
        )
    networks = [flat(member(borrowers.early.networks, i)) for i in range(4)]
    assert min(np.abs(networks[i] - networks[i - 1]).max() for i in range(4)) > 0.1


def test_a_time_limit_is_bootstrapped_through():
    """For ever 1 is worth 1 / (1 - 0.8) = 5, though the clock cuts every other step off."""
    run = train(Salary(), 15, length=2, discount=0.8)
    np.testing.assert_allclose(run.q(np.zeros((1, 1)), np.zeros((1, 1))), 5, rtol=0.05)


def test_a_terminal_state_is_not_bootstrapped_through():
    """Three years of pay at 0.8: 1 + 0.8 + 0.64, then 1 + 0.8, then 1."""
    run = train(Salary(years=3), 15, discount=0.8)
    served = np.array([[0], [1 / 3], [2 / 3]])
    np.testing.assert_allclose(run.q(served, np.zeros((3, 1))), np.tile([2.44, 1.8, 1.0], (4, 1)), rtol=0.05)


# Repeatability


@pytest.fixture(scope="module")
def walker() -> Any:
    """Epochs of any length of an agent that looks ahead, from a seed."""
    config = replace(SMALL, discount=0.5)
    agent = DDPG(Walk(), config, num_envs=16, episode_length=7, total_steps=40)
    init, epoch = quick_jit(agent.init), quick_jit(agent.epoch, static_argnums=2)

    def run(seed: int, *epochs: int) -> Training:
        training = init(config, jax.random.key(seed))
        for steps in epochs:
            training, _ = epoch(config, training, steps)
        return training

    return run


def test_same_seed_same_bits(walker: Any):
    first, second, other = walker(1, 10), walker(1, 10), walker(2, 10)
    assert_same_bits(first, second)
    assert np.abs(flat(first.networks) - flat(other.networks)).max() > 0.1


def test_two_short_epochs_are_a_long_one(walker: Any):
    """Nothing is lost between epochs."""
    short, long = walker(0, 10, 10), walker(0, 20)
    assert (long.steps, long.updates, long.replay.size) == (20, 17 * 8, 320)
    assert_same_bits(short, long)


# Arms


class Learnt(NamedTuple):
    """Training runs of one arm: leading axis the seed."""

    env: Reach
    agent: DDPG
    config: DDPGConfig
    before: Training
    after: Training
    metrics: dict[str, jax.Array]

    def median(self, training: Training) -> np.ndarray:
        """Each seed's median one-shot error over 1,000 fresh targets, metres."""

        def errors(networks: Networks) -> jax.Array:
            goals = self.env.arm.forward(self.env.arm.sample(jax.random.key(99), (1000,)))
            obs = jax.vmap(self.env.replace_goal, (None, 0))(member(member(training.env.obs, 0), 0), goals)
            action, _ = self.agent.act(self.config, networks.actor, networks.critic, obs)
            return jnp.linalg.norm(self.env.arm.forward(self.env.arm.to_joints(action)) - goals, axis=-1)

        return np.median(quick_jit(jax.vmap(errors))(training.networks), axis=1)


def learn(env: Reach, seeds: int, steps: int) -> Learnt:
    small = {"batch_size": 128, "updates_per_step": 16, "actor_width": 64, "actor_depth": 2, "replay_capacity": 4096}
    config = load_config("kinematic.toml", **small).ddpg
    agent = DDPG(env, config, num_envs=32, episode_length=20, total_steps=steps)
    keys = jax.random.split(jax.random.key(0), seeds)
    # One seed after another: networks this small gain nothing from `vmap` on a CPU, and it takes longer to compile.
    before = quick_jit(lambda keys: jax.lax.map(partial(agent.init, config), keys))(keys)
    epoch = quick_jit(lambda training: jax.lax.map(lambda t: agent.epoch(config, t, steps), training))
    return Learnt(env, agent, config, before, *epoch(before))


@pytest.fixture(scope="module")
def paper_arm(kinematic: Reach) -> Learnt:
    return learn(kinematic, seeds=3, steps=80)


def test_the_papers_arm_learns(paper_arm: Learnt):
    before, after = paper_arm.median(paper_arm.before), paper_arm.median(paper_arm.after)
    assert before.min() > 0.1
    assert (after < before / 4).all(), (before, after)
    assert (paper_arm.metrics["nonfinite"] == 0).all()


def test_seven_joints_learn_with_the_same_code():
    run = learn(Reach(ReachConfig(dynamics="kinematic"), load_arm("arm7.xml")), seeds=2, steps=80)
    before, after = run.median(run.before), run.median(run.after)
    assert before.min() > 0.2
    assert (after < before / 4).all(), (before, after)


# Hindsight, on what the paper's arm has stored


def goal_in(env: Reach, obs: dict[str, jax.Array]) -> np.ndarray:
    return np.asarray(obs["privileged_state"][..., -3:]) * env.arm.reach + env.arm.origin


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_relabelling_is_exact(paper_arm: Learnt, share: float):
    env, agent = paper_arm.env, paper_arm.agent
    replay = member(paper_arm.after.replay, 0)
    shape = (4, 1000)
    rows = replay.sample(jax.random.key(1), shape)
    batch = replay.read(rows)
    new, shown = jax.jit(agent.relabel)(replace(paper_arm.config, her_ratio=share), replay, rows, jax.random.key(2))

    old_goal, goal = goal_in(env, batch.obs), goal_in(env, new.obs)
    changed = (np.abs(goal - old_goal) > 1e-6).any(-1)
    # Six standard deviations of a binomial share.
    assert abs(changed.mean() - share) <= 6 * np.sqrt(share * (1 - share) / 4000)
    assert_same_bits(jax.tree.map(lambda x: x[~changed], new), jax.tree.map(lambda x: x[~changed], batch))

    # Rewards are Eq. 7 for the goal that the transition now has.
    reached = np.asarray(agent.goal_env.arm.forward(env.arm.to_joints(batch.next_obs["privileged_state"][..., :5])))
    np.testing.assert_allclose(new.reward, -np.linalg.norm(reached - goal, axis=-1), atol=2e-6)
    np.testing.assert_allclose(goal_in(env, new.next_obs), goal, atol=1e-6)

    # Nothing but the goal has changed, for actor and critic alike.
    for left, right in ((new.obs, batch.obs), (new.next_obs, batch.next_obs)):
        np.testing.assert_array_equal(left["privileged_state"][..., :8], right["privileged_state"][..., :8])
        np.testing.assert_allclose(left["state"], left["privileged_state"][..., -3:], atol=1e-6)
    for name in ("action", "terminal", "weight"):
        np.testing.assert_array_equal(getattr(new, name), getattr(batch, name))

    # New goals are points that were reached.
    points = np.asarray(jax.vmap(env.achieved)(replay.storage.next_obs))[: int(replay.size)]
    for point in goal[changed][:200]:
        assert np.linalg.norm(points - point, axis=1).min() < 1e-6

    # The actions shown are those by which they were.
    by = np.asarray(env.arm.forward(env.joints(shown)))
    np.testing.assert_allclose(by, np.where(changed[..., None], goal, reached), atol=2e-6)


def test_relabelled_goals_are_as_many_as_transitions(paper_arm: Learnt):
    """Each transition gets a goal of its own."""
    replay = member(paper_arm.after.replay, 0)
    rows = replay.sample(jax.random.key(1), (2, 100))
    new, _ = paper_arm.agent.relabel(replace(paper_arm.config, her_ratio=1.0), replay, rows, jax.random.key(2))
    goals = goal_in(paper_arm.env, new.obs).reshape(-1, 3)
    assert len(np.unique(goals, axis=0)) > 180


def test_environments_without_goals_are_left_alone():
    agent = DDPG(Walk(), SMALL, num_envs=1, episode_length=10, total_steps=100)
    replay = filled(8, numbered(0, 8))
    rows = replay.sample(jax.random.key(0), (4,))
    batch, shown = agent.relabel(replace(SMALL, her_ratio=1.0), replay, rows, jax.random.key(1))
    assert_same_bits(batch, replay.read(rows))
    assert_same_bits(shown, batch.action)


class Button(Toy):
    """Press where the goal is: a one-dimensional `GoalEnv` of several steps whose episode ends at the goal."""

    def first(self, key: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.zeros(1), jax.random.uniform(key, (1,), minval=-3, maxval=3)])

    def next(self, seen: jax.Array, action: jax.Array):
        at = seen.at[0].add(action)
        reward, done = self.goal_reward(at[:1], at[1:], action)
        return at, reward, done

    def reset(self, key: jax.Array):
        state = super().reset(key)
        return state.replace(info={"goal": state.obs["state"][1:]})

    def achieved(self, obs: dict[str, jax.Array]) -> jax.Array:
        return obs["state"][:1]

    def replace_goal(self, obs: dict[str, jax.Array], goal: jax.Array) -> dict[str, jax.Array]:
        return {name: values.at[1:].set(goal) for name, values in obs.items()}

    def goal_reward(self, achieved: jax.Array, goal: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        there = (jnp.abs(achieved - goal)[0] < 0.3).astype(float)
        return there - 1, there


def test_goals_may_be_those_of_new_episodes():
    config = replace(SMALL, her_ratio=1.0, her_goals="reset")
    agent = DDPG(Button(), config, num_envs=4, episode_length=12, total_steps=100)
    training, _ = jax.jit(agent.epoch, static_argnames="steps")(config, agent.init(config, jax.random.key(0)), steps=9)
    replay = training.replay
    rows = replay.sample(jax.random.key(1), (20, 100))
    old, (new, shown) = replay.read(rows), agent.relabel(config, replay, rows, jax.random.key(2))
    assert_same_bits(shown, old.action)
    goal = np.asarray(new.obs["state"][..., 1])
    assert len(np.unique(goal)) > 1990, "each transition has its own"
    assert kstest(goal.ravel(), "uniform", (-3, 6)).pvalue > 1e-3, "as `reset` draws them"
    there = np.abs(np.asarray(old.next_obs["state"][..., 0]) - goal) < 0.3
    np.testing.assert_array_equal(new.terminal, there)
    np.testing.assert_array_equal(new.reward, there - 1.0)
    np.testing.assert_array_equal(new.next_obs["state"][..., 1], goal)
    np.testing.assert_array_equal(new.obs["state"][..., 0], old.obs["state"][..., 0])


def test_hindsight_recomputes_reward_and_terminal_and_draws_later_goals():
    config = replace(SMALL, her_ratio=1.0, her_goals="future")
    agent = DDPG(Button(), config, num_envs=4, episode_length=12, total_steps=100)
    training, _ = jax.jit(agent.epoch, static_argnames="steps")(config, agent.init(config, jax.random.key(0)), steps=60)
    replay = training.replay
    rows = replay.sample(jax.random.key(1), (2000,))
    old, (new, shown) = replay.read(rows), agent.relabel(config, replay, rows, jax.random.key(2))
    assert_same_bits(shown, old.action)
    at, goal = np.asarray(old.next_obs["state"][:, 0]), np.asarray(new.obs["state"][:, 1])
    there = np.abs(at - goal) < 0.3
    np.testing.assert_array_equal(new.terminal, there)
    np.testing.assert_array_equal(new.reward, there - 1.0)
    assert 0.1 < there.mean() < 0.9 and (np.asarray(old.terminal) != there).any()
    # Every goal is a place that the same environment was at no earlier, in the same episode.
    everything = replay.storage
    places, steps = np.asarray(everything.next_obs["state"][:, 0]), np.asarray(everything.step, int)
    for row, wanted in zip(np.asarray(rows)[:300], goal, strict=False):
        after = [row + 4 * k for k in range(12) if row + 4 * k < int(replay.size)]
        mine = [r for r in after if steps[r] == steps[row] + (r - row) // 4]
        assert np.abs(places[mine] - wanted).min() == 0


def test_arms_of_any_size_are_learnt_alike():
    """Four times as large, a power of two, the paper's arm trains the same networks to the last bit."""

    def train(size: float) -> tuple[Training, dict[str, jax.Array]]:
        spec = mujoco.MjSpec.from_file(str(Path(__file__).parents[2] / "mjcf" / "reach.xml"))
        for part in (*spec.bodies, *spec.sites):
            part.pos = size * part.pos
        env = Reach(ReachConfig(dynamics="kinematic"), load_arm(spec.compile()))
        config = replace(load_config("kinematic.toml").ddpg, actor_width=16, actor_depth=2, updates_per_step=8)
        agent = DDPG(env, config, num_envs=32, episode_length=160, total_steps=10)
        assert agent.reward_unit == pytest.approx(size * 0.268, abs=size * 1e-3)
        training = quick_jit(agent.init)(config, jax.random.key(0))
        return quick_jit(agent.epoch, static_argnames="steps")(config, training, steps=10)

    (one, metrics), (other, larger) = train(1), train(4)
    assert_same_bits(one.networks, other.networks)
    for name in ("reward", "q", "distance"):
        assert float(larger[name]) == pytest.approx(4 * float(metrics[name]), rel=1e-6), name
