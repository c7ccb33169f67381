"""What the machine needs: XLA settings, programs kept on disk, files, tables, progress bars.

All that computes imports from here, so this is where XLA's flags are set, before JAX starts its first back end.
"""

from arm5dof.runtime import xla

xla.configure()
