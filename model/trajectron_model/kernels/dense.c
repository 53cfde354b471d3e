/* A linear layer for few inputs and outputs: what rollouts of an agent share is made by it. */
#include "simd.h"

/* out[row][column] = bias[column] + sum over k of inputs[row][k] * weights[k][column]
 *
 * inputs: [rows][depth]; packed: [panels][depth][PANEL_VECTORS][LANES], columns padded with zeros
 * to whole panels; bias: [panels * PANEL_COLUMNS]; out: [rows][columns].
 */
KERNEL void trajectron_dense(long rows, long depth, long columns, const float *inputs,
                             const float *packed, const float *bias, float *out) {
    for (long row = 0; row < rows; row++) {
        const float *panel = packed;
        for (long column = 0; column < columns; column += PANEL_COLUMNS) {
            vf sums[PANEL_VECTORS];
            for (int v = 0; v < PANEL_VECTORS; v++) sums[v] = vf_load(bias + column + v * LANES);
            for (long k = 0; k < depth; k++, panel += PANEL_COLUMNS) {
                vf input = vf_all(inputs[row * depth + k]);
                for (int v = 0; v < PANEL_VECTORS; v++)
                    sums[v] += input * vf_load(panel + v * LANES);
            }
            long left = columns - column < PANEL_COLUMNS ? columns - column : PANEL_COLUMNS;
            memcpy(out + row * columns + column, sums, (size_t)left * sizeof(float));
        }
    }
}
