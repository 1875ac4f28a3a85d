/* Triple spherical pendulum by RATTLE, every step a micro step.

   With q_1 and r = q_2 - q_1 the constraints are g = (|q_1|^2 - l_1^2) / 2, (|r|^2 - l_2^2) / 2. Exploited:
   - one force evaluation per node: the two half kicks that meet there are one kick, and the two constraint impulses,
     mu that ends the step before (velocities on the constraints) and lambda that starts the next, are one impulse;
   - the Newton matrix is G M^-1 G^T at the start of the step, wrong by O(dt): it is symmetric, its inverse is at hand
     from mu, and it gains four digits an iteration;
   - gravity is the same for all bobs and drops out of the velocity of the rod. */

#include "vec.h"

typedef struct {
    double first, second;
} Pair;

/* v - M^-1 G^T impulse, with w = M^-1; also for positions. */
static inline void push(vec *v, const double *w, vec q_1, vec r, Pair impulse)
{
    v[0] -= w[0] * (impulse.first * q_1 - impulse.second * r);
    v[1] -= w[1] * impulse.second * r;
}

/* q, p: (9,), in and out, on the constraints; num_steps >= 1. Returns the Newton iterations of all steps, or -1 if 50
   did not bring |g| below the tolerance, an absolute one in the unit of g. */
long tsp(double *q, double *p, const double *masses, const double *lengths, double stiffness, double gravity, double dt,
         long num_steps, double tolerance)
{
    const double w[3] = {1 / masses[0], 1 / masses[1], 1 / masses[2]};
    const double square_1 = lengths[0] * lengths[0], square_2 = lengths[1] * lengths[1];
    const vec down = {0, 0, -gravity};
    vec x[3], v[3];
    unpack(3, q, p, masses, x, v);

    Pair lambda = {0, 0};
    long iterations = 0;
    for (long n = 0;; n++) {
        const int first = n == 0, last = n == num_steps;
        const vec q_1 = x[0], r = x[1] - x[0], d = x[2] - x[1];
        const double f = pull(d, stiffness, lengths[2]);
        const double a_11 = w[0] * dot(q_1, q_1), a_12 = -w[0] * dot(q_1, r), a_22 = (w[0] + w[1]) * dot(r, r);
        const double inverse = 1 / (a_11 * a_22 - a_12 * a_12);

        Pair impulse = {0, 0};
        if (!first) { /* G v = 0 after half a kick */
            const double b_1 = dot(q_1, v[0] + dt / 2 * down);
            const double b_2 = dot(r, v[1] - v[0]) + dt / 2 * w[1] * f * dot(r, d);
            impulse = (Pair){inverse * (a_22 * b_1 - a_12 * b_2), inverse * (a_11 * b_2 - a_12 * b_1)};
        }
        if (!last) impulse = (Pair){impulse.first + lambda.first, impulse.second + lambda.second};
        const double kick = first || last ? dt / 2 : dt;
        v[0] += kick * down;
        v[1] += kick * (down + w[1] * f * d);
        v[2] += kick * (down - w[2] * f * d);
        push(v, w, q_1, r, impulse);
        if (last) break;

        for (int i = 0; i < 3; i++) x[i] += dt * v[i];
        for (int k = 0;; k++) {
            const vec rod = x[1] - x[0];
            const double g_1 = (dot(x[0], x[0]) - square_1) / 2, g_2 = (dot(rod, rod) - square_2) / 2;
            if (fabs(g_1) <= tolerance && fabs(g_2) <= tolerance) break;
            if (k == 50) return -1;
            const Pair step = {inverse * (a_22 * g_1 - a_12 * g_2), inverse * (a_11 * g_2 - a_12 * g_1)};
            const Pair change = {step.first / dt, step.second / dt};
            push(x, w, q_1, r, step);
            push(v, w, q_1, r, change);
            lambda = (Pair){lambda.first + change.first, lambda.second + change.second};
            iterations++;
        }
    }
    pack(3, x, v, masses, q, p);
    return iterations;
}
