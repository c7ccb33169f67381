"""Deep deterministic policy gradient (the paper's Algorithm 1), one jitted program."""

from arm5dof.ddpg.agent import DDPG, Networks, Training
from arm5dof.ddpg.config import DDPGConfig
from arm5dof.ddpg.replay import Replay, Transition

__all__ = ["DDPG", "DDPGConfig", "Networks", "Replay", "Training", "Transition"]
