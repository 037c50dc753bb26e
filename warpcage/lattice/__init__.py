"""Maps on the nodes of a lattice over a cage, new for each pose."""
