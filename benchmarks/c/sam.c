/* Simple atomic model by RATTLE, every step a micro step.

   Bonds b = (q_1, q_4 - q_2, q_5 - q_2, q_6 - q_3) with g = (|b|^2 - l^2) / 2. Exploited:
   - only the bonds 2-4 and 2-5 share an atom: G M^-1 G^T is a 2 x 2 block between two numbers;
   - its diagonal is constant where g = 0, so that one dot product and one division remain;
   - one force evaluation per node: the two half kicks that meet there are one kick, and the two constraint impulses,
     mu that ends the step before (velocities on the constraints) and lambda that starts the next, are one impulse;
   - the Newton matrix is G M^-1 G^T at the start of the step, wrong by O(dt): it is symmetric, its inverse is at hand
     from mu, and it gains four digits an iteration. */

#include "vec.h"

typedef double bonds __attribute__((vector_size(32))); /* one number per bond */

typedef struct {
    double inverse_1, a_2, a_3, a_23, inverse_23, inverse_4; /* of G M^-1 G^T; inverse_23: of the determinant */
} Matrix;

static inline bonds solve(Matrix m, bonds b)
{
    return (bonds){m.inverse_1 * b[0], m.inverse_23 * (m.a_3 * b[1] - m.a_23 * b[2]),
                   m.inverse_23 * (m.a_2 * b[2] - m.a_23 * b[1]), m.inverse_4 * b[3]};
}

/* G v for the bonds b. */
static inline bonds rates(const vec *b, const vec *v)
{
    return (bonds){dot(b[0], v[0]), dot(b[1], v[3] - v[1]), dot(b[2], v[4] - v[1]), dot(b[3], v[5] - v[2])};
}

/* v - M^-1 G^T impulse, with w = M^-1; also for positions. */
static inline void push(vec *v, const double *w, const vec *b, bonds impulse)
{
    v[0] -= w[0] * impulse[0] * b[0];
    v[1] += w[1] * (impulse[1] * b[1] + impulse[2] * b[2]);
    v[2] += w[2] * impulse[3] * b[3];
    v[3] -= w[3] * impulse[1] * b[1];
    v[4] -= w[4] * impulse[2] * b[2];
    v[5] -= w[5] * impulse[3] * b[3];
}

/* q, p: (18,), in and out, on the constraints; stiffness (3,) of 1-2, 2-3 and the triangle; num_steps >= 1. Returns
   the Newton iterations of all steps, -1 if 50 did not bring |g| below the tolerance (absolute, in the unit of g). */
long sam(double *q, double *p, const double *masses, const double *stiffness, double length, double gravity, double dt,
         long num_steps, double tolerance)
{
    double w[6];
    for (int i = 0; i < 6; i++) w[i] = 1 / masses[i];
    const double square = length * length;
    const vec down = {0, 0, -gravity};
    vec x[6], v[6], a[6], half[6];
    unpack(6, q, p, masses, x, v);

    Matrix m = {.inverse_1 = 1 / (square * w[0]),
                .a_2 = square * (w[1] + w[3]),
                .a_3 = square * (w[1] + w[4]),
                .inverse_4 = 1 / (square * (w[2] + w[5]))};
    bonds lambda = {0};
    long iterations = 0;
    for (long n = 0;; n++) {
        const int first = n == 0, last = n == num_steps;
        vec f_12 = x[1] - x[0], f_23 = x[2] - x[1], f_34 = x[3] - x[2], f_45 = x[4] - x[3], f_53 = x[2] - x[4];
        f_12 *= pull(f_12, stiffness[0], length);
        f_23 *= pull(f_23, stiffness[1], length);
        f_34 *= pull(f_34, stiffness[2], length);
        f_45 *= pull(f_45, stiffness[2], length);
        f_53 *= pull(f_53, stiffness[2], length);
        a[0] = down + w[0] * f_12;
        a[1] = down + w[1] * (f_23 - f_12);
        a[2] = down + w[2] * (f_34 - f_23 - f_53);
        a[3] = down + w[3] * (f_45 - f_34);
        a[4] = down + w[4] * (f_53 - f_45);
        a[5] = down;

        const vec b[4] = {x[0], x[3] - x[1], x[4] - x[1], x[5] - x[2]};
        m.a_23 = w[1] * dot(b[1], b[2]);
        m.inverse_23 = 1 / (m.a_2 * m.a_3 - m.a_23 * m.a_23);

        bonds impulse = {0};
        if (!first) { /* G v = 0 after half a kick */
            for (int i = 0; i < 6; i++) half[i] = v[i] + dt / 2 * a[i];
            impulse = solve(m, rates(b, half));
        }
        if (!last) impulse += lambda;
        const double kick = first || last ? dt / 2 : dt;
        for (int i = 0; i < 6; i++) v[i] += kick * a[i];
        push(v, w, b, impulse);
        if (last) break;

        for (int i = 0; i < 6; i++) x[i] += dt * v[i];
        for (int k = 0;; k++) {
            const vec now[4] = {x[0], x[3] - x[1], x[4] - x[1], x[5] - x[2]};
            bonds g;
            int held = 1;
            for (int j = 0; j < 4; j++) {
                g[j] = (dot(now[j], now[j]) - square) / 2;
                held &= fabs(g[j]) <= tolerance;
            }
            if (held) break;
            if (k == 50) return -1;
            const bonds step = solve(m, g);
            push(x, w, b, step);
            push(v, w, b, step / dt);
            lambda += step / dt;
            iterations++;
        }
    }
    pack(6, x, v, masses, q, p);
    return iterations;
}
