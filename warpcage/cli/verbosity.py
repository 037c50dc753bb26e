"""How much a command says."""

#: Whether --verbose was given: Warp's own lines are shown, and those of what is tried.
verbose = False
