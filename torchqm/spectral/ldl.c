/* Solves with a sparse factor L D L^T for many right-hand sides, on all cores.
 *
 * Right-hand sides are rows of n numbers. WIDTH of them are turned, so that the entries of one vertex lie together, and
 * each number of L is loaded for all of them: a sweep takes as long as reading L from memory. */

#include "../native.h"

#define WIDTH 8

typedef double vec __attribute__((vector_size(8 * WIDTH), aligned(sizeof(double))));

typedef struct {
    int64_t n, rows, next, free_space;
    const int64_t *starts;  /* (n + 1) where the columns of L begin, which is strictly lower */
    const int32_t *indices; /* rows of its entries */
    const double *entries, *inverse; /* of L, and of 1 / D (n) */
    const double *given;
    double *found;
    double centre;
    int times;
    vec *spaces; /* 2 n for each thread */
} task;

/* x = (L D L^T)^-1 x */
INLINE void solve(const task *t, vec *x) {
    const int64_t *starts = t->starts;
    for (int64_t j = 0; j < t->n; j++) {
        const vec own = x[j];
        for (int64_t at = starts[j]; at < starts[j + 1]; at++) x[t->indices[at]] -= t->entries[at] * own;
    }
    for (int64_t j = t->n - 1; j >= 0; j--) {
        vec sums[4] = {x[j] * t->inverse[j]};
        int64_t at = starts[j];
        for (; at + 4 <= starts[j + 1]; at += 4)
            for (int s = 0; s < 4; s++) sums[s] -= t->entries[at + s] * x[t->indices[at + s]];
        for (; at < starts[j + 1]; at++) sums[0] -= t->entries[at] * x[t->indices[at]];
        x[j] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    }
}

INLINE void parts_body(void *given) {
    task *t = given;
    vec *x = t->spaces + 2 * t->n * take(&t->free_space), *before = x + t->n;
    for (int64_t part; (part = take(&t->next)) * WIDTH < t->rows;) {
        const int64_t first = part * WIDTH, count = t->rows - first < WIDTH ? t->rows - first : WIDTH;
        const double *from = t->given + first * t->n;
        double *to = t->found + first * t->n;
        for (int64_t i = 0; i < t->n; i++)
            for (int l = 0; l < WIDTH; l++) x[i][l] = from[(l < count ? l : 0) * t->n + i];
        for (int step = 0; step < t->times; step++) {
            if (t->centre != 0)
                for (int64_t i = 0; i < t->n; i++) before[i] = x[i];
            solve(t, x);
            if (t->centre != 0)
                for (int64_t i = 0; i < t->n; i++) x[i] -= t->centre * before[i];
        }
        for (int64_t l = 0; l < count; l++)
            for (int64_t i = 0; i < t->n; i++) to[l * t->n + i] = x[i][l];
    }
}

VERSIONS(parts)

/* Rows (rows, n) become ((L D L^T)^-1 - centre)^times of them. spaces: 2 * WIDTH * n numbers for each thread. */
EXPORT void apply(int64_t n, const int64_t *starts, const int32_t *indices, const double *entries, const double *inverse,
                  int64_t rows, const double *given, double *found, double centre, int times, int threads, double *spaces) {
    task whole = {n, rows, 0, 0, starts, indices, entries, inverse, given, found, centre, times, (vec *)spaces};
    in_threads(parts, &whole, threads);
}

EXPORT int width(void) { return WIDTH; }
