"""Scene folders as data sets of research publish them."""
