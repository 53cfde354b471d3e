/* Modes in position space: what rollouts on the mixture's mean say of velocities, added up to
 * positions, corrected and turned into the world's axes. As modes.py has it.
 *
 * Vectors go along time: every step of a mode is its own lane.
 */
#include <stdbool.h>

#include "simd.h"

/* As in modes.py and dispersion.py. */
#define VARIANCE_FLOOR 1e-6f
#define LARGEST_CONTRAST 20.0f

/* As in placing.py. */
typedef struct {
    int64_t modes, horizon;
    int64_t steps;           /* the horizon, padded to LANES */
    const float *velocity;   /* [R][horizon][2] in units of the speed scale */
    const float *increment;  /* [R][horizon][3] covariances of its changes */
    const int64_t *row;      /* [N][modes] */
    const float *weight;     /* [N][modes] probabilities */
    const float *axis;       /* [N][2] the first axis of the agent's frame */
    const bool *turned;      /* [N] whether any direction is as likely as any other */
    const float *dispersion; /* [2][steps] factor and contrast; NULL leaves all as it is */
    float unit;              /* metres of one unit of velocity in a step */
} Modes;

/* Floats that a call needs to work in. */
KERNEL int64_t trajectron_place_workspace(const Modes *modes) {
    return (modes->modes * 6 + 1) * modes->steps;
}

/* Positions and their covariances of one mode: x, y, xx, xy, yy of each step, behind each other.
 *
 * The increment at step r counts t - r + 1 times in the position at t (integration.walk).
 */
static void add_up(const Modes *all, int64_t row, float *out) {
    const float *velocity = all->velocity + row * all->horizon * 2;
    const float *increment = all->increment + row * all->horizon * 3;
    const long steps = all->steps;
    const float unit = all->unit, area = unit * unit;
    float at[2] = {0}, once[3] = {0}, twice[3] = {0}, thrice[3] = {0};
    for (long t = 0; t < steps; t++) {
        const long known = t < all->horizon ? t : all->horizon - 1;
        for (int i = 0; i < 2; i++) {
            at[i] += velocity[known * 2 + i];
            out[i * steps + t] = at[i] * unit;
        }
        for (int i = 0; i < 3; i++) {
            once[i] += increment[known * 3 + i];
            twice[i] += once[i];
            thrice[i] += twice[i];
            out[(2 + i) * steps + t] =
                (2.0f * thrice[i] - twice[i]) * area + (i == 1 ? 0.0f : VARIANCE_FLOOR);
        }
    }
}

/* The logarithm of each mode's spread at each step, behind its covariances, and their mean. */
static void measure(const Modes *all, const float *weight, float *modes, float *mean) {
    const long steps = all->steps;
    for (long t = 0; t < steps; t += LANES) {
        vf sum = {0};
        for (long mode = 0; mode < all->modes; mode++) {
            float *own = modes + mode * 6 * steps + t;
            vf xx = vf_load(own + 2 * steps), xy = vf_load(own + 3 * steps);
            vf spread = 0.25f * vf_log(xx * vf_load(own + 4 * steps) - xy * xy);
            vf_store(own + 5 * steps, spread);
            sum += weight[mode] * spread;
        }
        vf_store(mean + t, sum);
    }
}

/* Scales one mode's covariances at the steps from t on (dispersion.disperse). */
INLINE void disperse(const Modes *all, const float *mean, float *mode, long t) {
    const long steps = all->steps;
    vf factor = vf_load(all->dispersion + t), contrast = vf_load(all->dispersion + steps + t);
    vf wider = vf_exp((vf_load(mode + 5 * steps + t) - vf_load(mean + t)) * contrast);
    wider = vf_min(vf_all(LARGEST_CONTRAST), vf_max(vf_all(1.0f / LARGEST_CONTRAST), wider));
    factor *= wider;
    for (int i = 2; i < 5; i++)
        vf_store(mode + i * steps + t, vf_load(mode + i * steps + t) * factor * factor);
}

/* From the agent's frame to the world's axes. */
INLINE void turn(const Modes *all, const float *axis, bool turned, float *mode, long t) {
    const long steps = all->steps;
    vf x = vf_load(mode + t), y = vf_load(mode + steps + t);
    vf xx = vf_load(mode + 2 * steps + t), xy = vf_load(mode + 3 * steps + t);
    vf yy = vf_load(mode + 4 * steps + t);
    const float c = axis[0], s = axis[1];
    vf made[5] = {
        c * x - s * y,
        s * x + c * y,
        c * c * xx - 2.0f * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0f * c * s * xy + c * c * yy,
    };
    if (turned) {
        /* turned by a uniform angle: the mean is the origin */
        vf square = 0.5f * (x * x + y * y + xx + yy);
        made[0] = made[1] = made[3] = (vf){0};
        made[2] = made[4] = square;
    }
    for (int i = 0; i < 5; i++) vf_store(mode + i * steps + t, made[i]);
}

/* Means [N][modes][horizon][2] and covariances [N][modes][horizon][3] of the agents at
 * [first, last); workspace: of trajectron_place_workspace floats. */
KERNEL void trajectron_place_modes(const Modes *all, float *means, float *covariances,
                                   int64_t first, int64_t last, float *workspace) {
    const long steps = all->steps;
    float *mean = workspace + all->modes * 6 * steps;
    for (int64_t agent = first; agent < last; agent++) {
        for (long mode = 0; mode < all->modes; mode++)
            add_up(all, all->row[agent * all->modes + mode], workspace + mode * 6 * steps);
        if (all->dispersion) measure(all, all->weight + agent * all->modes, workspace, mean);
        for (long mode = 0; mode < all->modes; mode++) {
            float *own = workspace + mode * 6 * steps;
            for (long t = 0; t < steps; t += LANES) {
                if (all->dispersion) disperse(all, mean, own, t);
                turn(all, all->axis + agent * 2, all->turned[agent], own, t);
            }
            const int64_t at = (agent * all->modes + mode) * all->horizon;
            for (long t = 0; t < all->horizon; t++) {
                for (int i = 0; i < 2; i++) means[(at + t) * 2 + i] = own[i * steps + t];
                for (int i = 0; i < 3; i++)
                    covariances[(at + t) * 3 + i] = own[(2 + i) * steps + t];
            }
        }
    }
}
