/* Rollouts of the decoder: an LSTM, step by step, and the mixture over the next velocity.
 *
 * Rows are taken in blocks that stay in cache with the weights. A row is an agent under one
 * latent value; rows that stand together and have both in common share their first step, which
 * none of their samples has touched. The gates of one panel of hidden units are made by one tile
 * of a matrix product and used while they are in registers.
 *
 * Nothing is added up over rows and every row takes the same path through the same instructions,
 * so a row's result is the same to the last bit whatever stands beside it.
 */
#include <stdbool.h>

#include "simd.h"

#define BLOCK_ROWS 48 /* a multiple of 2 * TILE_ROWS and of LANES, for every instruction set */
#define LOGIT_VECTORS 2
#define LOGIT_ROWS (2 * TILE_ROWS)
#define CORRELATION_BOUND 0.98f
/* Gates are kept as powers of two: of i, f and o the negative over ln 2, of the new value twice
 * over ln 2. They are held to this: a sigmoid beyond it differs from 0 or 1 by less than 1e-12. */
#define GATE_BOUND 40.0f
#define LOG2_E 1.44269504f
static const float GATE_SCALE[4] = {-LOG2_E, -LOG2_E, -LOG2_E, 2.0f * LOG2_E};

_Static_assert(BLOCK_ROWS % LOGIT_ROWS == 0 && BLOCK_ROWS % LANES == 0, "whole tiles");

/* As in decoding.py. Sizes in numbers; units, components, logits and outputs are padded with
 * weights of zero to whole vectors or panels. Products with hidden states are made in integers
 * (fixed_tile): each output has the scale that makes its sum a float again. */
typedef struct {
    int64_t size;       /* hidden units */
    int64_t units;      /* the same, padded to 2 * LANES */
    int64_t components; /* of the mixture */
    int64_t padded;     /* the same, padded to LANES */
    int64_t logits;     /* the same, padded to LOGIT_VECTORS * LANES */
    int64_t outputs;    /* 6 * padded, padded to PANEL_COLUMNS */
    const int16_t *recurrent;        /* [units / LANES][units / 2][4][LANES][2]: i, f, o, new */
    const float *recurrent_scale;    /* [units / LANES][4][LANES], times GATE_SCALE */
    const float *recurrent_velocity; /* [units / LANES][2][4][LANES]: of the last velocity, too */
    const float *gates_latent;       /* [Z][units / LANES][4][LANES], too */
    const float *start_latent;       /* [Z][2][units] */
    const int16_t *logit_weight;     /* [logits / (2 LANES)][units / 2][2][LANES][2] */
    const float *logit_scale;        /* [logits] */
    const float *logit_bias;         /* [logits] */
    const int16_t *chosen_weight;    /* [components][5][units] */
    const float *chosen_scale;       /* [components][5] */
    const float *chosen_bias;        /* [components][5] */
    const int16_t *head_weight;      /* [outputs / PANEL_COLUMNS][units / 2][4][LANES][2] */
    const float *head_scale;         /* [outputs] */
    const float *head_bias;          /* [outputs], weight logits of padding far below all others */
    float log_sigma_min, log_sigma_span;
} Decoder;

typedef struct {
    const float *gates;    /* [N][4 * size] of each agent */
    const float *state;    /* [N][2 * size] */
    const float *velocity; /* [N][2] */
    const int64_t *order;  /* [R] rows as they are taken: those that share a start stand together */
    const int64_t *agent;  /* [R] */
    const int64_t *latent; /* [R] */
    const int64_t *horizons; /* [N] steps of each agent's rows */
    int64_t horizon;         /* the most of them: rows are so long in arrays */
    float limit;             /* on speed */
} Rollouts;

/* What a block works on. */
typedef struct {
    long units;
    int16_t *hidden, *next, *start_hidden; /* [BLOCK_ROWS][units] hidden states, fixed point */
    float *cell, *start_cell;              /* [BLOCK_ROWS][units] */
    float *gates;                          /* [BLOCK_ROWS starts][4 * units], panel by panel */
    float *own_gates, *own_start;          /* [4 * units], [2][units]: of one agent */
    float *raw;                            /* [BLOCK_ROWS][outputs] */
    float *edges;                          /* [components][LANES] */
    float chosen[5][BLOCK_ROWS], velocity[2][BLOCK_ROWS], start_velocity[2][BLOCK_ROWS];
    float uniform[BLOCK_ROWS], normal[2][BLOCK_ROWS];
    int64_t row[BLOCK_ROWS];
    const float *start_of[BLOCK_ROWS]; /* each row's gates */
    int64_t start_index[BLOCK_ROWS];
} Block;

