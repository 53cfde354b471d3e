/* Vectors as wide as the instruction set's, and the functions that the kernels need of them.
 *
 * Plain C with the vector extensions of GCC and clang: the same source for every instruction
 * set, the width chosen by the flags that it is compiled with. Each lane's result depends on
 * that lane alone, so it does not matter beside which other values one is computed.
 */
#ifndef TRAJECTRON_SIMD_H
#define TRAJECTRON_SIMD_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__AVX512BW__)
#include <immintrin.h>
#define LANES 16
#define TILE_ROWS 6 /* 6 x 4 sums, 4 weights and 1 input in 32 registers */
#elif defined(__AVX2__)
#include <immintrin.h>
#define LANES 8
#define TILE_ROWS 3 /* 3 x 4 sums, 3 inputs and 1 weight in 16 registers */
#elif defined(__aarch64__)
#include <arm_neon.h>
#define LANES 4
#define TILE_ROWS 6
#else
#include <emmintrin.h>
#define LANES 4
#define TILE_ROWS 2
#endif

/* A panel of packed weights is 4 vectors wide: see gemm_tile. */
#define PANEL_VECTORS 4
#define PANEL_COLUMNS (PANEL_VECTORS * LANES)

#define KERNEL __attribute__((visibility("default")))
#define INLINE static inline __attribute__((always_inline))

typedef float vf __attribute__((vector_size(LANES * 4)));
typedef int32_t vi __attribute__((vector_size(LANES * 4)));
typedef int16_t vs __attribute__((vector_size(LANES * 2)));

INLINE vf vf_load(const float *from) {
    vf v;
    memcpy(&v, from, sizeof v);
    return v;
}

INLINE void vf_store(float *to, vf v) { memcpy(to, &v, sizeof v); }

/* x - 0 is x, so that this is one instruction; 0 + x is not, for x = -0. */
INLINE vf vf_all(float x) { return x - (vf){0}; }

/* The smaller and the larger; NaN if x is NaN. */
INLINE vf vf_min(vf bound, vf x) {
#if defined(__AVX512BW__)
    return (vf)_mm512_min_ps((__m512)bound, (__m512)x);
#elif defined(__AVX2__)
    return (vf)_mm256_min_ps((__m256)bound, (__m256)x);
#elif defined(__aarch64__)
    return (vf)vminq_f32((float32x4_t)bound, (float32x4_t)x);
#else
    return (vf)_mm_min_ps((__m128)bound, (__m128)x);
#endif
}

INLINE vf vf_max(vf bound, vf x) {
#if defined(__AVX512BW__)
    return (vf)_mm512_max_ps((__m512)bound, (__m512)x);
#elif defined(__AVX2__)
    return (vf)_mm256_max_ps((__m256)bound, (__m256)x);
#elif defined(__aarch64__)
    return (vf)vmaxq_f32((float32x4_t)bound, (float32x4_t)x);
#else
    return (vf)_mm_max_ps((__m128)bound, (__m128)x);
#endif
}

INLINE vf vf_sqrt(vf x) {
    vf root;
    for (int lane = 0; lane < LANES; lane++) root[lane] = sqrtf(x[lane]);
    return root;
}

/* The sum of all lanes, always added up in this order. */
INLINE float vf_sum(vf x) {
    float lanes[LANES];
    vf_store(lanes, x);
    for (int width = LANES / 2; width > 0; width /= 2)
        for (int lane = 0; lane < width; lane++) lanes[lane] += lanes[lane + width];
    return lanes[0];
}

INLINE int32_t vi_sum(vi x) {
    int32_t sum = 0;
    for (int lane = 0; lane < LANES; lane++) sum += x[lane];
    return sum;
}

INLINE vf vf_of(vi x) { return __builtin_convertvector(x, vf); }

INLINE float vf_largest(vf x) {
    float largest = x[0];
    for (int lane = 1; lane < LANES; lane++) largest = x[lane] > largest ? x[lane] : largest;
    return largest;
}

