"""Mean value and Green coordinates in closed form, and maximum likelihood coordinates by a few steps."""
