"""Newton's iteration over all unknowns of a macro step: linear solvers, derivative of the solution."""
