/* One frame into each of many scenes: motion, edges, ages, and a cell of every encoder.
 *
 * What features.py, graph.py and encoders.py say in torch, row by row on packed scenes
 * (packed.py): the same order of agents, the same formulas. Scenes lie one after the other and
 * never influence each other.
 */
#include "simd.h"

#include <stdlib.h>

#define NODE_FEATURES 8
#define NEIGHBOUR_FEATURES 10
#define GATE_VECTORS 8 /* sums that hide the time of an addition, in registers */
#define FEW 48 /* below that many agents all pairs are looked at */

/* What comes before the numbers whose count depends on the model; packed.py has the same. */
typedef struct {
    double x, y, last_seen_s;
    int32_t type, observations, heading_known, unused;
    float velocity[2], acceleration[2], smoothed[2], heading[2], turn[2];
} Node;

typedef struct {
    int32_t receiver, sender, age, gone;
} Edge;

/* Sizes and choices of a model; stepping.py has the same. */
typedef struct {
    int64_t kinds, history, edge, record_bytes, addition_steps, removal_steps;
    double dt_s, smoothing, min_speed_mps, reach_m;
    const double *radii;       /* [kinds][kinds] */
    const float *speed_scale;  /* [kinds] */
    const float *addition;     /* [addition_steps], at age 1, 2, ... */
    const float *removal;      /* [removal_steps], at 1, 2, ... steps since */
    const float *node_weight;  /* [kinds][NODE_FEATURES + history][4 history] */
    const float *node_bias;    /* [kinds][4 history] */
    const float *edge_weight;  /* [kinds][kinds][NODE_FEATURES + NEIGHBOUR_FEATURES + edge][4 edge] */
    const float *edge_bias;    /* [kinds][kinds][4 edge] */
} Model;

/* An agent with its cell, for agents sorted by cell. */
typedef struct {
    int64_t column, line;
    int32_t row;
} Placed;

typedef struct {
    Placed *placed;    /* [nodes of the largest scene] */
    int32_t *near;     /* [nodes of the largest scene] */
    uint8_t *marked;   /* [nodes of the largest scene], zero between uses */
    uint8_t *present;  /* [nodes of the largest scene] */
    double *around;    /* [nodes of the largest scene][kinds][NEIGHBOUR_FEATURES] */
    double *influence; /* [nodes of the largest scene][kinds] */
} Scratch;

INLINE Node *node_at(const Model *model, char *nodes, int64_t row) {
    return (Node *)(nodes + row * model->record_bytes);
}

INLINE float *numbers_of(Node *node) { return (float *)(node + 1); }

INLINE void to_frame(const float *heading, float x, float y, float *out) {
    out[0] = heading[0] * x + heading[1] * y;
    out[1] = heading[0] * y - heading[1] * x;
}

/* Motion after one more observation: features.advance. */
static void advance(const Model *model, Node *node, double x, double y, double time_s) {
    int32_t seen = node->observations;
    double passed = seen >= 1 ? time_s - node->last_seen_s : model->dt_s;
    float elapsed = (float)(passed < 1e-3 ? 1e-3 : passed);
    float velocity[2] = {0.0f, 0.0f}, weight = (float)model->smoothing;
    if (seen >= 1) {
        velocity[0] = (float)(x - node->x) / elapsed;
        velocity[1] = (float)(y - node->y) / elapsed;
    }
    for (int axis = 0; axis < 2; axis++) {
        float last = node->velocity[axis];
        node->acceleration[axis] = seen >= 2 ? (velocity[axis] - last) / elapsed : 0.0f;
        float mean = weight * velocity[axis] + (1.0f - weight) * node->smoothed[axis];
        node->smoothed[axis] = seen >= 2 ? mean : velocity[axis];
        node->velocity[axis] = velocity[axis];
    }
    float across = node->smoothed[0], along = node->smoothed[1];
    float speed = sqrtf(across * across + along * along);
    float before[2] = {node->heading[0], node->heading[1]};
    int moves = speed > (float)model->min_speed_mps;
    if (moves) {
        float least = speed < 1e-9f ? 1e-9f : speed;
        node->heading[0] = across / least;
        node->heading[1] = along / least;
    }
    if (node->heading_known) to_frame(before, node->heading[0], node->heading[1], node->turn);
    node->heading_known = node->heading_known || moves;
    node->x = x;
    node->y = y;
    node->last_seen_s = time_s;
    node->observations = seen + 1;
}