/* e^x to about 1 unit in the last place, for x in [-87, 88].
 *
 * x = n ln 2 + r with |r| <= ln(2)/2; e^r by its Taylor series to r^6 (the next term is below
 * 2^-23 / 2), times 2^n (so that NaN stays NaN). n is rounded by adding a number so large that the
 * fraction falls off; its bits then end in n.
 */
INLINE vf vf_exp_within(vf x) {
    const float round_by = 12582912.0f; /* 1.5 x 2^23 */
    vf shifted = x * 1.44269504f + round_by;
    vf n = shifted - round_by;
    vf r = x - n * 0.693359375f; /* ln 2 in two parts: the first product is exact */
    r = r + n * 2.12194440e-4f;
    vf e = vf_all(1.0f / 720.0f);
    e = e * r + 1.0f / 120.0f;
    e = e * r + 1.0f / 24.0f;
    e = e * r + 1.0f / 6.0f;
    e = e * r + 0.5f;
    e = e * r + 1.0f;
    e = e * r + 1.0f;
    return e * (vf)(((vi)shifted << 23) + 0x3f800000);
}

/* 2^x to 3e-6 of itself, for x in [-126, 126]: enough where x itself comes of 16-bit products.
 *
 * As vf_exp_within, by a polynomial of degree 4 that is nowhere in [-1/2, 1/2] further off.
 */
INLINE vf vf_exp2_coarse(vf x) {
    const float round_by = 12582912.0f;
    vf shifted = x + round_by;
    vf r = x - (shifted - round_by);
    vf e = vf_all(0.0095701f);
    e = e * r + 0.05591786f;
    e = e * r + 0.24024745f;
    e = e * r + 0.69312181f;
    e = e * r + 0.99999926f;
    return (vf)((vi)e + ((vi)shifted << 23));
}

INLINE vf vf_clamp(vf x, float bound) { return vf_min(vf_all(bound), vf_max(vf_all(-bound), x)); }

/* e^x, for x held to [-87, 87]. */
INLINE vf vf_exp(vf x) { return vf_exp_within(vf_clamp(x, 87.0f)); }

/* 1 / (1 + e^-x) */
INLINE vf vf_sigmoid(vf x) { return 1.0f / (1.0f + vf_exp(-x)); }

/* (e^2x - 1) / (e^2x + 1): absolute error below 1e-7, which is what gates need. */
INLINE vf vf_tanh(vf x) {
    vf e = vf_exp_within(2.0f * vf_clamp(x, 10.0f));
    return (e - 1.0f) / (e + 1.0f);
}

/* ln x for normal x > 0 (Cephes' scheme: x = m 2^n with m in [sqrt(1/2), sqrt(2)), and
 * ln m = 2 artanh((m - 1) / (m + 1)) by its series). */
INLINE vf vf_log(vf x) {
    const int32_t root_half = 0x3f3504f3;
    vi bits = (vi)x - root_half;
    vi n = bits >> 23;
    vf m = (vf)((bits & 0x7fffff) + root_half);
    vf s = (m - 1.0f) / (m + 1.0f);
    vf s2 = s * s;
    vf p = vf_all(2.0f / 9.0f);
    p = p * s2 + 2.0f / 7.0f;
    p = p * s2 + 2.0f / 5.0f;
    p = p * s2 + 2.0f / 3.0f;
    p = p * s2 * s + 2.0f * s;
    return p + vf_of(n) * 0.693147181f;
}

/* Fixed point: x in [-1, 1] as a 16-bit integer, to the nearest 2^-FRACTION_BITS. As
 * fixed_point.py has it. */
#define FRACTION_BITS 13

