"""Where micro steps pay: slow forces that are dear. Time to an error against the price of the slow force, with its
bound.

Three kinds of system. Molecules: n diatomic ones with stiff bonds W and Lennard-Jones forces V between all pairs of
atoms of different molecules; W costs n terms, V 2 n (n - 1). A teacher and its student: a chain of stiff springs in a
potential by a network of many weights (the teacher), of which a small one (the student) knows the most; the student
stands on the micro nodes, the difference on the macro nodes (multiple time steps with learned potentials, arXiv
2510.06562). A spacecraft: a hub with masses on stiff booms in a gravity field of degree 50.

The bound: if single steps are as long as micro steps of the same error, N of them cost ``N (v + w)`` for prices v of V
and w of W, a macro step costs ``v + N w``.
"""

from benchmarks.dear.compare import run, sizes

__all__ = ["run", "sizes"]
