// Measures the cost of Cook-Torrance's lobe D on one CPU core in scalar float code: D and D16 as
// published by Romanyuk et al. (2020), D16 without a clamp, and exact D with a single division.
//
//   cc -O2 -fno-tree-vectorize scalar.c -o scalar -lm && ./scalar 25
//
//   each         each cosine has its own m
//   one          one m for all cosines: the compiler may move code out of the loop
//   beforehand   one m; the loop contains no division, because factors of m are computed before it
//
// Output: a line of names, a line of mean values, and a line per repeat with the nanoseconds per
// evaluation in CPU time.
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { COUNT = 4096, PASSES = 200 };

static float cosines[COUNT], slopes[COUNT];
float values[COUNT];  // not static, so that the compiler must store the results

// 1/(8 m^2) - 1/4, and the peak of D
static inline float factor(float m) { return 1.0f / (8.0f * m * m) - 0.25f; }
static inline float peak(float m) { return 1.0f / (4.0f * m * m); }

static inline float power16(float c, float factor) {
    float power = factor * (c - 1.0f) + 1.0f;
    power *= power;
    power *= power;
    power *= power;
    return power * power;
}

static inline float printed(float c, float m) {
    return expf((c * c - 1.0f) / (m * m * c * c)) / (4.0f * m * m * c * c * c * c);
}

static inline float d16(float c, float m) {
    return power16(c, factor(m)) / (4.0f * m * m);
}

static inline float exact(float c, float m) {
    float c2 = c * c, m2 = m * m;
    float inverse = 1.0f / (c2 * m2);
    float sec2 = inverse * m2;
    return 0.25f * expf((c2 - 1.0f) * inverse) * inverse * sec2;
}

#define LOOP(name, before, value)                                     \
    static void name(void) {                                          \
        before;                                                       \
        for (int i = 0; i < COUNT; ++i) values[i] = value;            \
    }
LOOP(printed_each, , printed(cosines[i], slopes[i]))
LOOP(d16_each, , d16(cosines[i], slopes[i]))
LOOP(exact_each, , exact(cosines[i], slopes[i]))
LOOP(printed_one, float m = slopes[0], printed(cosines[i], m))
LOOP(d16_one, float m = slopes[0], d16(cosines[i], m))
LOOP(d16_beforehand, float a = factor(slopes[0]); float d0 = peak(slopes[0]),
     d0 * power16(cosines[i], a))

static const struct {
    const char *name;
    void (*run)(void);
} loops[] = {
    {"printed_each", printed_each}, {"d16_each", d16_each}, {"exact_each", exact_each},
    {"printed_one", printed_one},   {"d16_one", d16_one},   {"d16_beforehand", d16_beforehand},
};
enum { LOOPS = sizeof loops / sizeof *loops };

static double nanoseconds(void) {
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * t.tv_sec + t.tv_nsec;
}

int main(int count, char **arguments) {
    int repeats = count > 1 ? atoi(arguments[1]) : 15;
    for (int i = 0; i < COUNT; ++i) {
        cosines[i] = cosf(1.0f * i / COUNT);  // 0 to 57 degrees; at 57, D is below 1e-5 of its peak
        slopes[i] = 0.3f + 0.1f * i / COUNT;
    }
    for (int k = 0; k < LOOPS; ++k) printf("%s ", loops[k].name);
    printf("\n");
    for (int k = 0; k < LOOPS; ++k) {
        double sum = 0.0;
        loops[k].run();
        for (int i = 0; i < COUNT; ++i) sum += values[i];
        printf("%.6f ", sum / COUNT);
    }
    for (int turn = 0; turn < repeats; ++turn) {
        printf("\n");
        for (int k = 0; k < LOOPS; ++k) {
            double start = nanoseconds();
            for (int pass = 0; pass < PASSES; ++pass) loops[k].run();
            double elapsed = nanoseconds() - start;
            printf("%.4f ", elapsed / PASSES / COUNT);
        }
    }
    printf("\n");
    return 0;
}
