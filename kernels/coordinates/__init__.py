"""Mean value and Green coordinates in closed form."""
