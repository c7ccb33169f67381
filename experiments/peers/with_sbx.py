"""sbx (Stable-Baselines3 in JAX): DDPG, TD3 and SAC on the task in NumPy, any number of environments in one batch."""

from __future__ import annotations

import numpy as np
import optax
import sbx
from flax import linen
from gymnasium import spaces
from sbx.td3.policies import TD3Policy
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv
from task import A3, A4, D5, DOF, EPISODE, Record, forward, sample_goals, scaled, to_joints


class Reach(VecEnv):
    """The task for Stable-Baselines3. Observations are the goal (num_envs, 3), scaled; for replay in hindsight they
    are dictionaries with that as `desired_goal`, the scaled end effector as `achieved_goal`, and nothing else to see.
    """

    def __init__(self, num_envs: int, seed: int, hindsight: bool) -> None:
        self.rng = np.random.default_rng(seed)
        self.hindsight = hindsight
        space = point = spaces.Box(-2, 2, (3,), np.float32)
        if hindsight:
            nothing = spaces.Box(-1, 1, (1,), np.float32)
            space = spaces.Dict({"achieved_goal": point, "desired_goal": point, "observation": nothing})
        super().__init__(num_envs, space, spaces.Box(-1, 1, (DOF,), np.float32))

    def reset(self):
        self.goals = sample_goals(self.rng, self.num_envs)
        self.position = sample_goals(self.rng, self.num_envs)
        self.steps = 0
        return self.observe(self.goals, self.position)

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self):
        self.position = forward(to_joints(self.actions))
        rewards = -np.linalg.norm(self.position - self.goals, axis=-1).astype(np.float32)
        self.steps += 1
        obs = self.observe(self.goals, self.position)
        over = self.steps == EPISODE
        infos = [{} for _ in range(self.num_envs)]
        if over:
            last = [{key: obs[key][i] for key in obs} if self.hindsight else obs[i] for i in range(self.num_envs)]
            infos = [{"terminal_observation": each, "TimeLimit.truncated": True} for each in last]
            obs = self.reset()
        return obs, rewards, np.full(self.num_envs, over), infos

    def observe(self, goals: np.ndarray, position: np.ndarray):
        goal = scaled(goals).astype(np.float32)
        if not self.hindsight:
            return goal
        nothing = np.zeros((len(goal), 1), np.float32)
        return {"achieved_goal": scaled(position).astype(np.float32), "desired_goal": goal, "observation": nothing}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _) -> np.ndarray:
        return -np.linalg.norm(achieved - desired, axis=-1) * (A3 + A4 + D5)

    def env_method(self, method_name, *args, indices=None, **kwargs):
        return [getattr(self, method_name)(*args, **kwargs)]

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs

    def close(self):
        pass


class ShuffledHer(HerReplayBuffer):
    """sbx cuts one big sample into the batches of many updates, and HER's sample has all relabelled goals at the end:
    shuffled, every batch gets its share."""

    def sample(self, batch_size, env=None):
        found, order = super().sample(batch_size, env), self.env.rng.permutation(batch_size)
        take = lambda x: {key: x[key][order] for key in x} if isinstance(x, dict) else x[order]
        return DictReplayBufferSamples(*(x if x is None else take(x) for x in found))


class Measure(BaseCallback):
    def __init__(self, record: Record) -> None:
        super().__init__()
        self.record, self.over = record, False

    def _on_step(self) -> bool:
        if self.record.due:
            self.over = self.record.measure(self.num_timesteps, self.answer)
        return not self.over

    def _on_training_end(self) -> None:
        if not self.over:
            self.record.measure(self.num_timesteps, self.answer)

    def answer(self, goals: np.ndarray) -> np.ndarray:
        # Seen from one pose: what there is to see besides the goal does not matter.
        position = np.broadcast_to(forward(np.zeros(DOF)), goals.shape)
        return self.model.predict(self.training_env.observe(goals, position), deterministic=True)[0]


def train(algorithm: str, settings: dict, seed: int, record: Record) -> None:
    s = dict(settings)
    hindsight = s.pop("hindsight")
    env = Reach(s.pop("num_envs"), seed, hindsight)
    policy: dict = {"net_arch": {"pi": s.pop("actor"), "qf": s.pop("critic")}}
    policy |= {"activation_fn": getattr(linen, s.pop("activation")), "layer_norm": s.pop("layer_norm")}
    decay = s.pop("decay_updates")
    if decay:
        rate = lambda progress, lr=s["learning_rate"]: lr * max(0.01, progress)
        if algorithm == "SAC":
            s["learning_rate"] = rate
        else:
            shape = lambda learning_rate, **k: optax.adam(optax.cosine_decay_schedule(learning_rate, decay), **k)
            policy["optimizer_class"] = shape
    if "noise" in s:
        s["action_noise"] = NormalActionNoise(np.zeros(DOF), np.full(DOF, s.pop("noise")))
    name = "MlpPolicy"
    if hindsight:
        s["replay_buffer_class"] = ShuffledHer
        s["replay_buffer_kwargs"] = {"n_sampled_goal": hindsight, "goal_selection_strategy": "episode"}
        name = "MultiInputPolicy" if algorithm == "SAC" else TD3Policy
        s["learning_starts"] = max(s["learning_starts"], (EPISODE + 1) * env.num_envs)
    model = getattr(sbx, algorithm)(name, env, seed=seed, policy_kwargs=policy, **s)
    total = decay * env.num_envs // s["gradient_steps"] if decay else int(record.transitions)
    model.learn(max(total, env.num_envs), callback=Measure(record))
