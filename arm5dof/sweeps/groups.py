"""Which members share a compiled program, and whether they fit the memory."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import replace
from typing import NamedTuple

import jax

from arm5dof.errors import UserError
from arm5dof.sweeps.spec import Member
from arm5dof.training.config import Config, make_env
from arm5dof.training.trainer import Trainer, memory_free

SPARE = 0.8
"""Share of the free memory that members may take: programs and evaluations need the rest."""


class Group(NamedTuple):
    """Members of one program shape."""

    members: list[Member]
    member_bytes: int
    """Memory that one member's training takes: its state twice, as input and as output, and a step's batches."""


def shape(config: Config) -> Hashable:
    """All of a configuration that shapes its program and its schedule: members that agree in it differ by the agent's
    numbers and the seed alone."""
    agent = jax.tree.structure(config.ddpg)
    return config.task, config.env, agent, replace(config.train, seed=0), config.evaluate


def grouped(members: Iterable[Member]) -> list[Group]:
    """Members by program shape, in the order of their first.

    Raises:
        UserError: A member's budget does not divide, or its agent does not go with the task.
    """
    found: dict[Hashable, list[Member]] = {}
    for member in members:
        found.setdefault(shape(member.config), []).append(member)
    return [Group(alike, member_bytes(alike[0].config)) for alike in found.values()]


def member_bytes(config: Config) -> int:
    """See `Group`. Raises `UserError` if such a member cannot be made."""
    trainer = Trainer(make_env(config), config)
    size = lambda tree: sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
    transition = trainer.replay_bytes / max(config.ddpg.replay_capacity, 1)
    batches = 2 * config.ddpg.updates_per_step * config.ddpg.batch_size * transition
    return 2 * size(trainer.like) + int(batches)


def chunk_size(group: Group, sharing: int, free: int | None = None) -> int:
    """How many of a group's members fit the memory at once, where so many workers share it.

    Raises:
        UserError: Not one does.
    """
    share = SPARE * (memory_free() if free is None else free) / sharing
    fitting = int(share // max(group.member_bytes, 1))
    if fitting < 1:
        raise UserError(
            f"a member takes {group.member_bytes / 1e9:.2f} GB and {share / 1e9:.2f} GB are free for each worker: "
            "choose fewer workers or a smaller replay_capacity"
        )
    return min(fitting, len(group.members))
