"""Many frames, fits and evaluations: items of a job file, and the worker that makes them."""
