"""A trained policy: observations in, actions out; where its task has a forward model, goals in, joint angles out."""

from __future__ import annotations

from functools import cache, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from arm5dof.ddpg import DDPG, DDPGConfig, Networks
from arm5dof.envs import ForwardModel, Task, inverse_kinematics, paths
from arm5dof.envs.base import Goal, Observation, vectors
from arm5dof.envs.inverse_kinematics import Answer, Candidate
from arm5dof.envs.paths import Path
from arm5dof.errors import UserError
from arm5dof.runtime import forks, xla
from arm5dof.runtime.tables import Table
from arm5dof.training.policy_program import of_policy

AT_ONCE = 4_096
"""Goals in one device call: more take memory, and on a CPU, beyond its caches, more time each."""

BLOCK = 512
"""Goals that a core of a CPU answers at a time where there are more than `AT_ONCE`: they stay in its cache."""

MOST_CORRECTIONS = 10_000


class Policy(struct.PyTreeNode, eq=False):
    """A trained policy for one task. A pytree whose leaves are the networks and the agent's numbers.

    >>> import tempfile
    >>> from arm5dof import load_config, train
    >>> folder = tempfile.TemporaryDirectory()
    >>> budget = {"episodes": 2, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "updates_per_step": 1}
    >>> config = load_config("kinematic.toml", targets=100, refinements=1, **budget)  # Seconds: far from enough.
    >>> policy = train(config, f"{folder.name}/short").policy()
    >>> answer = policy.solve([0.15, 0.05, 0.12], corrections=2)
    >>> answer.q.shape, answer.outcome.shape, answer.errors["distance"].shape  # radians, metres, metres
    ((5,), (3,), ())
    >>> policy.solve([[0.15, 0.05, 0.12], [0.1, -0.1, 0.2]]).q.shape
    (2, 5)
    """

    env: Task = struct.field(pytree_node=False)
    agent: DDPG = struct.field(pytree_node=False)
    config: DDPGConfig
    networks: Networks

    def __call__(self, obs: Observation, branch: jax.Array | None = None) -> jax.Array:
        """The policy's actions.

        Args:
            obs: Observations as `State.obs` has them, a dictionary of arrays (n, size), or (size,) for one.
            branch: Which of the actor's heads is to answer, (n,) int32; without it the one the critic prefers.

        Returns:
            Actions, (n, action_size) in [-1, 1]; (action_size,) for one observation.

        Raises:
            UserError: These are no observations of the policy's task.
        """
        if _is_single(self.env, obs):
            return self(*jax.tree.map(lambda x: jnp.asarray(x)[None], (obs, branch)))[0]
        branch = self.branch(obs) if branch is None else branch
        return self.agent.answer(self.networks.actor, obs, branch)

    def branch(self, obs: Observation) -> jax.Array:
        """Which of the actor's heads the critic prefers, (n,) int32, for observations as in a call."""
        if _is_single(self.env, obs):
            return self.branch(jax.tree.map(lambda x: jnp.asarray(x)[None], obs))[0]
        return self.agent.head(self.config, self.networks.actor, self.networks.critic, obs)

    def answers(self, obs: Observation) -> jax.Array:
        """The actions of all the actor's heads, (n, heads, action_size), for observations as in a call."""
        if _is_single(self.env, obs):
            return self.answers(jax.tree.map(lambda x: jnp.asarray(x)[None], obs))[0]
        return self.agent.candidates(self.networks.actor, obs)

    @property
    def forward_model(self) -> ForwardModel:
        """The task, if it tells where an action leads. Raises `UserError` if it does not."""
        return forward_model(self.env)

    def solve(
        self, *target: Any, corrections: int = 0, near: Any = None, candidates: bool = False, **inputs: Any
    ) -> Answer:
        """Inverse kinematics: ask for joint positions that lead to goals, from the arm's home pose.

        Args:
            target: The first of the task's goal inputs, which for the tasks that ship is a point (3,), metres in the
                world frame, or several, (n, 3).
            corrections: How often the policy is asked again for a goal shifted by the error it was seen to make
                (closed-loop target correction). The best answer counts; where it misses, as it must out of reach, the
                nearest that damped least squares finds, begun at all of the policy's answers and a few random ones.
            near: Joint positions (dof,), or (n, dof), radians (metres for slides): of all the actor's answers that are
                within the smallest limits of the task's errors (1 mm, 0.5 degrees) the nearest to these counts.
            candidates: Whether to give every candidate answer, as many as the task follows where it corrects, the
                best one first: with an axis (candidates,) after that of the goals. Some may be far off.
            inputs: The goal inputs by name: `target=...`, and for `reach_pose` `approach=...` (3,) or (n, 3), or
                `quaternion=...` (4,) or (n, 4), w first.

        Returns:
            An `Answer`; for one goal without the leading axis.

        Raises:
            UserError: A goal is missing, not finite or of another shape, or the task has no forward model.
        """
        goals, single = self._goals(target, inputs, corrections)
        if near is not None and candidates:
            raise UserError("solve takes near or candidates, not both")
        n = len(jax.tree.leaves(goals)[0])
        poses = None if near is None else np.broadcast_to(self._pose("near", near, n), (n, self.env.action_size))
        if n <= AT_ONCE:
            answer = self._answer(goals, corrections, poses, candidates)
            return jax.tree.map(lambda x: x[0], answer) if single else answer
        goals = jax.tree.map(np.asarray, goals)

        def part(first: int) -> Answer:
            # All are of one size, since another would be another program: the last begins again at the first goal.
            rows = np.arange(first, first + AT_ONCE) % n
            some = jax.tree.map(lambda x: x[rows], goals)
            if one_shot:
                return _solve_in_blocks(self, some).answer
            return self._answer(some, corrections, None if poses is None else poses[rows], candidates)

        one_shot = not (corrections or candidates) and near is None and jax.default_backend() == "cpu"
        parts = (xla.on_all_cores if one_shot else map)(part, range(0, n, AT_ONCE))
        return jax.tree.map(lambda *xs: jnp.concatenate(xs)[:n], *parts)

    def _answer(self, goals: Goal, corrections: int, near: np.ndarray | None, candidates: bool) -> Answer:
        """`solve` for so many goals as fit the memory."""
        if near is not None:
            turns, stops = self.forward_model.turns, self.forward_model.stops
            found, met = self._candidates(goals, corrections)
            if corrections and not met.any(0).all():
                best = jax.tree.map(lambda x: x[None], _solve(self, goals, corrections=corrections))
                found = jax.tree.map(lambda *parts: jnp.concatenate(parts), found, best)
                met = self._met(found.answer)
            which = paths.nearest(np.asarray(found.answer.q), met, np.asarray(found.reward), turns, near)
            answer = _pick(found, which)
            return answer._replace(q=jnp.asarray(paths.beside(np.asarray(answer.q), near, turns, stops)))
        if candidates:
            found = _ask(self, goals, corrections=corrections, branches=self.forward_model.branches)
            return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), found.answer)
        return _solve(self, goals, corrections=corrections).answer

    def solve_all(self, *target: Any, corrections: int = 10, **inputs: Any) -> Answer:
        """Every distinct answer of the actor to one goal, the best first.

        Args:
            target: As for `solve`, but one goal.
            corrections: As for `solve`, of each answer.
            inputs: As for `solve`.

        Returns:
            An `Answer` with a leading axis (k,). Some may be far off: see their errors.

        Raises:
            UserError: As for `solve`, or there are several goals.
        """
        goals, single = self._goals(target, inputs, corrections)
        if not single:
            raise UserError("solve_all takes one goal")
        found = jax.tree.map(lambda x: x[:, 0], self._candidates(goals, corrections)[0])
        rows = np.array(paths.distinct(np.asarray(found.answer.q), np.asarray(found.reward), self.forward_model.turns))
        return jax.tree.map(lambda x: x[rows], found.answer)

    def path(self, *target: Any, start: Any = None, corrections: int = 10, **inputs: Any) -> Path:
        """Answers to a line of goals that lie near each other, without a jump of a joint where there is such a way.

        One branch of the actor is kept where one serves. Where none does, lines of damped least squares that begin at
        the answers to the first and to the last goal, those of `solve` among them, are candidates too.

        Args:
            target: As for `solve`, (n, 3).
            start: Joint positions (dof,), radians (metres for slides), from which the joints' way is to be short.
            corrections: As for `solve`.
            inputs: As for `solve`.

        Returns:
            A `Path`. A goal may be missed, and a joint may jump: see its `errors` and `jumps`.

        Raises:
            UserError: As for `solve`, or there is one goal only.
        """
        goals, single = self._goals(target, inputs, corrections)
        found, met = self._candidates(goals, corrections)
        n = met.shape[1]
        if single or n < 2:
            raise UserError("path takes the goals of a line, two or more: for one use solve")
        begin = None if start is None else self._pose("start", start, 1)[0]
        best = self._path(found, begin)
        if best.jumps.any() or not self._met(best).all():
            ends = _solve(self, jax.tree.map(lambda x: x[np.array([0, -1])], goals), corrections=max(corrections, 1))
            starts = jnp.concatenate([found.action[:, [0, -1]], ends.action[None]])
            more = _lines(self.forward_model, goals, starts)
            best = self._path(jax.tree.map(lambda *parts: jnp.concatenate(parts), found, more), begin)
        return best

    def _path(self, found: Candidate, begin: np.ndarray | None) -> Path:
        """The best line of candidates (k, n)."""
        turns, stops = self.forward_model.turns, self.forward_model.stops
        answer = _pick(found, paths.chain(np.asarray(found.answer.q), self._met(found.answer), turns, begin))
        q = np.array(answer.q)
        if begin is not None:
            q[0] = paths.beside(q[0], begin, turns, stops)
        q = paths.unwound(q, turns, stops)
        return Path(jnp.asarray(q), answer.outcome, answer.errors, paths.jumps(q))

    def _goals(self, target: tuple[Any, ...], inputs: dict[str, Any], corrections: Any) -> tuple[Goal, bool]:
        """Goals with a leading axis, and whether one was stated without."""
        forks.check()
        model = self.forward_model
        names = list(model.goal_inputs)
        given = {**dict(zip(names, target, strict=False)), **inputs}
        if len(target) > len(names) or set(given) != set(names) or set(inputs) & set(names[: len(target)]):
            wanted = " and ".join(f"{name} ({', '.join(parts)})" for name, parts in model.goal_inputs.items())
            stated = [*names[: len(target)], *inputs, *target[len(names) :]]
            raise UserError(
                f"solve takes {wanted} for this task, each once, not {', '.join(map(str, stated)) or 'nothing'}"
            )
        if not isinstance(corrections, (int, np.integer)) or not 0 <= corrections <= MOST_CORRECTIONS:
            raise UserError(f"corrections = {corrections!r}: it should be a whole number from 0 to {MOST_CORRECTIONS}")
        goals = model.goals(**given)
        if len({len(leaf) for leaf in jax.tree.leaves(goals)}) > 1:
            raise UserError(f"solve takes as many of each of {' and '.join(names)}")
        return goals, all(np.ndim(values) == 1 for values in given.values())

    def _pose(self, name: str, values: Any, rows: int) -> np.ndarray:
        """Joint positions that people give, (1, dof) or (rows, dof). Raises `UserError` for anything else."""
        poses = np.atleast_2d(vectors(name, values, self.forward_model.joint_names))
        if len(poses) not in (1, rows):
            wanted = "one pose" if rows == 1 else f"one pose, or one for each of {rows} goals"
            raise UserError(f"{name} takes {wanted}, not {len(poses)}")
        return poses

    def _candidates(self, goals: Goal, corrections: int) -> tuple[Candidate, np.ndarray]:
        """The answers of all the actor's heads, (k, n), and which meet their goals."""
        found = _ask(self, goals, corrections=corrections, branches=None)
        return found, self._met(found.answer)

    def _met(self, answer: Answer | Path) -> np.ndarray:
        components = self.forward_model.components
        return np.all([np.asarray(answer.errors[name]) <= error.close for name, error in components.items()], axis=0)

    def _table(self) -> Table:
        weights = lambda network: f"{sum(leaf.size for leaf in jax.tree.leaves(network)):,} weights"
        rows = [
            ("task", type(self.env).__name__),
            ("actions", str(self.env.action_size)),
            ("actor", f"{weights(self.networks.actor)}, {self.agent.actor.heads} heads"),
            ("critic", f"{weights(self.networks.critic)}, {self.agent.critic.form}"),
        ]
        if isinstance(self.env, ForwardModel):
            rows.append(("solve", ", ".join(f"{k} ({', '.join(v)})" for k, v in self.env.goal_inputs.items())))
        return Table("Policy", ("what", "value"), rows)

    def __repr__(self) -> str:
        return self._table().text()

    def _repr_html_(self) -> str:
        return self._table().html()


