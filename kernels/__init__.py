"""Warp modules, one topic per file, in folders of the same names as those of warpcage that launch them."""

# They also work without the rest of warpcage: they import each other relatively, so that `warpcage kernels copy` takes
# a file and all that it needs along. The first argument of a kernel is `first`, the number of the launch's first item.
# It is 0 unless a launch is cut into parts, one for each CPU thread.
