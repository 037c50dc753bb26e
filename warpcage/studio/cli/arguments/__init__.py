"""The arguments of the commands, one module each: name, help, example, arguments. Nothing here needs NumPy or Warp."""
