"""Our environments as Gymnasium's, for trainers that know no others: one as `GymEnv`, a batch as `GymVectorEnv`.

States stay on the device. A step is one compiled call that takes over the memory of the state before; what comes back
is NumPy.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from arm5dof.envs.base import Env, GoalEnv, Observation, State
from arm5dof.envs.vector import VectorEnv
from arm5dof.errors import UserError
from arm5dof.runtime import forks

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space, iterate
except ImportError as error:
    raise ImportError("Gymnasium is missing or older than 1.1: pip install 'arm5dof[gym]'") from error

Infos = dict[str, Any]
Shown = Literal["state", "dict", "goal"]
"""What is shown of an observation, float32 throughout. state: the actor's vector, (size,). dict: that and the critic's
`privileged_state`. goal: `observation`, `achieved_goal` and `desired_goal`, for replay in hindsight; a goal is one
vector, whatever its parts, and `observation` is the actor's vector as it were with a goal of zeros."""


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """`VectorEnv` with Gymnasium's interface. An environment starts over in the step that ends its episode
    (`AutoresetMode.SAME_STEP`); what that step led to is in `infos["final_obs"]` and `infos["final_info"]`.

    Actions are (num_envs, action_size) in [-1, 1]; observations float32, num_envs first; rewards (num_envs,) float32;
    terminations and truncations (num_envs,) bool. Infos are the environment's metrics and `nonfinite`, num_envs
    first, with Gymnasium's masks.

    A time limit is a truncation. Physics that blew up is one too, with `nonfinite` set and stand-ins for the reward,
    0, and for the final observation, the next episode's first. Leave such a step out if you can. If you cannot, it
    passes for a jump to somewhere average; as a termination it would, where rewards are negative, be the best way out.
    """

    def __init__(self, env: Env, num_envs: int, episode_length: int, observation: Shown = "state") -> None:
        """`episode_length` is the time limit in steps. To show goals, `env` must be a `GoalEnv` that keeps its goal
        in `info["goal"]`."""
        forks.check()
        if observation not in get_args(Shown):
            raise UserError(f"observation must be one of {', '.join(get_args(Shown))}, not {observation!r}")
        if observation == "goal" and not isinstance(env, GoalEnv):
            raise UserError(f"{type(env).__name__} is no GoalEnv: it has no goals to show")
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self._shown, self._goal_env = observation, cast(GoalEnv, env)
        self._batch = VectorEnv(env, episode_length)
        self._state: State | None = None
        self._compile()

        first, _ = jax.eval_shape(self._traced_start, np.uint32(0))[1]
        shown = jax.tree.map(lambda x: spaces.Box(-np.inf, np.inf, x.shape[1:], np.float32), first)
        self.single_observation_space = spaces.Dict(shown) if isinstance(shown, dict) else shown
        self.single_action_space = spaces.Box(-1, 1, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: Infos | None = None) -> tuple[Any, Infos]:
        """Start all environments over. The same seed gives the same bits; without a seed, the random numbers go on
        from where they are. There are no options."""
        forks.check()
        super().reset(seed=seed)
        self._state, first = self._start(self.np_random.integers(2**32, dtype=np.uint32))
        obs, infos = _to_numpy(first)
        return obs, _masked(infos, np.ones(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Observations, rewards, terminations, truncations and infos, as the class says."""
        forks.check()
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, outcome, final = self._advance(self._state, np.asarray(actions, np.float32))
        obs, rewards, terminated, truncated, reached = _to_numpy(outcome)
        over = terminated | truncated
        infos = _masked(reached, ~over)
        if over.any():
            rows = iterate(self.observation_space, _to_numpy(final))
            final_obs = np.full(self.num_envs, None, object)
            for i, row in enumerate(rows):
                final_obs[i] = row if over[i] else None
            infos |= _masked({"final_obs": final_obs, "final_info": _masked(reached, over)}, over)
        return obs, rewards, terminated, truncated, infos

    def _compile(self) -> None:
        self._start = jax.jit(self._traced_start)
        self._advance = jax.jit(self._traced_advance, donate_argnums=0)

    def __getstate__(self) -> Infos:
        """For pickle and copies, which go on with the same bits: without compiled programs, keys as numbers."""
        kept = {name: value for name, value in vars(self).items() if name not in ("_start", "_advance")}
        return {**kept, "_state": jax.tree.map(_Kept.of, self._state)}

    def __setstate__(self, kept: Infos) -> None:
        vars(self).update(kept)
        self._state = jax.tree.map(_Kept.restored, kept["_state"], is_leaf=lambda leaf: isinstance(leaf, _Kept))
        self._compile()

    def _traced_start(self, seed: jax.Array) -> tuple[State, Any]:
        state = self._batch.reset(jax.random.split(jax.random.key(seed), self.num_envs))
        return state, (self._show(state.obs, state), _infos(state))

    def _traced_advance(self, before: State, actions: jax.Array) -> tuple[State, Any, Any]:
        state = self._batch.step(before, actions)
        final = self._show(state.info["next_obs"], before)
        truncated = (state.info["truncation"] > 0) | (state.info["nonfinite"] > 0)
        terminated = (state.done > 0) & ~truncated
        return state, (self._show(state.obs, state), state.reward, terminated, truncated, _infos(state)), final

    def _show(self, obs: Observation, state: State) -> Any:
        """What is shown of `obs`; the goal is the one that `state` holds."""
        if self._shown == "goal":
            env, goal = self._goal_env, state.info["goal"]
            without = jax.vmap(env.replace_goal)(obs, jax.tree.map(jnp.zeros_like, goal))["state"]
            achieved = jax.vmap(env.achieved)(obs)
            return {"observation": without, "achieved_goal": _vectors(achieved), "desired_goal": _vectors(goal)}
        return obs["state"] if self._shown == "state" else obs


class GymEnv(gymnasium.Env):
    """One environment. What is said of `GymVectorEnv` holds, but for the batch axis and the automatic reset."""

    def __init__(self, env: Env, episode_length: int, observation: Shown = "state") -> None:
        self._vector = GymVectorEnv(env, 1, episode_length, observation)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(self, *, seed: int | None = None, options: Infos | None = None) -> tuple[Any, Infos]:
        """Start an episode; seeds as in `GymVectorEnv.reset`."""
        super().reset(seed=seed)
        self._vector.np_random = self.np_random
        obs, infos = self._vector.reset()
        return jax.tree.map(lambda x: x[0], obs), _unmasked(infos)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, Infos]:
        """Observation, reward, terminated, truncated and infos. At an episode's end call `reset`."""
        obs, rewards, terminated, truncated, infos = self._vector.step(np.asarray(action)[None])
        ended = terminated[0] or truncated[0]
        seen = infos["final_obs"][0] if ended else jax.tree.map(lambda x: x[0], obs)
        infos = _unmasked(infos["final_info"] if ended else infos)
        return seen, rewards[0].item(), terminated[0].item(), truncated[0].item(), infos


class GymGoalEnv(GymEnv):
    """One environment that shows its goals, and knows what another goal would have paid. Its rewards are
    `compute_reward` of what it shows, to the last bit."""

    def __init__(self, env: GoalEnv, episode_length: int) -> None:
        """Raises `UserError` if the rewards depend on the action, which replay in hindsight does not tell."""
        super().__init__(env, episode_length, "goal")
        goal = jax.eval_shape(lambda key: env.reset(key).info["goal"], jax.random.key(0))
        action = jnp.zeros(env.action_size)
        traced = jax.make_jaxpr(env.goal_reward)(goal, goal, action).jaxpr
        if any(traced.invars[-1] in equation.invars for equation in traced.eqns):
            raise UserError(f"the rewards of {type(env).__name__} depend on the action: replay in hindsight lacks it")
        self._env, self._goal = env, goal

    @cached_property
    def _rewards(self) -> Any:
        env, action = self._env, jnp.zeros(self._env.action_size)
        _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._goal))
        reward = lambda achieved, wanted: env.goal_reward(unravel(achieved), unravel(wanted), action)[0]
        return jax.jit(jnp.vectorize(reward, signature="(n),(n)->()"))

    def __getstate__(self) -> Infos:
        """See `GymVectorEnv`."""
        return {name: value for name, value in vars(self).items() if name != "_rewards"}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, Infos]:
        """As in `GymEnv.step`."""
        obs, reward, terminated, truncated, info = super().step(action)
        if not info["nonfinite"]:
            reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info).item()
        return obs, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """The rewards, (...) float32, for having reached goals (..., size) where others were asked for."""
        forks.check()
        return np.array(self._rewards(np.asarray(achieved_goal, np.float32), np.asarray(desired_goal, np.float32)))[()]


