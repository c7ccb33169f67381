"""Environments: pure, single, batched with `jax.vmap`."""

from arm5dof.envs.base import Env, GoalEnv, State
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.envs.vector import VectorEnv

__all__ = ["Env", "GoalEnv", "Reach", "ReachConfig", "State", "VectorEnv"]
