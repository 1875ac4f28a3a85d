"""Schemes as data: quadrature rules, paths, compositions, the discrete Lagrangian and the equations of a step."""
