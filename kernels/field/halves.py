"""Numbers in half precision, as files have them, become single on the device: half as many bytes are sent to it."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Numbers of a thread: rows of harmonics are multiples of it, and those of large fields have more than 2^31 numbers.
RUN = wp.constant(3)


@wp.kernel
def widen_rows(first: int, halves: wp.array2d(dtype=wp.float16), singles: wp.array2d(dtype=wp.float32)):
    """Copy RUN numbers, from halves (rows, n) to singles (rows, n), n a multiple of RUN. first: of the launch's runs,
    which follow each other row by row."""
    run = first + wp.tid()
    runs = halves.shape[1] // RUN
    row, column = run // runs, RUN * (run % runs)
    for k in range(RUN):
        singles[row, column + k] = wp.float32(halves[row, column + k])
