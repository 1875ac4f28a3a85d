/* n diatomic molecules of unit masses by the impulse method (r-RESPA): Lennard-Jones forces between all pairs of atoms of different
   molecules at macro nodes, stiff bonds at micro nodes. Diameter and depth of the Lennard-Jones potential are 1. */

#include <math.h>
#include <stdlib.h>

/* Kicks of the atoms first .. last - 1 by the atom at (x, y, z): every atom is kicked by all others, each pair is looked at twice, so that
   no lane of a vector waits for another one. */
static inline void kick_by(double x, double y, double z, const double *restrict X, const double *restrict Y, const double *restrict Z,
                           double *restrict P, double *restrict Q, double *restrict R, long first, long last, double dt)
{
    for (long j = first; j < last; j++) {
        const double dx = X[j] - x, dy = Y[j] - y, dz = Z[j] - z;
        const double inverse = 1 / (dx * dx + dy * dy + dz * dz), cube = inverse * inverse * inverse;
        const double pull = dt * 24 * inverse * cube * (2 * cube - 1);
        P[j] += pull * dx;
        Q[j] += pull * dy;
        R[j] += pull * dz;
    }
}

/* Kick of the bonds: bond i joins the atoms 2 i and 2 i + 1. */
static inline void kick_bonds(const double *restrict x, double *restrict p, long n, double stiffness, double length, double dt)
{
    for (long i = 0; i < n; i++) {
        double d[3], square = 0;
        for (int a = 0; a < 3; a++) {
            d[a] = x[6 * i + a] - x[6 * i + 3 + a];
            square += d[a] * d[a];
        }
        const double pull = dt * stiffness * (1 - length / sqrt(square));
        for (int a = 0; a < 3; a++) {
            p[6 * i + a] -= pull * d[a];
            p[6 * i + 3 + a] += pull * d[a];
        }
    }
}

/* q, p: (6 n) positions and momenta, atom by atom, in and out; num_steps >= 1 macro steps.
   Returns the Newton iterations, none, or -1 if there is no memory. */
long molecules(double *q, double *p, long n, double stiffness, double length, long num_micro, double micro_dt, long num_steps)
{
    const long atoms = 2 * n;
    const double macro_dt = num_micro * micro_dt;
    double *const room = malloc(6 * atoms * sizeof(double)); /* coordinates and kicks, an array for each axis */
    if (!room) return -1;
    double *const X = room, *const Y = X + atoms, *const Z = Y + atoms;
    double *const P = Z + atoms, *const Q = P + atoms, *const R = Q + atoms;
    for (long k = 0; k <= num_steps; k++) {
        const double weight = k == 0 || k == num_steps ? 0.5 : 1; /* half a kick at both ends of the run */
        for (long i = 0; i < atoms; i++) {
            X[i] = q[3 * i], Y[i] = q[3 * i + 1], Z[i] = q[3 * i + 2];
            P[i] = Q[i] = R[i] = 0;
        }
        for (long i = 0; i < atoms; i++) { /* all atoms but those of its molecule */
            const long first = i - i % 2;
            kick_by(X[i], Y[i], Z[i], X, Y, Z, P, Q, R, 0, first, weight * macro_dt);
            kick_by(X[i], Y[i], Z[i], X, Y, Z, P, Q, R, first + 2, atoms, weight * macro_dt);
        }
        for (long i = 0; i < atoms; i++) p[3 * i] += P[i], p[3 * i + 1] += Q[i], p[3 * i + 2] += R[i];
        kick_bonds(q, p, n, stiffness, length, weight * micro_dt);
        if (k == num_steps) break;
        for (long m = 0; m < num_micro; m++) {
            if (m) kick_bonds(q, p, n, stiffness, length, micro_dt);
            for (long i = 0; i < 3 * atoms; i++) q[i] += micro_dt * p[i];
        }
    }
    free(room);
    return 0;
}
