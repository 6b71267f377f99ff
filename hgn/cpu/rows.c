/* Computes rows of an MLP: a hidden layer, a norm, a residual, and sums of runs of rows.

hgn/cpu/compiled.py compiles this file once for each width and CPU; hgn/cpu/rows.py is the reference. CHUNK rows at a
time pass all layers, so intermediate results stay in the fastest cache. Incomplete tiles are padded with zero rows. The
result of a row therefore does not depend on the number of rows.
*/
#include <stdint.h>
#include <string.h>

#if defined(__AVX512F__)
#define LANES 16
#define WIDEST 4 /* vectors per row of a tile, at most; the sums of TILE_ROWS rows take most of the registers */
#elif defined(__AVX__)
#define LANES 8
#define WIDEST 2
#elif defined(__aarch64__)
#define LANES 4
#define WIDEST 4
#else
#define LANES 4
#define WIDEST 2
#endif
#define VECTORS (WIDTH / LANES)
#define TILE_VECTORS (VECTORS % WIDEST == 0 ? WIDEST : VECTORS % 2 == 0 ? 2 : 1)
#define TILE_ROWS 6
#define CHUNK (8 * TILE_ROWS)

typedef float vector __attribute__((vector_size(4 * LANES)));
typedef float unaligned __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
#define AT(pointer) (*(unaligned *)(pointer))
#define IN(pointer) ((vector) * (const unaligned *)(pointer))
#define INLINE static inline __attribute__((always_inline))

/* Returns LeakyReLU of a vector. */
INLINE vector activated(vector value, float slope) {
    typedef __typeof__(value > 0) mask;
    vector scaled = value * slope;
    return (vector)(((value > 0) & (mask)value) | (~(value > 0) & (mask)scaled));
}

/* Returns the sum of a vector's numbers. */
INLINE float summed(vector value) {
    float number[LANES];
    memcpy(number, &value, sizeof number);
    for (int half = LANES / 2; half; half /= 2)
        for (int lane = 0; lane < half; lane++) number[lane] += number[lane + half];
    return number[0];
}

/* Subtracts from each row its mean. */
INLINE void centre(int64_t rows, float *matrix) {
    for (float *row = matrix; row < matrix + rows * WIDTH; row += WIDTH) {
        vector total = {0};
        for (int v = 0; v < VECTORS; v++) total += IN(row + v * LANES);
        float mean = summed(total) / WIDTH;
        for (int v = 0; v < VECTORS; v++) AT(row + v * LANES) = IN(row + v * LANES) - mean;
    }
}

/* Writes to `out` value [rows, depth] times a matrix [depth, WIDTH] plus `bias`, or plus `out` itself if it is null. */
INLINE void multiply(int64_t rows, const float *value, int64_t depth, const float *matrix, const float *bias,
                     float *out, int activate, float slope) {
    for (int64_t column = 0; column < WIDTH; column += TILE_VECTORS * LANES)
        for (int64_t row = 0; row < rows; row += TILE_ROWS) {
            float *place = out + row * WIDTH + column;
            vector sum[TILE_ROWS][TILE_VECTORS];
            for (int r = 0; r < TILE_ROWS; r++)
                for (int v = 0; v < TILE_VECTORS; v++)
                    sum[r][v] = bias ? IN(bias + column + v * LANES) : IN(place + r * WIDTH + v * LANES);
            for (int64_t k = 0; k < depth; k++)
                for (int r = 0; r < TILE_ROWS; r++)
                    for (int v = 0; v < TILE_VECTORS; v++)
                        sum[r][v] += value[(row + r) * depth + k] * IN(matrix + k * WIDTH + column + v * LANES);
            for (int r = 0; r < TILE_ROWS; r++)
                for (int v = 0; v < TILE_VECTORS; v++)
                    AT(place + r * WIDTH + v * LANES) = activate ? activated(sum[r][v], slope) : sum[r][v];
        }
}

/* Writes to out [depth, WIDTH] the first columns of a layer's weight [WIDTH, stride], transposed. It takes only as long
as the products of a dozen rows, so the result is not kept between calls. */
INLINE void transpose(int64_t depth, const float *weight, int64_t stride, float *out) {
    for (int64_t first = 0; first < depth; first += LANES) {
        int64_t count = depth - first < LANES ? depth - first : LANES;
        for (int64_t row = 0; row < WIDTH; row++)
            for (int64_t k = 0; k < count; k++) out[(first + k) * WIDTH + row] = weight[row * stride + first + k];
    }
}

/* Returns `value`, or its copy in `room` with zero rows up to a multiple of TILE_ROWS. */
INLINE const float *whole_tiles(int64_t rows, const float *value, int64_t depth, float *room) {
    if (rows % TILE_ROWS == 0) return value;
    memcpy(room, value, rows * depth * sizeof(float));
    memset(room + rows * depth, 0, (TILE_ROWS - rows % TILE_ROWS) * depth * sizeof(float));
    return room;
}