class _Kept(NamedTuple):
    """An array as pickle and copies keep it."""

    values: np.ndarray
    is_key: bool

    @staticmethod
    def of(leaf: jax.Array) -> _Kept:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return _Kept(np.array(jax.random.key_data(leaf) if is_key else leaf), is_key)

    def restored(self) -> jax.Array:
        return jax.random.wrap_key_data(jnp.array(self.values)) if self.is_key else jnp.array(self.values)


def _vectors(goals: Any) -> jax.Array:
    """Goals with a leading axis, each as one vector."""
    return jax.vmap(lambda goal: ravel_pytree(goal)[0])(goals)


def _infos(state: State) -> dict[str, jax.Array]:
    return {**state.metrics, "nonfinite": state.info["nonfinite"] > 0}


def _to_numpy(tree: Any) -> Any:
    """Copies, for the next step overwrites memory that NumPy would share with JAX on a CPU."""
    return jax.tree.map(np.array, jax.device_get(tree))


def _masked(infos: Infos, mask: np.ndarray) -> Infos:
    """Gymnasium's infos of a batch: beside every entry, which environments have it."""
    return {**infos, **{f"_{name}": mask.copy() for name in infos}}


def _unmasked(infos: Infos) -> Infos:
    """The infos of the only environment."""
    values = {name: value[0] for name, value in infos.items() if not name.startswith("_")}
    return {name: value if value.ndim else value.item() for name, value in values.items()}
