/* The loops in which a policy spends its time. A generated file has those it uses, each between two markers. */
#include <stddef.h>

//: dense
/* y = b + x W, in blocks of 32 columns, then of 8 with four sums each, the last filled up with zeros: y has room for 7
 * numbers more than m. w is one stream of memory, a block after the other and of each b first; sums stay in registers.
 * Written as it is, gcc 12 and clang 14 vectorize it; measure before you change it (benchmarks/compiled_policy.py). */
#ifdef __GNUC__
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define PREFETCH(address) ((void)0)
#endif
#define DENSE_BLOCK(width, sums, ahead)                                                         \
    {                                                                                           \
        float sum[sums][width];                                                                 \
        int i = 0;                                                                              \
        for (int j = 0; j < (width); j++) sum[0][j] = w[j];                                     \
        for (int r = 1; r < (sums); r++)                                                        \
            for (int j = 0; j < (width); j++) sum[r][j] = 0;                                    \
        w += (width);                                                                           \
        for (; i + (sums) <= n; i += (sums)) {                                                  \
            for (int j = 0; j < (ahead); j += 16) PREFETCH(w + 512 + j);                        \
            for (int r = 0; r < (sums); r++)                                                    \
                for (int j = 0; j < (width); j++) sum[r][j] += x[i + r] * w[(width) * r + j];   \
            w += (sums) * (width);                                                              \
        }                                                                                       \
        for (; i < n; i++, w += (width))                                                        \
            for (int j = 0; j < (width); j++) sum[0][j] += x[i] * w[j];                         \
        for (int r = 1; r < (sums); r++)                                                        \
            for (int j = 0; j < (width); j++) sum[0][j] += sum[r][j];                           \
        for (int j = 0; j < (width); j++) y[o + j] = sum[0][j];                                 \
    }
static void dense(const float *restrict x, const float *restrict w, float *restrict y, int n, int m) {
    int o = 0;
    for (; o + 32 <= m; o += 32) DENSE_BLOCK(32, 1, 32)
    for (; o < m; o += 8) DENSE_BLOCK(8, 4, 0)
}
//: windows
/* Eight places of a convolution's output, for all m channels, 8 at a time: place t begins at x + at[t], and sees the n
 * numbers that lie at seen[] from there. w is as for dense, in blocks of 8. Channels are `apart` numbers apart; of the
 * places only the first `count` exist. Written with plain arrays, gcc 12 makes it ten times slower for AVX. */
#ifdef __GNUC__
typedef float eight __attribute__((vector_size(32), aligned(4), may_alias));
#define SUMS eight sum[8]
#define EACH_SUM(to) for (int t = 0; t < 8; t++) sum[t] to
#define BLOCK (*(const eight *)w)
#else
#define SUMS float sum[8][8]
#define EACH_SUM(to) for (int t = 0; t < 8; t++) for (int j = 0; j < 8; j++) sum[t][j] to
#define BLOCK w[j]
#endif
static void windows(const float *restrict x, const int32_t *restrict at, const int32_t *restrict seen,
                    const float *restrict w, float *restrict y, int n, int m, int apart, int count) {
    for (int o = 0; o < m; o += 8) {
        SUMS;
        EACH_SUM(= BLOCK);
        w += 8;
        for (int i = 0; i < n; i++, w += 8) {
            const float *v = x + seen[i];
            EACH_SUM(+= v[at[t]] * BLOCK);
        }
        for (int j = 0; j < 8 && o + j < m; j++)
            for (int t = 0; t < 8 && t < count; t++) y[apart * (o + j) + t] = sum[t][j];
    }
}
//: tanh
/* Rational approximation of degrees 13 and 6, within 4 units in the last place; the coefficients are Eigen's and
 * onnxruntime's. Not a number stays not a number. */
static float tanh_of(float x) {
    const float low = x < -9.0f ? -9.0f : x;
    const float v = low > 9.0f ? 9.0f : low;
    const float s = v * v;
    float p = s * -2.76076847742355e-16f + 2.00018790482477e-13f;
    float q = s * 1.19825839466702e-06f + 1.18534705686654e-04f;
    p = p * s + -8.60467152213735e-11f;
    p = p * s + 5.12229709037114e-08f;
    p = p * s + 1.48572235717979e-05f;
    p = p * s + 6.37261928875436e-04f;
    p = p * s + 4.89352455891786e-03f;
    q = q * s + 2.26843463243900e-03f;
    q = q * s + 4.89352518554385e-03f;
    return v * p / q;
}
//: sigmoid
static float sigmoid_of(float x) { return 0.5f * tanh_of(0.5f * x) + 0.5f; }
//: lstm
/* The gates of a, in the order of ONNX: input, output, forget, cell. */
static void lstm(const float *restrict a, float *restrict c, float *restrict h, int n) {
    for (int i = 0; i < n; i++) {
        c[i] = sigmoid_of(a[i + 2 * n]) * c[i] + sigmoid_of(a[i]) * tanh_of(a[i + 3 * n]);
        h[i] = sigmoid_of(a[i + n]) * tanh_of(c[i]);
    }
}
//: gru
/* The gates of a: update, reset, new; first those of the input, then those of the memory. */
static void gru(const float *restrict a, float *restrict h, int n) {
    for (int i = 0; i < n; i++) {
        const float z = sigmoid_of(a[i] + a[i + 3 * n]), r = sigmoid_of(a[i + n] + a[i + 4 * n]);
        h[i] = (1.0f - z) * tanh_of(a[i + 2 * n] + r * a[i + 5 * n]) + z * h[i];
    }
}
//: quotient
/* By zero it is zero, and so are rest and modulo. */
static int64_t quotient(int64_t a, int64_t b) {
    return b == 0 ? 0 : b == -1 ? (int64_t)(0 - (uint64_t)a) : a / b;
}
//: rest
static int64_t rest(int64_t a, int64_t b) { return b == 0 || b == -1 ? 0 : a % b; }
//: modulo
static int64_t modulo(int64_t a, int64_t b) {
    const int64_t r = rest(a, b);
    return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}
//: end
