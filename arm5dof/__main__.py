"""`python -m arm5dof`."""

import sys

from arm5dof.cli.main import main

sys.exit(main())
