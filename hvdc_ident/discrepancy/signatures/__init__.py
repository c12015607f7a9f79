"""How the outputs would differ if an effect of the catalogue were at a place, computed without compiling it in."""
