"""`python -m arm5dof`."""

import sys

from arm5dof.cli import main

sys.exit(main())