/* Bytes that a call needs to work in. */
KERNEL int64_t trajectron_decode_workspace(const Decoder *decoder) {
    int64_t floats = BLOCK_ROWS * (6 * decoder->units + decoder->outputs);
    floats += 6 * decoder->units + decoder->components * LANES;
    int64_t fixed = BLOCK_ROWS * 3 * decoder->units;
    return (int64_t)sizeof(Block) + 64 + floats * (int64_t)sizeof(float) +
           fixed * (int64_t)sizeof(int16_t);
}

static Block *block_in(void *workspace, const Decoder *decoder) {
    Block *block = workspace;
    uintptr_t after = ((uintptr_t)(block + 1) + 63) & ~(uintptr_t)63;
    const long units = decoder->units;
    block->units = units;
    block->cell = (float *)after;
    block->start_cell = block->cell + BLOCK_ROWS * units;
    block->gates = block->start_cell + BLOCK_ROWS * units;
    block->own_gates = block->gates + BLOCK_ROWS * 4 * units;
    block->own_start = block->own_gates + 4 * units;
    block->raw = block->own_start + 2 * units;
    block->edges = block->raw + BLOCK_ROWS * decoder->outputs;
    block->hidden = (int16_t *)(block->edges + decoder->components * LANES);
    block->next = block->hidden + BLOCK_ROWS * units;
    block->start_hidden = block->next + BLOCK_ROWS * units;
    return block;
}

/* The cells of LANES hidden units of one row, from gates i, f, o and new as powers of two: the new
 * hidden states. */
INLINE vf close_cell(const float *gates, float *cell) {
    /* sigmoid(f) c + sigmoid(i) tanh(new), over a common denominator: divisions are slow */
    vf i = 1.0f + vf_exp2_coarse(vf_clamp(vf_load(gates), GATE_BOUND));
    vf f = 1.0f + vf_exp2_coarse(vf_clamp(vf_load(gates + LANES), GATE_BOUND));
    vf o = 1.0f + vf_exp2_coarse(vf_clamp(vf_load(gates + 2 * LANES), GATE_BOUND));
    vf new = vf_exp2_coarse(vf_clamp(vf_load(gates + 3 * LANES), GATE_BOUND));
    vf below = i * (new + 1.0f);
    vf c = (vf_load(cell) * below + (new - 1.0f) * f) / (f * below);
    vf_store(cell, c);
    vf e = vf_exp2_coarse(vf_clamp(c * (2.0f * LOG2_E), GATE_BOUND));
    return (e - 1.0f) / (o * (e + 1.0f));
}

/* One LSTM step of `rows` rows from `hidden` to `next`; gates[row] is where its own begin.
 *
 * Panel by panel: its product for all rows, then its cells, which are still in the first cache.
 */
static void step_cells(const Decoder *decoder, long rows, const float *const *gates,
                       const float velocity[2][BLOCK_ROWS], const int16_t *hidden, int16_t *next,
                       float *cell) {
    const long units = decoder->units;
    float made[BLOCK_ROWS * PANEL_COLUMNS] __attribute__((aligned(64)));
    for (long unit = 0; unit < units; unit += LANES) {
        const long column = unit * PANEL_VECTORS;
        const int16_t *panel = decoder->recurrent + column * units;
        const float *scale = decoder->recurrent_scale + column;
        const float *by_x = decoder->recurrent_velocity + 2 * column, *by_y = by_x + PANEL_COLUMNS;
        for (long first = 0; first < rows; first += TILE_ROWS) {
            vi sums[TILE_ROWS * PANEL_VECTORS] = {{0}};
            fixed_tile(TILE_ROWS, PANEL_VECTORS, panel, units / 2, hidden + first * units, units,
                       sums);
#pragma GCC unroll 24
            for (int i = 0; i < TILE_ROWS * PANEL_VECTORS; i++) {
                const long row = first + i / PANEL_VECTORS;
                const int at = i % PANEL_VECTORS * LANES;
                vf gate = vf_load(gates[row] + column + at) + velocity[0][row] * vf_load(by_x + at) +
                          velocity[1][row] * vf_load(by_y + at);
                vf_store(made + first * PANEL_COLUMNS + i * LANES,
                         gate + vf_of(sums[i]) * vf_load(scale + at));
            }
        }
        for (long row = 0; row < rows; row++)
            store_fixed(next + row * units + unit,
                        close_cell(made + row * PANEL_COLUMNS, cell + row * units + unit));
    }
}

