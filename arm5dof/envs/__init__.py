"""Environments: pure, single, batched with `jax.vmap`. A task is one file here, or a class of the user's own."""

from arm5dof.envs.base import Env, ForwardModel, GoalEnv, State, Task
from arm5dof.envs.vector import VectorEnv

__all__ = ["Env", "ForwardModel", "GoalEnv", "State", "Task", "VectorEnv"]
