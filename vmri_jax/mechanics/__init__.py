"""The physics: systems, masses, constraints, forces, states, and the checks at the door."""
