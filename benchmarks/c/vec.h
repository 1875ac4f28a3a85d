/* Vectors of R^3 in four lanes, the last one zero. */

#include <math.h>

typedef double vec __attribute__((vector_size(32)));

static inline double dot(vec a, vec b)
{
    const vec c = a * b;
    return c[0] + c[1] + c[2];
}

/* Factor f of the force f d with which a spring of stiffness k and length l pulls along d; the square root and the
   division do not wait for each other. */
static inline double pull(vec d, double k, double l)
{
    const double square = dot(d, d);
    return k - k * l * (sqrt(square) * (1 / square));
}

/* Positions and velocities of n bodies from flat positions and momenta, and back. */
static inline void unpack(int n, const double *q, const double *p, const double *masses, vec *x, vec *v)
{
    for (int i = 0; i < n; i++) {
        x[i] = (vec){q[3 * i], q[3 * i + 1], q[3 * i + 2]};
        v[i] = (vec){p[3 * i], p[3 * i + 1], p[3 * i + 2]} / masses[i];
    }
}

static inline void pack(int n, const vec *x, const vec *v, const double *masses, double *q, double *p)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < 3; j++) {
            q[3 * i + j] = x[i][j];
            p[3 * i + j] = masses[i] * v[i][j];
        }
}
