"""arm5dof: massively parallel training of vision-guided robot arms in JAX and MJX."""

from arm5dof.runtime import xla

xla.configure()

__version__ = "0.1.0"