/* Writes to out [rows, WIDTH] value [rows, depth <= WIDTH] times the transpose of a part of a layer's weight
[WIDTH, stride], plus a bias [WIDTH] unless null. */
void project(int64_t rows, const float *value, int64_t depth, const float *weight, int64_t stride, const float *bias,
             float *out) {
    static const float zeros[WIDTH];
    float matrix[WIDTH * WIDTH], room[CHUNK * WIDTH], result[CHUNK * WIDTH];
    transpose(depth, weight, stride, matrix);
    for (int64_t first = 0; first < rows; first += CHUNK) {
        int64_t count = rows - first < CHUNK ? rows - first : CHUNK;
        const float *in = whole_tiles(count, value + first * depth, depth, room);
        float *to = count % TILE_ROWS == 0 ? out + first * WIDTH : result;
        multiply(count, in, depth, matrix, bias ? bias : zeros, to, 0, 0);
        if (to == result) memcpy(out + first * WIDTH, result, count * WIDTH * sizeof(float));
    }
}

/* Writes sums of `each` table rows to the hidden layer of `rows` rows from `first` on. */
INLINE void gather(int64_t first, int64_t rows, const float *table, const int64_t *index, int64_t each, float *hidden,
                   int activate, float slope) {
    for (int64_t row = 0; row < rows; row++) {
        vector sum[VECTORS];
        const int64_t own = first + row, *place = index ? index + own * each : &own;
        for (int v = 0; v < VECTORS; v++) sum[v] = IN(table + place[0] * WIDTH + v * LANES);
        for (int64_t i = 1; i < each; i++)
            for (int v = 0; v < VECTORS; v++) sum[v] += IN(table + place[i] * WIDTH + v * LANES);
        for (int v = 0; v < VECTORS; v++)
            AT(hidden + row * WIDTH + v * LANES) = activate ? activated(sum[v], slope) : sum[v];
    }
}

/* Computes outputs of the MLP, and adds their sums over runs to `sums` (see rows.py). `index`, `value`, `residual`,
`out`, `weight` and `offset` may be null; `out` may be the same array as `residual` or `value`. */
void outputs(int64_t rows, const float *table, const int64_t *index, int64_t each, const float *value, int64_t depth,
             const float *part, int64_t stride, float slope, const float *second, const float *second_bias,
             const float *gain, const float *shift, float epsilon, const float *residual, float *out,
             const float *weight, const int64_t *offset, float *sums) {
    float first_matrix[WIDTH * WIDTH], second_matrix[WIDTH * WIDTH], bias[WIDTH];
    float hidden[CHUNK * WIDTH], result[CHUNK * WIDTH];
    int64_t run = 0;
    if (value) transpose(depth, part, stride, first_matrix);
    transpose(WIDTH, second, WIDTH, second_matrix);
    memcpy(bias, second_bias, sizeof bias);
    centre(WIDTH, second_matrix), centre(1, bias); /* outputs then have mean 0, as the norm requires */
    for (int64_t first = 0; first < rows; first += CHUNK) {
        int64_t count = rows - first < CHUNK ? rows - first : CHUNK;
        if (count % TILE_ROWS) memset(hidden, 0, sizeof hidden);
        if (value) {
            const float *in = whole_tiles(count, value + first * depth, depth, result);
            gather(first, count, table, index, each, hidden, 0, 0);
            multiply(count, in, depth, first_matrix, 0, hidden, 1, slope);
        } else
            gather(first, count, table, index, each, hidden, 1, slope);
        multiply(count, hidden, WIDTH, second_matrix, bias, result, 0, 0);
        for (int64_t row = 0; row < count; row++) {
            const float *from = result + row * WIDTH;
            vector output[VECTORS], square = {0};
            for (int v = 0; v < VECTORS; v++) output[v] = IN(from + v * LANES);
            for (int v = 0; v < VECTORS; v++) square += output[v] * output[v];
            float scale = 1 / __builtin_sqrtf(summed(square) / WIDTH + epsilon);
            for (int v = 0; v < VECTORS; v++)
                output[v] = output[v] * scale * IN(gain + v * LANES) + IN(shift + v * LANES);
            int64_t place = (first + row) * WIDTH;
            if (out)
                for (int v = 0; v < VECTORS; v++)
                    AT(out + place + v * LANES) = residual ? IN(residual + place + v * LANES) + output[v] : output[v];
            if (offset) {
                while (first + row >= offset[run + 1]) run++;
                float factor = weight ? weight[first + row] : 1;
                for (int v = 0; v < VECTORS; v++) AT(sums + run * WIDTH + v * LANES) += factor * output[v];
            }
        }
    }
}
