"""Linear solvers for Newton's matrix of a macro step, and the derivative of the solution."""
