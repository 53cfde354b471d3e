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
#include "simd.h"

#define BLOCK_ROWS 48 /* a multiple of 2 * TILE_ROWS and of LANES, for every instruction set */
#define LOGIT_VECTORS 2
#define LOGIT_ROWS (2 * TILE_ROWS)
#define CORRELATION_BOUND 0.98f
/* Gates are held to this: a sigmoid beyond it differs from 0 or 1 by less than 1e-13. */
#define GATE_BOUND 30.0f

_Static_assert(BLOCK_ROWS % LOGIT_ROWS == 0 && BLOCK_ROWS % LANES == 0, "whole tiles");

/* As in decoding.py. Sizes in floats; units, components, logits and outputs are padded with
 * weights of zero to whole vectors or panels. */
typedef struct {
    int64_t size;       /* hidden units */
    int64_t units;      /* the same, padded to LANES */
    int64_t components; /* of the mixture */
    int64_t padded;     /* the same, padded to LANES */
    int64_t logits;     /* the same, padded to LOGIT_VECTORS * LANES */
    int64_t outputs;    /* 6 * padded, padded to PANEL_COLUMNS */
    const float *recurrent;    /* [units / LANES][units + 2][4][LANES]: gates i, f, o, new */
    const float *gates_latent; /* [Z][4 * size] */
    const float *start_latent; /* [Z][2 * size] */
    const float *logit_weight; /* [logits / (2 LANES)][units][2][LANES] */
    const float *logit_bias;   /* [logits] */
    const float *chosen_weight; /* [components][5][units] */
    const float *chosen_bias;   /* [components][5] */
    const float *head_weight;   /* [outputs / PANEL_COLUMNS][units][4][LANES]: six kinds */
    const float *head_bias;     /* [outputs], weight logits of padding far below all others */
    float log_sigma_min, log_sigma_span;
} Decoder;

typedef struct {
    const float *gates;    /* [N][4 * size] of each agent */
    const float *state;    /* [N][2 * size] */
    const float *velocity; /* [N][2] */
    const int64_t *order;  /* [R] rows as they are taken: those that share a start stand together */
    const int64_t *agent;  /* [R] */
    const int64_t *latent; /* [R] */
    int64_t horizon;
    float limit; /* on speed */
} Rollouts;

/* What a block works on. A row of `hidden` is [h; y]: hidden state and last velocity. */
typedef struct {
    long stride;
    float *hidden, *next, *cell;          /* [BLOCK_ROWS][stride] */
    float *gates;                         /* [BLOCK_ROWS starts][4 * units], panel by panel */
    float *start_hidden, *start_cell;     /* [BLOCK_ROWS starts][stride] */
    float *raw;                           /* [BLOCK_ROWS][outputs] */
    float *edges;                         /* [components][LANES] */
    float chosen[5][BLOCK_ROWS], velocity[2][BLOCK_ROWS];
    float uniform[BLOCK_ROWS], normal[2][BLOCK_ROWS];
    int64_t row[BLOCK_ROWS];
    const float *start_of[BLOCK_ROWS]; /* each row's gates */
    int64_t start_index[BLOCK_ROWS];
} Block;

static long stride_of(const Decoder *decoder) { return decoder->units + LANES; }

/* Bytes that a call needs to work in. */
KERNEL int64_t trajectron_decode_workspace(const Decoder *decoder) {
    int64_t floats = BLOCK_ROWS * (5 * stride_of(decoder) + 4 * decoder->units + decoder->outputs);
    floats += decoder->components * LANES;
    return (int64_t)sizeof(Block) + 64 + floats * (int64_t)sizeof(float);
}

static Block *block_in(void *workspace, const Decoder *decoder) {
    Block *block = workspace;
    uintptr_t after = ((uintptr_t)(block + 1) + 63) & ~(uintptr_t)63;
    float *next = (float *)after;
    long stride = stride_of(decoder);
    float **arrays[] = {&block->hidden, &block->next, &block->cell, &block->start_hidden,
                        &block->start_cell};
    for (int i = 0; i < 5; i++, next += BLOCK_ROWS * stride) *arrays[i] = next;
    block->gates = next;
    block->raw = next + BLOCK_ROWS * 4 * decoder->units;
    block->edges = block->raw + BLOCK_ROWS * decoder->outputs;
    block->stride = stride;
    return block;
}