static long whole_tiles(long rows) { return (rows + LOGIT_ROWS - 1) / LOGIT_ROWS * LOGIT_ROWS; }

/* What all rows of an agent begin with, in the order of panels. */
static void read_agent(const Decoder *decoder, const Rollouts *all, int64_t agent, Block *block) {
    const long size = decoder->size, units = decoder->units;
    memset(block->own_gates, 0, (size_t)(6 * units) * sizeof(float)); /* own_start is behind */
    for (int gate = 0; gate < 4; gate++) {
        const float *from = all->gates + (agent * 4 + gate) * size;
        for (long unit = 0; unit < size; unit++)
            block->own_gates[(unit / LANES * 4 + gate) * LANES + unit % LANES] =
                GATE_SCALE[gate] * from[unit];
    }
    for (int half = 0; half < 2; half++)
        memcpy(block->own_start + half * units, all->state + (agent * 2 + half) * size,
               (size_t)size * sizeof(float));
}

/* Gates, first states and velocity of an agent that was read, under one latent value. */
static void begin(const Decoder *decoder, const float *velocity, int64_t latent, Block *block,
                  long at) {
    const long units = decoder->units;
    const float *gates = decoder->gates_latent + latent * 4 * units;
    const float *start = decoder->start_latent + latent * 2 * units;
    vf fault = {0};
    for (long i = 0; i < 4 * units; i += LANES) {
        vf gate = vf_load(block->own_gates + i) + vf_load(gates + i);
        vf_store(block->gates + at * 4 * units + i, gate);
        fault += gate * 0.0f;
    }
    for (long unit = 0; unit < units; unit += LANES) {
        vf hidden = vf_load(block->own_start + unit) + vf_load(start + unit);
        vf cell = vf_load(block->own_start + units + unit) + vf_load(start + units + unit);
        store_fixed(block->hidden + at * units + unit, vf_tanh(hidden));
        vf_store(block->start_cell + at * units + unit, cell);
        fault += (hidden + cell) * 0.0f;
    }
    /* An integer cannot be NaN: what is not finite shows in the velocities instead. */
    for (int axis = 0; axis < 2; axis++)
        block->start_velocity[axis][at] = velocity[axis] + vf_sum(fault);
}

/* Makes a block of the rows at [first, first + rows) of the order: their first LSTM step is made
 * once for each start. Rows of padding repeat others. */
static void begin_block(const Decoder *decoder, const Rollouts *all, long first, long rows,
                        Block *block) {
    const long units = block->units;
    const float *gates_of[BLOCK_ROWS];
    long starts = 0;
    int64_t agent = -1, latent = -1;
    for (long i = 0; i < rows; i++) {
        const int64_t row = all->order[first + i];
        const bool another = all->agent[row] != agent;
        if (another) read_agent(decoder, all, agent = all->agent[row], block);
        if (another || all->latent[row] != latent)
            begin(decoder, all->velocity + agent * 2, latent = all->latent[row], block, starts++);
        block->row[i] = row;
        block->start_index[i] = starts - 1;
    }
    const long padded = whole_tiles(starts);
    for (long at = 0; at < padded; at++) {
        gates_of[at] = block->gates + (at < starts ? at : starts - 1) * 4 * units;
        if (at < starts) continue;
        memcpy(block->hidden + at * units, block->hidden, (size_t)units * sizeof(int16_t));
        memcpy(block->start_cell + at * units, block->start_cell, (size_t)units * sizeof(float));
        for (int axis = 0; axis < 2; axis++)
            block->start_velocity[axis][at] = block->start_velocity[axis][0];
    }
    step_cells(decoder, padded, gates_of, block->start_velocity, block->hidden,
               block->start_hidden, block->start_cell);
    const long filled = whole_tiles(rows);
    for (long i = 0; i < filled; i++) {
        const int64_t start = block->start_index[i < rows ? i : rows - 1];
        block->start_of[i] = block->gates + start * 4 * units;
        memcpy(block->hidden + i * units, block->start_hidden + start * units,
               (size_t)units * sizeof(int16_t));
        memcpy(block->cell + i * units, block->start_cell + start * units,
               (size_t)units * sizeof(float));
        for (int axis = 0; axis < 2; axis++)
            block->velocity[axis][i] = block->start_velocity[axis][start];
    }
    for (long i = filled; i < BLOCK_ROWS; i++) block->velocity[0][i] = block->velocity[1][i] = 0.0f;
}

