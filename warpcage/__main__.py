"""`python -m warpcage`: the command line, where its script is not on the path."""

from __future__ import annotations

import sys

from .studio.cli import main

sys.exit(main())
