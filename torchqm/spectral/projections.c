/* Many long rows against a few, as Gram-Schmidt needs them: general matrix products run at half of this speed on 16 rows,
 * since what they copy to get long inner loops is not used often enough. */

#include "../native.h"

#define FEW 16 /* rows of a block */
#define LANES (BYTES / (int)sizeof(double))
#define WIDE 1024       /* columns of the few rows that are in the larger cache together, */
#define NARROW 256      /* and in the smaller one */
#define PART (2 * WIDE) /* columns of a task */

typedef double vec __attribute__((vector_size(BYTES), aligned(sizeof(double))));

typedef struct {
    int64_t m, n, next;
    const double *rows; /* (m, n) */
    double *few;        /* (FEW, n) */
    double *products;   /* (m, FEW); of each part its own where they are made */
} task;

INLINE double sum(const vec *v) {
    double total = 0;
    for (int l = 0; l < LANES; l++) total += (*v)[l];
    return total;
}

/* products[i][j] += rows_i . few_j over some columns, for up to 4 rows and 4 of the few. */
INLINE void dots(const double *rows, int64_t count, const double *few, int64_t n, int64_t columns, double *products) {
    vec sums[4][4] = {0};
    const double *own[4], *other[4];
    for (int i = 0; i < 4; i++) own[i] = rows + (i < count ? i : 0) * n, other[i] = few + i * n;
    int64_t c = 0;
    for (; c + LANES <= columns; c += LANES) {
        vec a[4], b[4];
        for (int i = 0; i < 4; i++) a[i] = *(const vec *)(own[i] + c), b[i] = *(const vec *)(other[i] + c);
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++) sums[i][j] += a[i] * b[j];
    }
    for (int i = 0; i < count; i++)
        for (int j = 0; j < 4; j++) {
            double total = sum(&sums[i][j]);
            for (int64_t rest = c; rest < columns; rest++) total += own[i][rest] * other[j][rest];
            products[i * FEW + j] += total;
        }
}

INLINE void project_parts_body(void *given) {
    task *t = given;
    for (int64_t part; (part = take(&t->next)) * PART < t->n;) {
        double *products = t->products + part * t->m * FEW;
        for (int64_t i = 0; i < t->m * FEW; i++) products[i] = 0;
        const int64_t end = (part + 1) * PART < t->n ? (part + 1) * PART : t->n;
        for (int64_t c = part * PART; c < end; c += WIDE)
            for (int64_t i = 0; i < t->m; i += 4)
                for (int j = 0; j < FEW; j += 4)
                    dots(t->rows + i * t->n + c, t->m - i < 4 ? t->m - i : 4, t->few + j * t->n + c, t->n,
                         end - c < WIDE ? end - c : WIDE, products + i * FEW + j);
    }
}

VERSIONS(project_parts)

/* few -= products^T rows for `count` rows (at most 8) and some columns. */
INLINE void minus(const double *rows, int64_t count, double *few, int64_t n, int64_t columns, const double *products) {
    int64_t c = 0;
    if (count == 8)
        for (; c + 2 * LANES <= columns; c += 2 * LANES) {
            vec a[8][2];
            for (int i = 0; i < 8; i++)
                for (int s = 0; s < 2; s++) a[i][s] = *(const vec *)(rows + i * n + c + s * LANES);
            for (int j = 0; j < FEW; j++) {
                double *at = few + j * n + c;
                vec rest[2] = {*(const vec *)at, *(const vec *)(at + LANES)};
                for (int i = 0; i < 8; i++)
                    for (int s = 0; s < 2; s++) rest[s] -= products[i * FEW + j] * a[i][s];
                *(vec *)at = rest[0], *(vec *)(at + LANES) = rest[1];
            }
        }
    for (; c < columns; c++)
        for (int j = 0; j < FEW; j++) {
            double rest = few[j * n + c];
            for (int64_t i = 0; i < count; i++) rest -= products[i * FEW + j] * rows[i * n + c];
            few[j * n + c] = rest;
        }
}

INLINE void subtract_parts_body(void *given) {
    task *t = given;
    for (int64_t part; (part = take(&t->next)) * NARROW < t->n;) {
        const int64_t c = part * NARROW, columns = t->n - c < NARROW ? t->n - c : NARROW;
        for (int64_t i = 0; i < t->m; i += 8)
            minus(t->rows + i * t->n + c, t->m - i < 8 ? t->m - i : 8, t->few + c, t->n, columns, t->products + i * FEW);
    }
}

VERSIONS(subtract_parts)

/* Parts that products are summed up in; in this order, however many threads there are. */
EXPORT int64_t parts(int64_t n) { return (n + PART - 1) / PART; }
EXPORT int few(void) { return FEW; }

/* products (m, FEW) = rows few^T; space: parts(n) times as many numbers, the products come first. */
EXPORT void project(int64_t m, int64_t n, const double *rows, double *few, int threads, double *space) {
    task whole = {m, n, 0, rows, few, space};
    in_threads(project_parts, &whole, threads);
    for (int64_t part = 1; part < parts(n); part++)
        for (int64_t i = 0; i < m * FEW; i++) space[i] += space[part * m * FEW + i];
}

/* few -= products^T rows */
EXPORT void subtract(int64_t m, int64_t n, const double *rows, double *few, int threads, double *products) {
    task whole = {m, n, 0, rows, few, products};
    in_threads(subtract_parts, &whole, threads);
}