@lru_cache(maxsize=8)
def forward_model(env: Task) -> ForwardModel:
    """See `Policy.forward_model`: to look whether a task has all of a protocol's attributes computes them."""
    if not isinstance(env, ForwardModel):
        raise UserError(f"the task {type(env).__name__} has no forward model: its policy only acts")
    return env


@of_policy(xla.fusion_emitters)  # Networks and no physics: the emitters make them twice as fast.
def _solve(policy: Policy, goals: Goal, corrections: int) -> Candidate:
    return inverse_kinematics.solve(policy.forward_model, policy, goals, corrections)


@of_policy(lambda: xla.fusion_emitters() | xla.ONE_CORE)
def _solve_in_blocks(policy: Policy, goals: Goal) -> Candidate:
    blocks = jax.tree.map(lambda x: x.reshape(-1, BLOCK, *x.shape[1:]), goals)
    found = jax.lax.map(lambda some: inverse_kinematics.solve(policy.forward_model, policy, some, 0), blocks)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)


@of_policy(xla.fusion_emitters)
def _ask(policy: Policy, goals: Goal, corrections: int, branches: int | None) -> Candidate:
    return inverse_kinematics.candidates(policy.forward_model, policy, goals, corrections, branches)


@partial(jax.jit, static_argnames="env")
def _lines(env: ForwardModel, goals: Goal, ends: jax.Array) -> Candidate:
    """Along the goals from actions (k, 2, action_size) at the first and back from those at the last, (2 k, n)."""
    turned = lambda tree: jax.tree.map(lambda x: x[::-1], tree)
    there = inverse_kinematics.follow_line(env, goals, ends[:, 0])
    back = inverse_kinematics.follow_line(env, turned(goals), ends[:, 1])
    back = jax.tree.map(lambda x: x[:, ::-1], back)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), there, back)