/* By cell, then row; rows of one cell stay in their order. */
static int by_cell(const void *left, const void *right) {
    const Placed *a = left, *b = right;
    if (a->column != b->column) return a->column < b->column ? -1 : 1;
    if (a->line != b->line) return a->line < b->line ? -1 : 1;
    return (a->row > b->row) - (a->row < b->row);
}

/* Cells further out than this are one: what is in them is told apart by distance. */
static int64_t cell_of(double place, double origin, double size) {
    double cell = floor((place - origin) / size);
    return (int64_t)(cell < 1e15 ? cell : 1e15);
}

/* The first of the agents sorted by cell that does not come before (column, line). */
static int64_t first_in(const Placed *placed, int64_t count, int64_t column, int64_t line) {
    int64_t low = 0, high = count;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        const Placed *at = &placed[middle];
        if (at->column < column || (at->column == column && at->line < line)) low = middle + 1;
        else high = middle;
    }
    return low;
}

static int64_t sort_into_cells(
    const Model *model, char *nodes, int64_t count, Scratch *scratch, double origin[2]) {
    int64_t placed = 0;
    origin[0] = origin[1] = INFINITY;
    for (int64_t row = 0; row < count; row++) {
        if (!scratch->present[row]) continue;
        const Node *node = node_at(model, nodes, row);
        origin[0] = fmin(origin[0], node->x);
        origin[1] = fmin(origin[1], node->y);
    }
    for (int64_t row = 0; row < count; row++) {
        if (!scratch->present[row]) continue;
        const Node *node = node_at(model, nodes, row);
        scratch->placed[placed++] = (Placed){
            cell_of(node->x, origin[0], model->reach_m),
            cell_of(node->y, origin[1], model->reach_m), (int32_t)row};
    }
    qsort(scratch->placed, (size_t)placed, sizeof(Placed), by_cell);
    return placed;
}

INLINE int joined(const Model *model, const Node *a, const Node *b) {
    double x = a->x - b->x, y = a->y - b->y;
    double radius = model->radii[a->type * model->kinds + b->type];
    return x * x + y * y <= radius * radius;
}

/* The rows that a node is joined to, rising; how many. `placed` < 0: look at everyone. */
static int64_t neighbours_of(
    const Model *model, char *nodes, int64_t count, int64_t row, int64_t placed,
    const double origin[2], Scratch *scratch) {
    const Node *node = node_at(model, nodes, row);
    int64_t found = 0;
    if (placed < 0) {
        for (int64_t other = 0; other < count; other++)
            if (other != row && scratch->present[other] &&
                joined(model, node, node_at(model, nodes, other)))
                scratch->near[found++] = (int32_t)other;
        return found;
    }
    int64_t column = cell_of(node->x, origin[0], model->reach_m);
    int64_t line = cell_of(node->y, origin[1], model->reach_m);
    for (int64_t beside = column - 1; beside <= column + 1; beside++) {
        int64_t at = first_in(scratch->placed, placed, beside, line - 1);
        for (; at < placed; at++) {
            const Placed *other = &scratch->placed[at];
            if (other->column != beside || other->line > line + 1) break;
            if (other->row != row && joined(model, node, node_at(model, nodes, other->row)))
                scratch->near[found++] = other->row;
        }
    }
    if (found <= FEW) {
        for (int64_t i = 1; i < found; i++) {
            int32_t moved = scratch->near[i];
            int64_t to = i;
            for (; to > 0 && scratch->near[to - 1] > moved; to--)
                scratch->near[to] = scratch->near[to - 1];
            scratch->near[to] = moved;
        }
        return found;
    }
    for (int64_t i = 0; i < found; i++) scratch->marked[scratch->near[i]] = 1;
    int64_t kept = 0;
    for (int64_t other = 0; other < count; other++) {
        if (!scratch->marked[other]) continue;
        scratch->marked[other] = 0;
        scratch->near[kept++] = (int32_t)other;
    }
    return found;
}

