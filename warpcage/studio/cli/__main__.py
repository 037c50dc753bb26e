"""`python -m warpcage.studio.cli`: the same as the `warpcage` script."""

from __future__ import annotations

import sys

from . import main

sys.exit(main())
