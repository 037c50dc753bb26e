"""Warp modules, one topic a file, for use with or without the rest of warpcage.

To use one in another Warp program copy it, the siblings that its docstring names, and those that they name in turn,
into one package of that program (a folder, since the files import each other as `from .rays import ...`).
"""
