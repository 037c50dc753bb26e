"""`python -m warpcage.cli`: the same as the `warpcage` script."""

import sys

from . import main

sys.exit(main())
