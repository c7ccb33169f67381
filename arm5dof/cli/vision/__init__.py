"""`arm5dof vision ...`."""
