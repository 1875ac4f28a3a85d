/* Fermi-Pasta-Ulam chain of l stiff springs, unit masses, by the impulse method (r-RESPA).

   The two half kicks of V that meet at a macro node are one kick, and so are those of W at a micro node; every micro
   step is one sweep over the chain, which the compiler vectorises. */

#include <stdlib.h>

static inline double cube(double x) { return x * x * x; }

/* Kick of both potentials at a macro node. Soft spring i pulls with (s_i - f_i - s_{i-1} - f_{i-1})^3; the walls are
   springs at zero. `pull`: room for l + 1 numbers. */
static inline void kick_both(const double *restrict s, const double *restrict f, double *restrict p_s,
                             double *restrict p_f, double *restrict pull, long l, double slow_dt, double fast_kick)
{
    pull[0] = cube(s[0] - f[0]);
    for (long i = 1; i < l; i++) pull[i] = cube(s[i] - f[i] - s[i - 1] - f[i - 1]);
    pull[l] = -cube(s[l - 1] + f[l - 1]);
    for (long i = 0; i < l; i++) {
        p_s[i] -= slow_dt * (pull[i] - pull[i + 1]);
        p_f[i] += slow_dt * (pull[i] + pull[i + 1]) - fast_kick * f[i];
    }
}

static inline void drift(double *restrict q, const double *restrict p, long l, double dt)
{
    for (long i = 0; i < l; i++) q[i] += dt * p[i];
}

/* Kick of W and drift of the fast variables. */
static inline void micro_step(double *restrict f, double *restrict p_f, long l, double dt, double fast_kick)
{
    for (long i = 0; i < l; i++) {
        p_f[i] -= fast_kick * f[i];
        f[i] += dt * p_f[i];
    }
}

/* q, p: (2 l) positions and momenta, slow before fast, in and out; num_steps >= 1 macro steps.
   Returns the Newton iterations, none, or -1 if there is no memory. */
long fpu(double *q, double *p, long l, double omega, long num_micro, double micro_dt, long num_steps)
{
    double *const s = q, *const f = q + l, *const p_s = p, *const p_f = p + l;
    const double macro_dt = num_micro * micro_dt, fast_kick = micro_dt * omega * omega;
    double *const pull = malloc((l + 1) * sizeof(double));
    if (!pull) return -1;
    for (long n = 0; n <= num_steps; n++) {
        const double weight = n == 0 || n == num_steps ? 0.5 : 1; /* half a kick at both ends of the run */
        kick_both(s, f, p_s, p_f, pull, l, weight * macro_dt, weight * fast_kick);
        if (n == num_steps) break;
        drift(s, p_s, l, macro_dt);
        drift(f, p_f, l, micro_dt);
        for (long m = 1; m < num_micro; m++) micro_step(f, p_f, l, micro_dt, fast_kick);
    }
    free(pull);
    return 0;
}
