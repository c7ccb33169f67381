"""What MuJoCo has to say of a model while it reads or simulates it. By itself it would say so on stderr, and in a file
MUJOCO_LOG.TXT in the folder where the user happens to be."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def overheard() -> Iterator[list[str]]:
    """What MuJoCo warns of inside goes into a list, and nowhere else."""
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before)


@contextmanager
def reading() -> Iterator[None]:
    """Read models inside: what MuJoCo warns of is a `UserWarning`.

    Raises:
        ValueError: A number is NaN, which MuJoCo would take.
    """
    with overheard() as said:
        yield
    for text in dict.fromkeys(said):
        if "NaN" in text:
            raise ValueError("a number in it is NaN")
        warnings.warn(f"MuJoCo: {' '.join(text.split())}", stacklevel=3)