def _pick(found: Candidate, which: np.ndarray) -> Answer:
    """Of candidates (k, n) one for each goal."""
    return jax.tree.map(lambda x: x[which, np.arange(len(which))], found.answer)


def _is_single(env: Task, obs: Any) -> bool:
    """Whether that is one observation of a task, rather than a batch of them. Raises `UserError` if it is neither."""
    forks.check()
    sizes = _observation_sizes(env)
    wanted = " and ".join(f"{name} ({size},)" for name, size in sizes.items())
    if not isinstance(obs, dict) or obs.keys() != sizes.keys():
        found = ", ".join(map(str, obs)) if isinstance(obs, dict) else type(obs).__name__
        raise UserError(f"a policy acts on observations, a dictionary of {wanted}, not {found}; for goals use solve")
    shapes = {name: np.shape(value) for name, value in obs.items()}
    batches = {shape[:-1] for shape in shapes.values()}
    if any(shapes[name][-1:] != (size,) for name, size in sizes.items()) or len(batches) > 1 or len(min(batches)) > 1:
        found = " and ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise UserError(f"this policy acts on {wanted}, or (n, size) for n observations, not {found}")
    return batches == {()}


@cache
def _observation_sizes(env: Task) -> dict[str, int]:
    """The sizes of a task's observations, by name."""
    obs = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0))).obs
    return {name: value.shape[-1] for name, value in obs.items()}