INLINE void store_fixed(int16_t *to, vf x) {
    const float round_by = 12582912.0f; /* 1.5 x 2^23: the bits of the sum end in the integer */
    vi bits = (vi)(x * (float)(1 << FRACTION_BITS) + round_by) - (vi)vf_all(round_by);
    vs fixed = __builtin_convertvector(bits, vs);
    memcpy(to, &fixed, sizeof fixed);
}

/* a and b as 16-bit integers: a[2i] b[2i] + a[2i + 1] b[2i + 1] in lane i. */
INLINE vi vi_dot_pairs(vi a, vi b) {
#if defined(__AVX512BW__)
    return (vi)_mm512_madd_epi16((__m512i)a, (__m512i)b);
#elif defined(__AVX2__)
    return (vi)_mm256_madd_epi16((__m256i)a, (__m256i)b);
#elif defined(__aarch64__)
    int16x8_t left = (int16x8_t)a, right = (int16x8_t)b;
    int32x4_t low = vmull_s16(vget_low_s16(left), vget_low_s16(right));
    return (vi)vpaddq_s32(low, vmull_high_s16(left, right));
#else
    return (vi)_mm_madd_epi16((__m128i)a, (__m128i)b);
#endif
}

/* sums[row][vector] += inputs[row][k] * panel[k][vector], in integers: exact, as long as no sum
 * leaves 32 bits (fixed_point.py sees to that).
 *
 * panel: [pairs][vectors][LANES][2] packed weights, two neighbours in k beside each other;
 * inputs: rows `stride` integers apart; sums: [rows][vectors]. Otherwise as gemm_tile: twice as
 * many products an instruction.
 */
INLINE void fixed_tile(const int rows, const int vectors, const int16_t *panel, long pairs,
                       const int16_t *inputs, long stride, vi *sums) {
    vi held[4 * TILE_ROWS];
#pragma GCC unroll 24
    for (int i = 0; i < rows * vectors; i++) held[i] = sums[i];
    for (long k = 0; k < pairs; k++) {
        vi weights[PANEL_VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < vectors; v++)
            memcpy(weights + v, panel + (k * vectors + v) * LANES * 2, sizeof(vi));
#pragma GCC unroll 12
        for (int row = 0; row < rows; row++) {
            int32_t pair;
            memcpy(&pair, inputs + row * stride + 2 * k, sizeof pair);
            vi input = pair - (vi){0};
#pragma GCC unroll 4
            for (int v = 0; v < vectors; v++)
                held[row * vectors + v] += vi_dot_pairs(input, weights[v]);
        }
    }
#pragma GCC unroll 24
    for (int i = 0; i < rows * vectors; i++) sums[i] = held[i];
}

/* sums[row][vector] += inputs[row][k] * panel[k][vector], k in order.
 *
 * panel: [depth][vectors][LANES] packed weights; inputs: rows `stride` floats apart; sums:
 * [rows][vectors]. Each sum is made in the order of k whatever row of a tile it is in: a row's
 * result does not depend on its neighbours. rows and vectors are constants where this is used,
 * so that the sums stay in registers.
 */
INLINE void gemm_tile(const int rows, const int vectors, const float *panel, long depth,
                      const float *inputs, long stride, vf *sums) {
    vf held[4 * TILE_ROWS];
#pragma GCC unroll 24
    for (int i = 0; i < rows * vectors; i++) held[i] = sums[i];
    for (long k = 0; k < depth; k++) {
        vf weights[PANEL_VECTORS];
#pragma GCC unroll 4
        for (int v = 0; v < vectors; v++) weights[v] = vf_load(panel + (k * vectors + v) * LANES);
#pragma GCC unroll 12
        for (int row = 0; row < rows; row++) {
            vf input = vf_all(inputs[row * stride + k]);
#pragma GCC unroll 4
            for (int v = 0; v < vectors; v++) held[row * vectors + v] += input * weights[v];
        }
    }
#pragma GCC unroll 24
    for (int i = 0; i < rows * vectors; i++) sums[i] = held[i];
}

#endif