/* M of an edge: graph.modulation. */
INLINE double modulation(const Model *model, const Edge *edge) {
    if (edge->age <= 0) return 0.0;
    int64_t age = edge->age < model->addition_steps ? edge->age : model->addition_steps;
    float level = model->addition[age - 1];
    if (edge->gone == 0) return level;
    return edge->gone <= model->removal_steps ? level * model->removal[edge->gone - 1] : 0.0f;
}

/* What a node sees of a neighbour, added to its sums: features.neighbours. */
static void look(
    const Model *model, const Node *node, const Node *other, double *sums) {
    float offset[2] = {(float)(other->x - node->x), (float)(other->y - node->y)};
    float radius = (float)model->radii[node->type * model->kinds + other->type];
    float distance = sqrtf(offset[0] * offset[0] + offset[1] * offset[1]);
    float closeness = 1.0f - distance / radius;
    closeness = closeness > 0.0f ? closeness : 0.0f;
    float seen[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    if (node->heading_known) {
        float scale = model->speed_scale[node->type];
        to_frame(node->heading, offset[0], offset[1], seen);
        seen[0] /= radius;
        seen[1] /= radius;
        if (node->observations >= 2 && other->observations >= 2)
            to_frame(node->heading, (other->velocity[0] - node->velocity[0]) / scale,
                     (other->velocity[1] - node->velocity[1]) / scale, seen + 2);
    }
    for (int i = 0; i < 4; i++) {
        sums[i] += seen[i];
        sums[4 + i] += seen[i] * closeness;
    }
    sums[8] += 1.0;
    sums[9] += closeness;
}

static void features_of(const Model *model, const Node *node, float *out) {
    float scale = model->speed_scale[node->type];
    memset(out, 0, NODE_FEATURES * sizeof *out);
    if (node->heading_known) {
        to_frame(node->heading, node->velocity[0], node->velocity[1], out);
        to_frame(node->heading, node->acceleration[0], node->acceleration[1], out + 2);
        for (int i = 0; i < 2; i++) {
            out[i] /= scale;
            out[2 + i] *= (float)model->dt_s / scale;
        }
        out[4] = node->turn[0] - 1.0f;
        out[5] = node->turn[1];
    }
    out[6] = node->observations >= 2;
    out[7] = node->heading_known != 0;
}

/* gates += [in; hidden] times columns of weights, `vectors` of them, kept in registers. */
INLINE void add_products(const int vectors, int64_t size, int64_t depth, const float *weight,
                         const float *in, const float *hidden, float *gates) {
    vf held[GATE_VECTORS];
    int64_t width = 4 * size;
#pragma GCC unroll 8
    for (int v = 0; v < vectors; v++) held[v] = vf_load(gates + v * LANES);
    for (int64_t k = 0; k < depth + size; k++, weight += width) {
        vf value = vf_all(k < depth ? in[k] : hidden[k - depth]);
#pragma GCC unroll 8
        for (int v = 0; v < vectors; v++) held[v] += value * vf_load(weight + v * LANES);
    }
#pragma GCC unroll 8
    for (int v = 0; v < vectors; v++) vf_store(gates + v * LANES, held[v]);
}

/* One LSTM cell of a row; gates in torch's order: input, forget, new, output.
 *
 * weight: [depth + size][4 size], first what comes in, then the hidden state.
 */
static void lstm_cell(int64_t size, int64_t depth, const float *weight, const float *bias,
                      const float *in, float *hidden, float *cell, float *gates) {
    int64_t width = 4 * size, at = 0;
    memcpy(gates, bias, (size_t)width * sizeof *gates);
    for (; at + GATE_VECTORS * LANES <= width; at += GATE_VECTORS * LANES)
        add_products(GATE_VECTORS, size, depth, weight + at, in, hidden, gates + at);
    for (; at + 4 * LANES <= width; at += 4 * LANES)
        add_products(4, size, depth, weight + at, in, hidden, gates + at);
    for (; at + LANES <= width; at += LANES)
        add_products(1, size, depth, weight + at, in, hidden, gates + at);
    for (; at < width; at++)
        for (int64_t k = 0; k < depth + size; k++)
            gates[at] += (k < depth ? in[k] : hidden[k - depth]) * weight[k * width + at];
    for (int64_t first = 0; first < size; first += LANES) {
        int64_t here = size - first < LANES ? size - first : LANES;
        size_t bytes = (size_t)here * sizeof(float);
        vf gate[4] = {0}, c = {0};
        for (int q = 0; q < 4; q++) memcpy(&gate[q], gates + q * size + first, bytes);
        memcpy(&c, cell + first, bytes);
        c = vf_sigmoid(gate[1]) * c + vf_sigmoid(gate[0]) * vf_tanh(gate[2]);
        vf h = vf_sigmoid(gate[3]) * vf_tanh(c);
        memcpy(cell + first, &c, bytes);
        memcpy(hidden + first, &h, bytes);
    }
}

static void encode(const Model *model, Node *node, const double *around, float *gates) {
    float in[NODE_FEATURES + NEIGHBOUR_FEATURES];
    int64_t kinds = model->kinds, history = model->history, edge = model->edge;
    float *numbers = numbers_of(node) + kinds;
    float *edges_h = numbers + 2 * history, *edges_c = edges_h + kinds * edge;
    features_of(model, node, in);
    lstm_cell(history, NODE_FEATURES,
              model->node_weight + node->type * (NODE_FEATURES + history) * 4 * history,
              model->node_bias + node->type * 4 * history, in, numbers, numbers + history, gates);
    int64_t depth = NODE_FEATURES + NEIGHBOUR_FEATURES;
    for (int64_t kind = 0; kind < kinds; kind++) {
        int64_t pair = node->type * kinds + kind;
        for (int i = 0; i < NEIGHBOUR_FEATURES; i++)
            in[NODE_FEATURES + i] = (float)around[kind * NEIGHBOUR_FEATURES + i];
        lstm_cell(edge, depth, model->edge_weight + pair * (depth + edge) * 4 * edge,
                  model->edge_bias + pair * 4 * edge, in, edges_h + kind * edge,
                  edges_c + kind * edge, gates);
    }
}

/* Where edges are written: there may be more than fit, then they are only counted. */
typedef struct {
    Edge *edges;
    int64_t count, room;
} Edges;

static void append(const Model *model, char *nodes, Edges *out, Edge edge, double *influence) {
    if (out->count < out->room) out->edges[out->count] = edge;
    out->count++;
    const Node *sender = node_at(model, nodes, edge.sender);
    influence[edge.receiver * model->kinds + sender->type] += modulation(model, &edge);
}

/* A fading edge, if it does not leave for good. */
static void fade(const Model *model, char *nodes, Edges *out, Edge edge, double *influence) {
    if (edge.gone >= model->removal_steps) return;
    edge.gone++;
    append(model, nodes, out, edge, influence);
}

static void step_scene(const Model *model, char *nodes, int64_t count, const Edge *before,
                       int64_t before_count, Edges *out, Scratch *scratch, float *gates) {
    int64_t kinds = model->kinds, present = 0, old = 0;
    memset(scratch->around, 0, (size_t)(count * kinds * NEIGHBOUR_FEATURES) * sizeof(double));
    memset(scratch->influence, 0, (size_t)(count * kinds) * sizeof(double));
    for (int64_t row = 0; row < count; row++) present += scratch->present[row];
    double origin[2];
    int64_t placed = present > FEW ? sort_into_cells(model, nodes, count, scratch, origin) : -1;
    for (int64_t row = 0; row < count; row++) {
        const Node *node = node_at(model, nodes, row);
        int64_t found = 0;
        if (scratch->present[row])
            found = neighbours_of(model, nodes, count, row, placed, origin, scratch);
        /* Both lists rise by sender: merged, they give the ages. */
        for (int64_t i = 0; i < found; i++) {
            int32_t sender = scratch->near[i];
            for (; old < before_count && before[old].receiver == row && before[old].sender < sender;
                 old++)
                fade(model, nodes, out, before[old], scratch->influence);
            Edge edge = {(int32_t)row, sender, 1, 0};
            if (old < before_count && before[old].receiver == row && before[old].sender == sender) {
                if (before[old].gone == 0) edge.age += before[old].age;
                old++;
            }
            append(model, nodes, out, edge, scratch->influence);
            const Node *other = node_at(model, nodes, sender);
            look(model, node, other,
                 scratch->around + (row * kinds + other->type) * NEIGHBOUR_FEATURES);
        }
        for (; old < before_count && before[old].receiver == row; old++)
            fade(model, nodes, out, before[old], scratch->influence);
    }
    for (int64_t row = 0; row < count; row++) {
        Node *node = node_at(model, nodes, row);
        float *influence = numbers_of(node);
        for (int64_t kind = 0; kind < kinds; kind++) {
            double sum = scratch->influence[row * kinds + kind];
            influence[kind] = (float)(sum < 1.0 ? sum : 1.0);
        }
        if (scratch->present[row])
            encode(model, node, scratch->around + row * kinds * NEIGHBOUR_FEATURES, gates);
    }
}

static int allocate(Scratch *scratch, int64_t nodes, int64_t kinds) {
    size_t rows = (size_t)(nodes > 0 ? nodes : 1);
    scratch->placed = malloc(rows * sizeof *scratch->placed);
    scratch->near = malloc(rows * sizeof *scratch->near);
    scratch->marked = calloc(rows, 1);
    scratch->present = malloc(rows);
    scratch->around = malloc(rows * (size_t)kinds * NEIGHBOUR_FEATURES * sizeof(double));
    scratch->influence = malloc(rows * (size_t)kinds * sizeof(double));
    return scratch->placed && scratch->near && scratch->marked && scratch->present &&
           scratch->around && scratch->influence;
}

static void release(Scratch *scratch) {
    free(scratch->placed);
    free(scratch->near);
    free(scratch->marked);
    free(scratch->present);
    free(scratch->around);
    free(scratch->influence);
}

/* Steps scenes in place; how many edges there are after it, or -1 without memory.
 *
 * nodes: records of all scenes; node_start [scenes + 1]. before: their edges, receivers and
 * senders as rows of their scene, sorted; edge_start [scenes + 1]. Observed agents: row in
 * their scene, position [2]; observed_start [scenes + 1]; time_s [scenes]. after: room for
 * edges, after_start [scenes + 1] is filled. Should there be more edges than room, nothing of
 * what was written is of use: call again with the nodes as they were.
 */
KERNEL int64_t trajectron_step(
    const Model *model, int64_t scenes, char *nodes, const int64_t *node_start,
    const Edge *before, const int64_t *edge_start, const int64_t *observed_start,
    const int32_t *observed, const double *position, const double *time_s, Edge *after,
    int64_t *after_start, int64_t room) {
    int64_t largest = 0;
    for (int64_t scene = 0; scene < scenes; scene++) {
        int64_t count = node_start[scene + 1] - node_start[scene];
        largest = count > largest ? count : largest;
    }
    int64_t wide = model->history > model->edge ? model->history : model->edge;
    Scratch scratch;
    float *gates = malloc((size_t)(4 * wide) * sizeof *gates);
    Edges out = {after, 0, room};
    int able = allocate(&scratch, largest, model->kinds) && gates;
    for (int64_t scene = 0; able && scene < scenes; scene++) {
        char *own = nodes + node_start[scene] * model->record_bytes;
        int64_t count = node_start[scene + 1] - node_start[scene];
        memset(scratch.present, 0, (size_t)count);
        for (int64_t i = observed_start[scene]; i < observed_start[scene + 1]; i++) {
            scratch.present[observed[i]] = 1;
            advance(model, node_at(model, own, observed[i]), position[2 * i], position[2 * i + 1],
                    time_s[scene]);
        }
        after_start[scene] = out.count;
        step_scene(model, own, count, before + edge_start[scene],
                   edge_start[scene + 1] - edge_start[scene], &out, &scratch, gates);
    }
    after_start[scenes] = out.count;
    release(&scratch);
    free(gates);
    return able ? out.count : -1;
}
