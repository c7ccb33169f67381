"""Sweeps: many short trainings of one experiment, one table, and what it says. A member is one complete run."""