/* The most steps that a row of the block has. */
static int64_t steps_of(const Rollouts *all, long rows, const Block *block) {
    int64_t most = 0;
    for (long i = 0; i < rows; i++) {
        const int64_t steps = all->horizons[all->agent[block->row[i]]];
        most = steps > most ? steps : most;
    }
    return most;
}

/* The next step of all rows. */
static void advance(const Decoder *decoder, long filled, Block *block) {
    step_cells(decoder, filled, block->start_of, block->velocity, block->hidden, block->next,
               block->cell);
    int16_t *last = block->hidden;
    block->hidden = block->next;
    block->next = last;
}

/* Linear outputs of the hidden states: raw[row][columns], panel by panel of `vectors` vectors. */
INLINE void read_hidden(const int rows, const int vectors, const int16_t *weight,
                        const float *scale, const float *bias, long columns, long filled,
                        Block *block) {
    const long units = block->units;
    for (long column = 0; column < columns; column += vectors * LANES) {
        const int16_t *panel = weight + column * units;
        for (long first = 0; first < filled; first += rows) {
            vi sums[TILE_ROWS * PANEL_VECTORS] = {{0}};
            fixed_tile(rows, vectors, panel, units / 2, block->hidden + first * units, units, sums);
            for (int i = 0; i < rows * vectors; i++) {
                const long at = column + i % vectors * LANES;
                vf_store(block->raw + (first + i / vectors) * columns + at,
                         vf_of(sums[i]) * vf_load(scale + at) + vf_load(bias + at));
            }
        }
    }
}

/* Weight logits of the components: raw[row][logits]. */
static void weigh(const Decoder *decoder, long filled, Block *block) {
    read_hidden(LOGIT_ROWS, LOGIT_VECTORS, decoder->logit_weight, decoder->logit_scale,
                decoder->logit_bias, decoder->logits, filled, block);
}

/* The component of each of LANES rows at which the cumulated weights pass its uniform number. */
static void choose(const Decoder *decoder, const float *raw, const float *uniform, float *edges,
                   int32_t *index) {
    const long components = decoder->components;
    vf largest = vf_all(-INFINITY), total = vf_all(0.0f);
    for (long m = 0; m < components; m++) {
        float *lane_logits = edges + m * LANES;
        for (int lane = 0; lane < LANES; lane++) lane_logits[lane] = raw[lane * decoder->logits + m];
        largest = vf_max(largest, vf_load(lane_logits));
    }
    for (long m = 0; m < components; m++) {
        total += vf_exp(vf_load(edges + m * LANES) - largest);
        vf_store(edges + m * LANES, total);
    }
    vf bound = vf_load(uniform) * total;
    vi below = {0};
    for (long m = 0; m < components - 1; m++) below -= vf_load(edges + m * LANES) <= bound;
    memcpy(index, &below, sizeof below);
}

/* The five numbers of a row's component: mean change x, y, log scale x, y, correlation. */
static void read_component(const Decoder *decoder, long row, int32_t index, Block *block) {
    const long units = block->units;
    const int16_t *hidden = block->hidden + row * units;
    const int16_t *weight = decoder->chosen_weight + index * 5 * units;
    vi sums[5] = {{0}};
    for (long unit = 0; unit < units; unit += 2 * LANES) {
        vi h, w;
        memcpy(&h, hidden + unit, sizeof h);
#pragma GCC unroll 5
        for (int number = 0; number < 5; number++) {
            memcpy(&w, weight + number * units + unit, sizeof w);
            sums[number] += vi_dot_pairs(h, w);
        }
    }
#pragma GCC unroll 5
    for (int number = 0; number < 5; number++)
        block->chosen[number][row] =
            (float)vi_sum(sums[number]) * decoder->chosen_scale[index * 5 + number] +
            decoder->chosen_bias[index * 5 + number];
}