/* The cells of LANES hidden units of one row: gates i, f, o and new as they leave the product. */
INLINE void close_cell(const float *gates, float *cell, float *next) {
    /* sigmoid(f) c + sigmoid(i) tanh(new), over a common denominator: divisions are slow */
    vf i = 1.0f + vf_exp_within(-vf_clamp(vf_load(gates), GATE_BOUND));
    vf f = 1.0f + vf_exp_within(-vf_clamp(vf_load(gates + LANES), GATE_BOUND));
    vf o = 1.0f + vf_exp_within(-vf_clamp(vf_load(gates + 2 * LANES), GATE_BOUND));
    vf new = vf_exp_within(2.0f * vf_clamp(vf_load(gates + 3 * LANES), 10.0f));
    vf below = i * (new + 1.0f);
    vf c = (vf_load(cell) * below + (new - 1.0f) * f) / (f * below);
    vf_store(cell, c);
    vf e = vf_exp_within(2.0f * vf_clamp(c, 10.0f));
    vf_store(next, (e - 1.0f) / (o * (e + 1.0f)));
}

/* One LSTM step of `rows` rows from `hidden` to `next`; gates[row] is where its own begin.
 *
 * Panel by panel: its product for all rows, then its cells, which are still in the first cache.
 */
static void step_cells(const Decoder *decoder, long rows, const float *const *gates,
                       const float *hidden, float *next, float *cell, long stride) {
    const long depth = decoder->units + 2;
    float made[BLOCK_ROWS * PANEL_COLUMNS] __attribute__((aligned(64)));
    for (long unit = 0; unit < decoder->units; unit += LANES) {
        const float *panel = decoder->recurrent + unit * PANEL_VECTORS * depth;
        for (long first = 0; first < rows; first += TILE_ROWS) {
            vf sums[TILE_ROWS * PANEL_VECTORS];
            for (int i = 0; i < TILE_ROWS * PANEL_VECTORS; i++)
                sums[i] = vf_load(gates[first + i / PANEL_VECTORS] + unit * PANEL_VECTORS +
                                  i % PANEL_VECTORS * LANES);
            gemm_tile(TILE_ROWS, PANEL_VECTORS, panel, depth, hidden + first * stride, stride, sums);
            memcpy(made + first * PANEL_COLUMNS, sums, sizeof sums);
        }
        for (long row = 0; row < rows; row++)
            close_cell(made + row * PANEL_COLUMNS, cell + row * stride + unit,
                       next + row * stride + unit);
    }
}

static long whole_tiles(long rows) { return (rows + LOGIT_ROWS - 1) / LOGIT_ROWS * LOGIT_ROWS; }

/* Gates and first states of one agent under one latent value, before any step. */
static void begin(const Decoder *decoder, const Rollouts *all, int64_t agent, int64_t latent,
                  Block *block, long at) {
    const long size = decoder->size;
    float *gates = block->gates + at * 4 * decoder->units;
    float *hidden = block->hidden + at * block->stride;
    float *cell = block->start_cell + at * block->stride;
    memset(gates, 0, (size_t)(4 * decoder->units) * sizeof(float));
    memset(hidden, 0, (size_t)block->stride * sizeof(float));
    memset(cell, 0, (size_t)block->stride * sizeof(float));
    for (int gate = 0; gate < 4; gate++) {
        const float *own = all->gates + (agent * 4 + gate) * size;
        const float *shared = decoder->gates_latent + (latent * 4 + gate) * size;
        for (long unit = 0; unit < size; unit++)
            gates[(unit / LANES * 4 + gate) * LANES + unit % LANES] = own[unit] + shared[unit];
    }
    const float *own = all->state + agent * 2 * size;
    const float *shared = decoder->start_latent + latent * 2 * size;
    for (long unit = 0; unit < size; unit++) {
        hidden[unit] = own[unit] + shared[unit];
        cell[unit] = own[size + unit] + shared[size + unit];
    }
    for (long unit = 0; unit < decoder->units; unit += LANES)
        vf_store(hidden + unit, vf_tanh(vf_load(hidden + unit)));
    memcpy(hidden + decoder->units, all->velocity + agent * 2, 2 * sizeof(float));
}

/* Makes a block of the rows at [first, first + rows) of the order: their first LSTM step is made
 * once for each start. Rows of padding repeat the last one. */
