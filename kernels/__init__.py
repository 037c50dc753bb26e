"""Warp modules, one topic per file, in folders of the same names as those of warpcage that launch them.

They also work without the rest of warpcage. `warpcage kernels copy mean_value DEST` copies one file and all that it
needs into a package DEST of another program, in the same folders, because the files import each other as in
`from ..view.rays import ...`. Each docstring ends with what its file needs: `Needs: folder/file, folder/file.`

The first argument of a kernel is `first`, the number of the launch's first item. It is 0 unless a launch is cut into
parts, one for each CPU thread.
"""