INLINE vf scale_of(const Decoder *decoder, vf raw) {
    return vf_exp(decoder->log_sigma_min + decoder->log_sigma_span * vf_sigmoid(raw - 1.0f));
}

/* x, y scaled down to at most the limit */
INLINE void limit_speed(vf *x, vf *y, float limit) {
    vf speed = vf_max(vf_all(1e-9f), vf_sqrt(*x * *x + *y * *y));
    vf factor = vf_min(vf_all(1.0f), limit / speed);
    *x *= factor;
    *y *= factor;
}

static void draw(const Decoder *decoder, float limit, Block *block, long first) {
    vf scale_x = scale_of(decoder, vf_load(block->chosen[2] + first));
    vf scale_y = scale_of(decoder, vf_load(block->chosen[3] + first));
    vf rho = CORRELATION_BOUND * vf_tanh(vf_load(block->chosen[4] + first));
    vf one = vf_load(block->normal[0] + first), other = vf_load(block->normal[1] + first);
    vf mixed = rho * one + vf_sqrt(1.0f - rho * rho) * other;
    vf x = vf_load(block->velocity[0] + first) + vf_load(block->chosen[0] + first) + scale_x * one;
    vf y = vf_load(block->velocity[1] + first) + vf_load(block->chosen[1] + first) + scale_y * mixed;
    limit_speed(&x, &y, limit);
    vf_store(block->velocity[0] + first, x);
    vf_store(block->velocity[1] + first, y);
}

/* Sampled velocities [R][horizon][2] of the rows at [first, last) of the order; what is behind a
 * row's own steps is either left as it was or goes on.
 *
 * uniform: [R][horizon] chooses components; normal: [R][horizon][2]; workspace: of
 * trajectron_decode_workspace bytes, aligned to 64, to this call alone.
 */
KERNEL void trajectron_decode_sample(const Decoder *decoder, const Rollouts *all,
                                     const float *uniform, const float *normal, float *velocity,
                                     int64_t first, int64_t last, void *workspace) {
    Block *block = block_in(workspace, decoder);
    const int64_t horizon = all->horizon;
    for (; first < last; first += BLOCK_ROWS) {
        const long rows = last - first < BLOCK_ROWS ? last - first : BLOCK_ROWS;
        const long filled = whole_tiles(rows);
        begin_block(decoder, all, first, rows, block);
        const int64_t steps = steps_of(all, rows, block);
        for (int64_t t = 0; t < steps; t++) {
            if (t > 0) advance(decoder, filled, block);
            weigh(decoder, filled, block);
            for (long i = 0; i < rows; i++) {
                const int64_t at = block->row[i] * horizon + t;
                block->uniform[i] = uniform[at];
                block->normal[0][i] = normal[at * 2];
                block->normal[1][i] = normal[at * 2 + 1];
            }
            for (long i = 0; i < rows; i += LANES) {
                int32_t index[LANES];
                choose(decoder, block->raw + i * decoder->logits, block->uniform + i, block->edges,
                       index);
                for (long row = i; row < i + LANES && row < rows; row++)
                    read_component(decoder, row, index[row - i], block);
                draw(decoder, all->limit, block, i);
            }
            for (long i = 0; i < rows; i++) {
                float *to = velocity + (block->row[i] * horizon + t) * 2;
                to[0] = block->velocity[0][i];
                to[1] = block->velocity[1][i];
            }
        }
    }
}

/* All outputs of the head: raw[row][outputs]. */
static void read_mixture(const Decoder *decoder, long filled, Block *block) {
    read_hidden(TILE_ROWS, PANEL_VECTORS, decoder->head_weight, decoder->head_scale,
                decoder->head_bias, decoder->outputs, filled, block);
}

/* The mixture of one row merged to one Gaussian: mean change [2], covariance [3].
 *
 * raw: logits, mean x, mean y, log scale x, log scale y, correlation, `padded` of each.
 */
