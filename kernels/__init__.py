"""Warp modules, one topic a file, for use with or without the rest of warpcage.

To use one in another Warp program copy it, the siblings that its docstring names, and those that they name in turn,
into one package of that program (a folder, since the files import each other as `from .rays import ...`). Kernels
begin with `first`, the number of the launch's first item: 0, unless a launch is cut into parts (over CPU threads).
"""