static void begin_block(const Decoder *decoder, const Rollouts *all, long first, long rows,
                        Block *block) {
    const long stride = block->stride;
    const float *gates_of[BLOCK_ROWS];
    long starts = 0;
    int64_t agent = -1, latent = -1;
    for (long i = 0; i < rows; i++) {
        const int64_t row = all->order[first + i];
        if (all->agent[row] != agent || all->latent[row] != latent) {
            agent = all->agent[row], latent = all->latent[row];
            begin(decoder, all, agent, latent, block, starts++);
        }
        block->row[i] = row;
        block->start_index[i] = starts - 1;
    }
    const long padded = whole_tiles(starts);
    for (long at = 0; at < padded; at++) {
        gates_of[at] = block->gates + (at < starts ? at : starts - 1) * 4 * decoder->units;
        if (at < starts) continue;
        memcpy(block->hidden + at * stride, block->hidden, (size_t)stride * sizeof(float));
        memcpy(block->start_cell + at * stride, block->start_cell, (size_t)stride * sizeof(float));
    }
    step_cells(decoder, padded, gates_of, block->hidden, block->start_hidden, block->start_cell,
               stride);
    const long filled = whole_tiles(rows);
    for (long i = 0; i < filled; i++) {
        const int64_t start = block->start_index[i < rows ? i : rows - 1];
        const float *velocity = all->velocity + all->agent[block->row[i < rows ? i : rows - 1]] * 2;
        block->start_of[i] = block->gates + start * 4 * decoder->units;
        memcpy(block->hidden + i * stride, block->start_hidden + start * stride,
               (size_t)decoder->units * sizeof(float));
        memcpy(block->cell + i * stride, block->start_cell + start * stride,
               (size_t)decoder->units * sizeof(float));
        block->velocity[0][i] = velocity[0];
        block->velocity[1][i] = velocity[1];
    }
    for (long i = filled; i < BLOCK_ROWS; i++) block->velocity[0][i] = block->velocity[1][i] = 0.0f;
}

/* The next step: velocities beside hidden states, then the cells. */
static void advance(const Decoder *decoder, long filled, Block *block) {
    for (long i = 0; i < filled; i++) {
        float *y = block->hidden + i * block->stride + decoder->units;
        y[0] = block->velocity[0][i];
        y[1] = block->velocity[1][i];
    }
    step_cells(decoder, filled, block->start_of, block->hidden, block->next, block->cell,
               block->stride);
    float *last = block->hidden;
    block->hidden = block->next;
    block->next = last;
}

/* Weight logits of the components: raw[row][logits]. */
static void weigh(const Decoder *decoder, long filled, Block *block) {
    const long columns = LOGIT_VECTORS * LANES;
    for (long column = 0; column < decoder->logits; column += columns) {
        const float *panel = decoder->logit_weight + column * decoder->units;
        for (long first = 0; first < filled; first += LOGIT_ROWS) {
            vf sums[LOGIT_ROWS * LOGIT_VECTORS];
#pragma GCC unroll 24
            for (int i = 0; i < LOGIT_ROWS * LOGIT_VECTORS; i++)
                sums[i] = vf_load(decoder->logit_bias + column + i % LOGIT_VECTORS * LANES);
            gemm_tile(LOGIT_ROWS, LOGIT_VECTORS, panel, decoder->units,
                      block->hidden + first * block->stride, block->stride, sums);
            for (int i = 0; i < LOGIT_ROWS * LOGIT_VECTORS; i++)
                vf_store(block->raw + (first + i / LOGIT_VECTORS) * decoder->logits + column +
                             i % LOGIT_VECTORS * LANES,
                         sums[i]);
        }
    }
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
    const float *hidden = block->hidden + row * block->stride;
    const float *weight = decoder->chosen_weight + index * 5 * decoder->units;
    vf sums[5] = {{0}};
    for (long unit = 0; unit < decoder->units; unit += LANES) {
        vf h = vf_load(hidden + unit);
#pragma GCC unroll 5
        for (int number = 0; number < 5; number++)
            sums[number] += h * vf_load(weight + number * decoder->units + unit);
    }
#pragma GCC unroll 5
    for (int number = 0; number < 5; number++)
        block->chosen[number][row] =
            vf_sum(sums[number]) + decoder->chosen_bias[index * 5 + number];
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

/* Sampled velocities [R][horizon][2] of the rows at [first, last) of the order.
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
        for (int64_t t = 0; t < horizon; t++) {
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
    for (long column = 0; column < decoder->outputs; column += PANEL_COLUMNS) {
        const float *panel = decoder->head_weight + column * decoder->units;
        for (long first = 0; first < filled; first += TILE_ROWS) {
            vf sums[TILE_ROWS * 4];
#pragma GCC unroll 24
            for (int i = 0; i < TILE_ROWS * 4; i++)
                sums[i] = vf_load(decoder->head_bias + column + i % 4 * LANES);
            gemm_tile(TILE_ROWS, 4, panel, decoder->units, block->hidden + first * block->stride,
                      block->stride, sums);
            for (int i = 0; i < TILE_ROWS * 4; i++)
                vf_store(block->raw + (first + i / 4) * decoder->outputs + column + i % 4 * LANES,
                         sums[i]);
        }
    }
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
 * velocities [R][horizon][2] and covariances of their changes [R][horizon][3].
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
        for (int64_t t = 0; t < horizon; t++) {
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
