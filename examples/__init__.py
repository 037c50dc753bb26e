"""Programs that show what warpcage does. Each checks itself; `python -m warpcage.examples` lists them by name."""