static void merge(const Decoder *decoder, const float *raw, float *mean, float *covariance) {
    const long n = decoder->padded;
    vf top = vf_load(raw);
    for (long m = LANES; m < n; m += LANES) top = vf_max(top, vf_load(raw + m));
    const float largest = vf_largest(top);
    vf total = {0}, x = {0}, y = {0}, xx = {0}, xy = {0}, yy = {0};
    for (long m = 0; m < n; m += LANES) {
        vf weight = vf_exp(vf_load(raw + m) - largest);
        total += weight;
        x += weight * vf_load(raw + n + m);
        y += weight * vf_load(raw + 2 * n + m);
    }
    const float share = 1.0f / vf_sum(total);
    mean[0] = vf_sum(x) * share;
    mean[1] = vf_sum(y) * share;
    for (long m = 0; m < n; m += LANES) {
        vf weight = vf_exp(vf_load(raw + m) - largest);
        vf off_x = vf_load(raw + n + m) - mean[0], off_y = vf_load(raw + 2 * n + m) - mean[1];
        vf scale_x = scale_of(decoder, vf_load(raw + 3 * n + m));
        vf scale_y = scale_of(decoder, vf_load(raw + 4 * n + m));
        vf rho = CORRELATION_BOUND * vf_tanh(vf_load(raw + 5 * n + m));
        xx += weight * (scale_x * scale_x + off_x * off_x);
        xy += weight * (rho * scale_x * scale_y + off_x * off_y);
        yy += weight * (scale_y * scale_y + off_y * off_y);
    }
    covariance[0] = vf_sum(xx) * share;
    covariance[1] = vf_sum(xy) * share;
    covariance[2] = vf_sum(yy) * share;
}

/* Rollouts on the mixture's mean, limited in speed, of the rows at [first, last) of the order:
 * velocities [R][horizon][2] and covariances of their changes [R][horizon][3], up to each
 * row's own steps as above.
 */
KERNEL void trajectron_decode_moments(const Decoder *decoder, const Rollouts *all, float *velocity,
                                      float *covariance, int64_t first, int64_t last,
                                      void *workspace) {
    Block *block = block_in(workspace, decoder);
    const int64_t horizon = all->horizon;
    for (; first < last; first += BLOCK_ROWS) {
        const long rows = last - first < BLOCK_ROWS ? last - first : BLOCK_ROWS;
        const long filled = whole_tiles(rows);
        begin_block(decoder, all, first, rows, block);
        const int64_t steps = steps_of(all, rows, block);
        for (int64_t t = 0; t < steps; t++) {
            if (t > 0) advance(decoder, filled, block);
            read_mixture(decoder, filled, block);
            for (long i = 0; i < rows; i++) {
                float change[2];
                merge(decoder, block->raw + i * decoder->outputs, change,
                      covariance + (block->row[i] * horizon + t) * 3);
                block->velocity[0][i] += change[0];
                block->velocity[1][i] += change[1];
            }
            for (long i = 0; i < rows; i += LANES) {
                vf x = vf_load(block->velocity[0] + i), y = vf_load(block->velocity[1] + i);
                limit_speed(&x, &y, all->limit);
                vf_store(block->velocity[0] + i, x);
                vf_store(block->velocity[1] + i, y);
            }
            for (long i = 0; i < rows; i++) {
                float *to = velocity + (block->row[i] * horizon + t) * 2;
                to[0] = block->velocity[0][i];
                to[1] = block->velocity[1][i];
            }
        }
    }
}

/* The products of `steps` steps of `rows` rollouts, and nothing else: what decoding cannot do
 * without. Of whatever is in the workspace; benchmarks compare with it.
 */
KERNEL void trajectron_decode_products(const Decoder *decoder, int64_t rows, int64_t steps,
                                       void *workspace) {
    Block *block = block_in(workspace, decoder);
    const long units = decoder->units;
    memset(block->hidden, 0, (size_t)(BLOCK_ROWS * units) * sizeof(int16_t));
    for (; rows > 0; rows -= BLOCK_ROWS) {
        const long filled = whole_tiles(rows < BLOCK_ROWS ? rows : BLOCK_ROWS);
        for (int64_t t = 0; t < steps; t++) {
            for (long unit = 0; unit < units; unit += LANES) {
                const int16_t *panel = decoder->recurrent + unit * PANEL_VECTORS * units;
                for (long first = 0; first < filled; first += TILE_ROWS) {
                    vi sums[TILE_ROWS * PANEL_VECTORS] = {{0}};
                    fixed_tile(TILE_ROWS, PANEL_VECTORS, panel, units / 2,
                               block->hidden + first * units, units, sums);
                    memcpy(block->gates + first * 4 * units, sums, sizeof sums);
                }
            }
            read_mixture(decoder, filled, block);
        }
    }
}
