/* The loops in which a policy spends its time. A generated file has those it uses, each between two markers. */
#include <stddef.h>

//: dense
/* y = b + x W. W lies in blocks of 64 columns, then of 8, the last filled up with zeros: one stream of memory, and
 * sums that stay in registers. b has as many columns as W. */
#define DENSE_BLOCK(width)                                                        \
    {                                                                             \
        float sum[width];                                                         \
        for (int j = 0; j < (width); j++) sum[j] = b[o + j];                      \
        for (int i = 0; i < n; i++) {                                             \
            const float xi = x[i];                                                \
            for (int j = 0; j < (width); j++) sum[j] += xi * w[j];                \
            w += (width);                                                         \
        }                                                                         \
        for (int j = 0; j < (width) && o + j < m; j++) y[o + j] = sum[j];         \
    }
static void dense(const float *restrict x, const float *restrict w, const float *restrict b, float *restrict y, int n,
                  int m) {
    int o = 0;
    for (; o + 64 <= m; o += 64) DENSE_BLOCK(64)
    for (; o < m; o += 8) DENSE_BLOCK(8)
}
#undef DENSE_BLOCK
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
//: end
