"""How a macro step is taken."""
